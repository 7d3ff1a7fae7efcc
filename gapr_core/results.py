"""What a registration answers: a pose with its certainty, or a refusal with its reason."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.geometry import se3

Array = NDArray[np.float64]


class RegistrationStatus(str, Enum):
    """What the data decided. Only `OK` carries a pose."""

    OK = "OK"
    AMBIGUOUS = "AMBIGUOUS"  # a distinct pose explains the source as well
    DEGENERATE = "DEGENERATE"  # a direction of motion is not observed (spin about a shaft, slide along it)
    LOW_CONFIDENCE = "LOW_CONFIDENCE"  # the best pose found is probably not right
    TOO_FEW_POINTS = "TOO_FEW_POINTS"  # fewer usable source points than a pose needs

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class RegistrationResult:
    """The answer to one `register` call.

    Attributes:
        status: `OK`, or why there is no pose.
        T_target_source: (4, 4) float64 rigid transform, source to target frame, mm; None unless `OK`.
        covariance: (6, 6) float64 of the pose error as x y z (mm) rx ry rz (rad), fixed axes of the target frame,
            rotation about `centre_mm`; None unless `OK`.
        confidence: calibrated probability, 0 to 1, that the pose is within 4 mm and 5 deg of the truth.
        tre_mm: predicted target registration error, root-mean-square over the target's points; None unless `OK`.
        inlier_ratio: share of the source points that the pose explains, 0 to 1.
        alternatives: the next best distinct poses, (4, 4) each, best first; with refusals too, to look at, not to use.
        stage_ms: wall time of each stage, ms.
        method: name of the method that answered.
        reason: one sentence for people: why it was refused; empty when there is nothing to say.
        details: figures behind the confidence (`gapr_core.confidence.FEATURES`), `best_pose`, `proposer`, for logs and
            research.
        centre_mm: (3,) mean of the source points that were used, in the target frame; None unless `OK`, and where a
            method does not say.
    """

    status: RegistrationStatus
    T_target_source: Array | None = None
    covariance: Array | None = None
    confidence: float = 0.0
    tre_mm: float | None = None
    inlier_ratio: float = 0.0
    alternatives: tuple[Array, ...] = ()
    stage_ms: dict[str, float] = field(default_factory=dict)
    method: str = "gapr"
    reason: str = ""
    details: dict[str, Any] = field(default_factory=dict)
    centre_mm: Array | None = None

    def __post_init__(self) -> None:
        if (self.status is RegistrationStatus.OK) != (self.T_target_source is not None):
            raise ValueError(f"a pose goes with status OK and with no other, got {self.status}")

    @property
    def ok(self) -> bool:
        """True when there is a pose."""
        return self.status is RegistrationStatus.OK

    @property
    def seconds(self) -> float:
        """Wall time of the whole call, s."""
        return sum(self.stage_ms.values()) / 1000.0

    def apply(self, points: ArrayLike) -> Array:
        """Source points (N, 3), mm, in the target's frame.

        Raises:
            ValueError: when the registration was refused and there is no pose to apply.
        """
        if self.T_target_source is None:
            raise ValueError(f"no pose to apply: {self.status}. {self.reason}")
        return se3.apply(self.T_target_source, points)

    def __str__(self) -> str:
        head = f"{self.status}  confidence {self.confidence:.2f}"
        if self.ok and self.tre_mm is not None:
            head += f"  TRE {self.tre_mm:.1f} mm"
        head += f"  inliers {self.inlier_ratio:.2f}  {sum(self.stage_ms.values()):.0f} ms"
        return f"{head}  ({self.reason})" if self.reason else head
