"""Parts of an answer: status, findings, warnings, hypotheses, residuals, where to look next, looks."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def confidence_text(confidence: float) -> str:
    """Two decimals, rounded down: never 1.00 without certainty, never 0.90 below it."""
    return f"{np.floor(100.0 * confidence + 1e-9) / 100.0:.2f}"


class RegistrationStatus(str, Enum):
    """Decision of the data. Only `OK` carries a pose."""

    OK = "OK"
    AMBIGUOUS = "AMBIGUOUS"  # a distinct pose explains the source as well, or the bone is in it twice
    DEGENERATE = "DEGENERATE"  # a direction of motion is not observed (spin about a shaft, slide along it)
    LOW_CONFIDENCE = "LOW_CONFIDENCE"  # the best pose found is probably not right
    TOO_FEW_POINTS = "TOO_FEW_POINTS"  # fewer usable source points than a pose needs
    IMPRECISE = "IMPRECISE"  # probably right, but the error bound over the bone exceeds `max_tre_mm`
    CLUTTER = "CLUTTER"  # most of the source is not the bone, and what is does not determine a pose

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Refusal:
    """Why there is no pose.

    Attributes:
        status: every one but `OK`.
        reason: one sentence for users.
    """

    status: RegistrationStatus
    reason: str


class Effect(str, Enum):
    """How a finding changes an answer."""

    REFUSE = "REFUSE"  # there is no pose
    WIDEN = "WIDEN"  # the covariance, and with it the bound, is larger
    ASK = "ASK"  # a question to the user; the answer stays

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Finding:
    """One check that spoke: its statistic beyond its threshold, and the effect on the answer.

    Attributes:
        check: name of the check, a row of `docs/concepts/checks.md`.
        effect: REFUSE, WIDEN or ASK.
        statistic: measured value.
        threshold: the value that it passed.
        status: status of a refusal; `OK` for the other effects.
        text: one sentence for users.
        advice: one sentence: the next step.
    """

    check: str
    effect: Effect
    statistic: float
    threshold: float
    status: RegistrationStatus
    text: str
    advice: str = ""

    def __str__(self) -> str:
        return (" " if self.text.endswith(".") else "; ").join(filter(None, (self.text, self.advice)))


@dataclass(frozen=True)
class ResultWarning:
    """A caveat that belongs to an accepted pose, shown wherever the result is.

    Attributes:
        code: short stable name, such as "sensor_unknown".
        text: one sentence: the caveat.
        advice: one sentence: the next step.
    """

    code: str
    text: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{self.text} {self.advice}".strip()


@dataclass(frozen=True)
class TargetError:
    """The error to expect at one planned target.

    Attributes:
        label: its name in the plan.
        position_mm: x y z, target frame.
        expected_mm: root-mean-square error of the pose there.
        bound95_mm: the error is below it in 95 of 100 cases.
        distance_mm: distance to the bone, negative inside it; None where the bone is not known.
    """

    label: str
    position_mm: tuple[float, float, float]
    expected_mm: float
    bound95_mm: float
    distance_mm: float | None = None

    @property
    def place(self) -> str:
        """Where the target is relative to the bone, in words; empty where the bone is not known."""
        if self.distance_mm is None:
            return ""
        size = abs(self.distance_mm)
        return "on the bone" if size < 1.0 else f"{size:.0f} mm {'inside' if self.distance_mm < 0 else 'from'} the bone"

    def __str__(self) -> str:
        place = f"; {self.place}" if self.place else ""
        return f"{self.label}: expected error {self.expected_mm:.2f} mm (95 %: {self.bound95_mm:.2f} mm){place}"


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One distinct pose that was refined and compared.

    Attributes:
        T_target_source: (4, 4) rigid transform, source to target frame, mm.
        probability: 0 to 1 that this pose is the right one. That of the best is calibrated; a rival's follows from how
            much worse it explains the source, and is never larger than the best one's.
    """

    T_target_source: Array
    probability: float


@dataclass(frozen=True, eq=False)
class Residuals:
    """How every used source point lies on the target under the best hypothesis.

    Attributes:
        points: (N, 3) the source points that were used, source frame, mm.
        distance_mm: (N,) signed distance to the mesh, or to the surface of a cloud, positive outside; NaN where no
            surface is near. The stand-off of the sensor is taken off: a pointer's points are near 0 where they lie a
            stand-off outside of the bone.
        inlier: (N,) bool, the points that count for the pose.
    """

    points: Array
    distance_mm: Array
    inlier: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Patch:
    """A patch of the bone where another look would help.

    Attributes:
        centre: (3,) mm, target frame.
        normal: (3,) unit, outward, target frame.
        tre95_mm: 95 % bound of the error over the bone to expect after the look, mm, if the best hypothesis is right.
        rivals_excluded: share, 0 to 1, of the rivals' probability that the look would exclude.
        gain_mm: by how much the look lowers the bound, rivals included, mm.
    """

    centre: Array
    normal: Array
    tre95_mm: float
    rivals_excluded: float
    gain_mm: float


@dataclass(frozen=True, eq=False)
class Guidance:
    """Where to look next.

    Attributes:
        points: (M, 3) mm, the target's points, target frame.
        gain_mm: (M,) by how much a look there lowers the bound, mm; 0 where the source has been.
        now_mm: 95 % bound of the error over the bone without another look, rivals included, mm.
        patches: ranked, the best first.
        patch_mm: diameter of a patch.
    """

    points: Array
    gain_mm: Array
    now_mm: float
    patches: tuple[Patch, ...]
    patch_mm: float = 30.0

    def spots(self, most: int = 5) -> tuple[Patch, ...]:
        """Pick the best patches that do not overlap, best first, at most `most`."""
        chosen: list[Patch] = []
        for patch in self.patches:
            if len(chosen) == most:
                break
            if all(np.linalg.norm(patch.centre - other.centre) >= self.patch_mm for other in chosen):
                chosen.append(patch)
        return tuple(chosen)

    def __str__(self) -> str:
        best = self.patches[0]
        where = "({:.0f}, {:.0f}, {:.0f})".format(*best.centre)
        return (
            f"look at {where} mm on the target: the error bound over the bone falls from {self.now_mm:.1f} "
            f"to {self.now_mm - best.gain_mm:.1f} mm, {100 * best.rivals_excluded:.0f} % of the rivals are excluded"
        )


class LookFit(str, Enum):
    """How one look of a camera fits the pose that all its looks have in common."""

    FITS = "FITS"
    APART = "APART"  # it shows the bone elsewhere, or looks through it where the others have it
    BLIND = "BLIND"  # it could hardly show the bone there: something was in the way, or the bone is far
    TOO_SMALL = "TOO_SMALL"  # too few points
    NOT_ASKED = "NOT_ASKED"  # the pose was refused for another reason

    def __str__(self) -> str:
        return self.value


class LookAnswer(NamedTuple):
    """Answer of a registration for one look.

    Attributes:
        viewpoint: (3,) mm, source frame: where the camera was.
        fit: how the look fits the pose.
    """

    viewpoint: Array
    fit: LookFit
