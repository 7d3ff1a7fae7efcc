"""One method's answer to one pair, judged: typed, and a line of JSON."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

Matrix = list[list[float]]
ERROR = "ERROR"  # status where the method raised or its process died


@dataclass(frozen=True, kw_only=True)
class PairFacts:
    """Facts of the pair, whatever the method.

    Attributes:
        pair, protocol, bone, person: names; the subject is empty where it is not known.
        has_truth: False where the right answer is a refusal.
        source_points, target_points: counts.
        half_extent_mm: of the target.
        cohort, overlap, noise_mm, bias_mm, outlier_share, bone_share, wrong_kind, degraded_as, source_person: how the
            pair was made; None where its file does not say.
    """

    pair: str
    protocol: str
    bone: str
    person: str
    has_truth: bool
    source_points: int
    target_points: int
    half_extent_mm: float
    cohort: str | None = None
    overlap: float | None = None
    noise_mm: float | None = None
    bias_mm: float | None = None
    outlier_share: float | None = None
    bone_share: float | None = None
    wrong_kind: str | None = None
    degraded_as: str | None = None
    source_person: str | None = None


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Answer of the method.

    Attributes:
        status: of the result, or `ERROR`.
        accepted: there is a pose.
        confidence: 0 to 1.
        reason: of a refusal or an error.
        transform: (4, 4) T_target_source, mm.
        predicted_tre_mm, predicted_tre95_mm: expected error over the bone, and its 95 % bound.
    """

    status: str
    accepted: bool
    confidence: float = 0.0
    reason: str = ""
    transform: Matrix | None = None
    predicted_tre_mm: float | None = None
    predicted_tre95_mm: float | None = None


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The answer against the truth; None where there is no truth, no covariance or no noise to say something of.

    Attributes:
        right: accepted and within 4 mm and 5 deg.
        false_accept: accepted and not right.
        best_right: the pose that the confidence speaks of, accepted or not, is right; None without any pose.
        stand_in: a refusal, judged as centroid on centroid without rotation.
        judged, true: (4, 4) the pose that is judged, and the truth.
        rte_mm, rre_deg, rmse_mm, whole_bone_mm, chamfer_mm: errors of it.
        tre_mm: errors at named targets.
        within_paper, within_extent, within_1_1, within_2_2, within_4_5: accepted and within these limits.
        twist: (6,) error as x y z (mm) rx ry rz (rad), target frame.
        axes: (3, 3) rows: principal axes of the bone, longest first.
        nees, covariance: normalised error squared under the (6, 6) covariance of the answer.
        bound_rmse_mm, bound_ratio, bound_covariance: Cramer-Rao bound, and the error over it.
    """

    right: bool
    false_accept: bool
    best_right: bool | None = None
    stand_in: bool = False
    judged: Matrix | None = None
    true: Matrix | None = None
    rte_mm: float | None = None
    rre_deg: float | None = None
    rmse_mm: float | None = None
    whole_bone_mm: float | None = None
    chamfer_mm: float | None = None
    tre_mm: dict[str, float] | None = None
    within_paper: bool = False
    within_extent: bool = False
    within_1_1: bool = False
    within_2_2: bool = False
    within_4_5: bool = False
    twist: list[float] | None = None
    axes: Matrix | None = None
    nees: float | None = None
    covariance: Matrix | None = None
    bound_rmse_mm: float | None = None
    bound_ratio: float | None = None
    bound_covariance: Matrix | None = None


@dataclass(frozen=True, kw_only=True)
class Record(PairFacts, Answer, Verdict):
    """One line of records.jsonl.

    Attributes:
        file, sha256: of the pair.
        method: its name on the command line.
        seconds, prepare_seconds: wall time; None after an error.
        commit, machine, threads: what ran, on what, and how many cores it had.
        settings: those that were not the defaults, as `name=value` with commas; none of the baselines has any.
        made_of: changes with the weights or the module that the method is made of; empty for a baseline.
        facts: changes with what the pair's file says of it besides the clouds.
    """

    file: str
    sha256: str
    method: str
    seconds: float | None = None
    prepare_seconds: float | None = None
    commit: str = ""
    machine: str = ""
    threads: int = 0
    settings: str = ""
    made_of: str = ""
    facts: str = ""

    def to_json(self) -> dict[str, Any]:
        """Plain values; None for numbers that are not finite. `runtime.settings.from_dict` reads it back."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(inner) for inner in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if isinstance(value, float) and not math.isfinite(value) else value
