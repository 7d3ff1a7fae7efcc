"""What a registration answers: a pose with its certainty, or a refusal with its reason; what check points say of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.geometry import se3

Array = NDArray[np.float64]


def confidence_text(confidence: float) -> str:
    """Two decimals, rounded down: no 1.00 for what is not certain, no 0.90 for what does not reach it."""
    return f"{np.floor(100.0 * confidence + 1e-9) / 100.0:.2f}"


class RegistrationStatus(str, Enum):
    """What the data decided. Only `OK` carries a pose."""

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
        asks_standoff: the reason asks for the sensor's stand-off already.
    """

    status: RegistrationStatus
    reason: str
    asks_standoff: bool = False


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
        check: name of the check, a row of `docs/checks.md`.
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
    """

    points: Array
    gain_mm: Array
    now_mm: float
    patches: tuple[Patch, ...]

    def spots(self, most: int = 5, apart_mm: float = 30.0) -> tuple[Patch, ...]:
        """The best patches whose centres are at least `apart_mm` from each other, best first, at most `most`."""
        chosen: list[Patch] = []
        for patch in self.patches:
            if len(chosen) == most:
                break
            if all(np.linalg.norm(patch.centre - other.centre) >= apart_mm for other in chosen):
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
    """What a registration says of one look.

    Attributes:
        viewpoint: (3,) mm, source frame: where the camera was.
        fit: how the look fits the pose.
    """

    viewpoint: Array
    fit: LookFit


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """The answer to one `register` call.

    Attributes:
        status: `OK`, or why there is no pose.
        T_target_source: (4, 4) float64 rigid transform, source to target frame, mm; None unless `OK`.
        covariance: (6, 6) float64 of the pose error as x y z (mm) rx ry rz (rad), fixed axes of the target frame,
            rotation about `centre_mm`; None unless `OK`.
        confidence: calibrated probability, 0 to 1, that the best pose is within 4 mm and 5 deg of the truth; also of a
            refused pose.
        tre_mm: expected target registration error, root mean square over the target's points; None unless `OK`.
        tre95_mm: its 95 % bound, mm; None unless `OK`.
        factor95: the bound from `covariance` is multiplied by it, so that 95 % of errors of known size stay below.
        inlier_ratio: share of the source points that the best hypothesis explains, 0 to 1.
        hypotheses: distinct refined poses, best first; on refusals too, to look at, not to use.
        guidance: where on the target another look would help most; None unless `RegistrarConfig.guide` asks for it.
        stage_ms: wall time of each stage, ms.
        method: name of the method that answered.
        reason: one sentence for users: why it was refused; empty when there is nothing to say.
        centre_mm: (3,) mean of the source points that the pose was found with, drawn from those that were used where
            there are many, in the target frame; None unless `OK`, and where a method does not say.
        proposer: name of the last proposer that was asked; empty where nothing was registered.
        rounds: rounds of proposals: of how many proposers, of a camera's cloud of how many sets of regions.
        features: what the confidence is computed from, by name.
        contributions: log odds that each feature adds to the confidence, by name: above 0 it speaks for the pose.
        residuals: of every used point under the best hypothesis; None where a method does not say.
        inferred_viewpoint: (3,) mm, source frame: where the camera is taken to be, as its cloud gave no pose as bone
            alone and nobody said it; None where it was given or is not needed.
        looks: of a camera's several looks, how each fits the pose; () of one. A pose can be accepted although some,
            fewer than half of those with enough points, saw nothing of the bone.
        pose_probability: probability, 0 to 1, of a pose within 4 mm and 5 deg, given that this is the right bone; None
            where a method does not say.
        bone_evidence: log10 likelihood ratio of this bone to another subject's; None where a method does not say.
        findings: the checks that spoke, in the order in which they apply; a refusal by a check is among them.
        warnings: caveats of this result, each with a text and the next step.
    """

    status: RegistrationStatus
    T_target_source: Array | None = None
    covariance: Array | None = None
    confidence: float = 0.0
    tre_mm: float | None = None
    tre95_mm: float | None = None
    inlier_ratio: float = 0.0
    hypotheses: tuple[Hypothesis, ...] = ()
    guidance: Guidance | None = None
    stage_ms: Mapping[str, float] = field(default_factory=dict)
    method: str = "gapr"
    reason: str = ""
    centre_mm: Array | None = None
    proposer: str = ""
    rounds: int = 0
    features: Mapping[str, float] = field(default_factory=dict)
    contributions: Mapping[str, float] = field(default_factory=dict)
    residuals: Residuals | None = None
    inferred_viewpoint: Array | None = None
    factor95: float = 1.0
    looks: tuple[LookAnswer, ...] = ()
    pose_probability: float | None = None
    bone_evidence: float | None = None
    findings: tuple[Finding, ...] = ()
    warnings: tuple[ResultWarning, ...] = ()

    def __post_init__(self) -> None:
        if (self.status is RegistrationStatus.OK) != (self.T_target_source is not None):
            raise ValueError(f"a pose goes with status OK and with no other, got {self.status}")

    @property
    def ok(self) -> bool:
        """True when there is a pose."""
        return self.status is RegistrationStatus.OK

    def __bool__(self) -> bool:
        """As `ok`: a refusal is no pose."""
        return self.ok

    def refused(self, status: RegistrationStatus, reason: str) -> RegistrationResult:
        """The same without its pose and all that goes with one; its confidence and hypotheses stay, to look at."""
        return replace(
            self,
            status=status,
            reason=reason,
            T_target_source=None,
            covariance=None,
            centre_mm=None,
            tre_mm=None,
            tre95_mm=None,
            factor95=1.0,
        )

    @property
    def best(self) -> Array | None:
        """(4, 4) T_target_source of the best hypothesis, accepted or not; None where there is none."""
        return self.hypotheses[0].T_target_source if self.hypotheses else self.T_target_source

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
        head = f"{self.status}  confidence {confidence_text(self.confidence)}"
        if self.ok and self.tre_mm is not None:
            head += f"  TRE {self.tre_mm:.1f} mm"
        if self.ok and self.tre95_mm is not None:
            head += f" (95 %: {self.tre95_mm:.1f} mm)"
        head += f"  inliers {self.inlier_ratio:.2f}  {sum(self.stage_ms.values()):.0f} ms"
        return f"{head}  ({self.reason})" if self.reason else head

    def __repr__(self) -> str:
        return f"<RegistrationResult: {self}>"


class Verdict(str, Enum):
    """What the check points say of a pose."""

    HOLDS = "HOLDS"  # they lie where they should, and an error that matters would have shown, and did not
    SAYS_LITTLE = "SAYS_LITTLE"  # they lie where they should, but such an error might not show in them
    CONTRADICTED = "CONTRADICTED"  # they lie farther off than the pose's covariance allows, or show such an error

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True, eq=False)
class PointCheck:
    """The answer to one `check_points` call.

    Attributes:
        verdict: what the points say.
        probability: that the points of a right pose lie as far off or farther, 0 to 1.
        points: (N, 3) mm, source frame, the points that were checked.
        distance_mm: (N,) signed distance to the surface, positive outside, the sensor's stand-off taken off; NaN where
            no surface is near.
        expected_mm: (N,) its standard deviation under a right pose; NaN with it.
        unseen_mm: 95 % bound of the error over the bone that these points alone leave open.
        tre95_mm: 95 % bound of the pose's error over the bone by registration and check points together.
        next_point, next_normal: (3,) mm and unit, target frame: where another point lowers `unseen_mm` most.
        shown_mm: error of the pose over the bone at which registration and check points together put it; in `tre95_mm`.
    """

    verdict: Verdict
    probability: float
    points: Array
    distance_mm: Array
    expected_mm: Array
    unseen_mm: float
    tre95_mm: float
    next_point: Array
    next_normal: Array
    shown_mm: float = 0.0

    def __str__(self) -> str:
        return self.text()

    def text(self, none_near: str = "none near the bone: are they in the frame and the unit of the source?") -> str:
        """The answer in one line; `none_near` is what it says where no point has a surface near."""
        sizes = np.abs(self.distance_mm)
        far, count = int(np.isnan(sizes).sum()), f"{len(sizes)} point{'s' if len(sizes) > 1 else ''}"
        largest = f"{far} with no surface near" if far else f"{sizes.max():.1f} mm off at most"
        if far == len(sizes):
            largest = none_near
        return (
            f"{self.verdict}  {count}, {largest}  probability {self.probability:.3f}  "
            f"shown {self.shown_mm:.1f} mm  unseen {self.unseen_mm:.1f} mm  TRE 95 %: {self.tre95_mm:.1f} mm"
        )
