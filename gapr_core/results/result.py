"""The answer to one registration: its parts, and how it is shown and written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from html import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.geometry import se3
from gapr_core.results.parts import (
    Finding,
    Guidance,
    Hypothesis,
    LookAnswer,
    RegistrationStatus,
    Residuals,
    ResultWarning,
    TargetError,
    confidence_text,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from gapr_core.surface import Surface

Array = NDArray[np.float64]
PLANNING, PAGE = "gapr_core.formats.planning", "gapr_core.pages.registration_report"  # loaded when first asked for


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """Answer of one `register` call.

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
        centre_mm: (3,) mean of the used source points (of a sample, where there are many) in the target frame; None
            unless `OK`, and where a method does not say.
        proposer: name of the last proposer that was asked; empty where nothing was registered.
        rounds: rounds of proposals: of how many proposers, of a camera's cloud of how many sets of regions.
        features: input of the confidence, by name.
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
        targets: the planned targets (`with_targets`).
        source: (N, 3) mm, the source as given; None where a method does not say.
        bone: the target as loaded, mm; None where a method does not say.
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
    targets: tuple[TargetError, ...] = ()
    source: Array | None = None
    bone: Surface | None = None

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

    def refused(self, finding: Finding) -> RegistrationResult:
        """Return the refusal by a finding: no pose and nothing that needs one; confidence and hypotheses stay."""
        return replace(
            self,
            status=finding.status,
            reason=str(finding),
            findings=(*self.findings, finding),
            T_target_source=None,
            covariance=None,
            centre_mm=None,
            tre_mm=None,
            tre95_mm=None,
            factor95=1.0,
            warnings=(),
            targets=(),
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

    def errors_at(self, points: ArrayLike, labels: Sequence[str] = ()) -> tuple[TargetError, ...]:
        """Expect the error at points (N, 3), mm, target frame; see `with_targets`."""
        return self.with_targets(points, labels).targets

    def with_targets(self, points: ArrayLike, labels: Sequence[str] = ()) -> RegistrationResult:
        """Add planned targets: their errors, and a warning of those far from the bone.

        Args:
            points: (N, 3) mm, target frame; a refusal has no error at them.
            labels: a name for each; their numbers when not given.

        Raises:
            InvalidPointCloudError: wrong shape or type, or a pose without a covariance.
        """
        found: RegistrationResult = import_module(PLANNING).with_targets(self, points, labels)
        return found

    def save(self, path: str | Path) -> None:
        """Write the pose as .tfm or .h5 (ITK, LPS), or as a 4x4 .txt; everything known as .json.

        Raises:
            ConfigError: another ending, or a path that cannot be written.
            ValueError: the registration was refused and there is no pose to save.
        """
        path = Path(path)
        if path.suffix == ".json":
            import_module("gapr_core.runtime.files").write_json(path, self.to_json())
        elif self.T_target_source is None:
            raise ValueError(f"no pose to save: {self.status}. {self.reason}")
        else:
            import_module("gapr_core.formats.transforms").write(path, self.T_target_source)

    def report(self, path: str | Path, name: str = "") -> None:
        """Write one HTML page that needs no network, for a pose and for a refusal.

        Args:
            path: ends with .html.
            name: title of the page, such as the name of the bone.
        """
        import_module(PAGE).write(path, self, name)

    def plot(self) -> Figure:
        """Draw the bone and the points on it from three sides, as a matplotlib figure."""
        figure: Figure = import_module("gapr_core.pages.views").figure(self)
        return figure

    def to_json(self) -> dict[str, Any]:
        """Plain values for `json.dumps`; transform is 4x4 row-major, source to target, mm, and null on a refusal."""
        return {
            "transform": _listed(self.T_target_source),
            "confidence": self.confidence,
            "pose_probability": self.pose_probability,
            "bone_evidence": self.bone_evidence,
            "status": str(self.status),
            "covariance": _listed(self.covariance),
            "centre_mm": _listed(self.centre_mm),
            "seconds": self.seconds,
            "tre_mm": self.tre_mm,
            "tre95_mm": self.tre95_mm,
            "factor95": self.factor95,
            "inlier_ratio": self.inlier_ratio,
            "inferred_viewpoint": _listed(self.inferred_viewpoint),
            "contributions": {name: round(log_odds, 3) for name, log_odds in self.contributions.items()},
            "reason": self.reason,
            "warnings": [asdict(warning) for warning in self.warnings],
            "findings": [asdict(finding) for finding in self.findings],
            "targets": [asdict(target) for target in self.targets],
            "guidance": None if self.guidance is None else _guidance_json(self.guidance),
        }

    def _repr_html_(self) -> str:
        """Show a result in a notebook: verdict, targets and picture; plain text without `reports`."""
        try:
            shown: str = import_module(PAGE).fragment(self)
        except ImportError:
            return f"<pre>{escape(str(self))}</pre>"
        return shown

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


def _listed(array: Array | None) -> Any:
    return None if array is None else np.asarray(array).tolist()


def _guidance_json(guidance: Guidance) -> dict[str, Any]:
    patches = [
        {"centre_mm": _listed(spot.centre), "normal": _listed(spot.normal), "tre95_mm": spot.tre95_mm,
         "rivals_excluded": spot.rivals_excluded, "gain_mm": spot.gain_mm}
        for spot in guidance.spots()
    ]  # fmt: skip
    return {"now_mm": guidance.now_mm, "patches": patches}
