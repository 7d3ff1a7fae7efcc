"""Every setting of the library, in one place: frozen dataclasses whose defaults are the defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any, TypeVar

from gapr_core.errors import ConfigError

T = TypeVar("T")


@dataclass(frozen=True)
class TargetConfig:
    """How the target is prepared.

    Attributes:
        most_points, fewest_points: of its outer shell.
        normal_neighbours, quadric_neighbours: points that give a normal, and a surface element.
        misfit_neighbours, misfit_gain: a surface element's variance is the mean square distance of so many neighbours
            to it times the gain.
        view_directions: from which it is asked what can be seen.
        anchors: points where the search places the source.
        field_reach_mm: of the grid around it.
    """

    most_points: int = 10_000
    fewest_points: int = 200
    normal_neighbours: int = 12
    quadric_neighbours: int = 16
    misfit_neighbours: int = 10
    misfit_gain: float = 0.5
    view_directions: int = 96
    anchors: int = 1200
    field_reach_mm: float = 12.0


@dataclass(frozen=True)
class SourceConfig:
    """How a source is cleaned and thinned."""

    fewest_points: int = 30
    most_points: int = 6000
    normal_neighbours: int = 30
    smallest_extent_mm: float = 10.0
    smallest_width_mm: float = 2.0


@dataclass(frozen=True)
class SearchConfig:
    """The weight-free search: reference points x anchors x spins, scored on the distance field."""

    references: int = 14
    spins: int = 36
    probes: int = 32
    first_probes: int = 8
    first_limit_mm: float = 7.0
    keep: int = 1500


@dataclass(frozen=True)
class VerificationConfig:
    """Which proposals are refined further, and when two poses are the same."""

    coarse_points: int = 192
    coarse_limits_mm: tuple[float, float, int] = (10.0, 5.0, 6)  # from, to, iterations
    middle_points: int = 300
    middle_poses: int = 200
    middle_limits_mm: tuple[float, float, int] = (6.0, 4.0, 10)
    final_poses: int = 8
    final_limits_mm: tuple[float, float, int] = (5.0, 4.0, 8)
    same_pose_mm: float = 4.0


@dataclass(frozen=True)
class RefinementConfig:
    """The last, robust point-to-surface refinement.

    Attributes:
        rounds, iterations, rest_mm: Gauss-Newton until the points move less than `rest_mm`.
        tukey_scale: end of Tukey's weight in standard deviations; `clean_tukey_scale` where less than `clean_share` of
            the residuals are beyond three of them (the normal distribution has 0.3 %).
        patch_scale: end of Tukey's weight for the mean residual of a point and its neighbours, in robust standard
            deviations of these means; from round `free_rounds` on.
        smallest_sigma_mm, largest_sigma_mm: limits of the robust standard deviation.
    """

    rounds: int = 12
    iterations: int = 3
    tukey_scale: float = 3.0
    clean_tukey_scale: float = 5.0
    clean_share: float = 0.015
    rest_mm: float = 1e-3
    free_rounds: int = 2
    patch_scale: float = 6.0
    smallest_sigma_mm: float = 0.15
    largest_sigma_mm: float = 3.0


@dataclass(frozen=True)
class CovarianceConfig:
    """The smooth bias that the covariance reckons with.

    Attributes:
        bias_floor_mm, bias_gain: its standard deviation is the floor and so many times the misfit of the residuals.
        correlation_mm: l of its correlation exp(-d^2 / 2 l^2).
        correlation_points: of the inliers, for the sums over all pairs of points.
        smooth_neighbours: of how many points the averages are taken that show the misfit.
        short_neighbours: the same for the misfit at short range, which the confidence alone uses. The confidence models
            that ship were fitted with these two counts.
    """

    bias_floor_mm: float = 0.03
    bias_gain: float = 1.75
    correlation_mm: float = 25.0
    correlation_points: int = 400
    smooth_neighbours: int = 30
    short_neighbours: int = 12


@dataclass(frozen=True)
class SmoothBiasConfig:
    """The smooth bias that an accepted pose is freed from (`gapr_core.smooth_bias`).

    Attributes:
        correlation_mm: l of its correlation exp(-d^2 / 2 l^2).
        centres: points that span it.
        sizes_mm: standard deviations among which the residuals choose.
        evidence: log likelihood ratio against no bias from which it is believed; infinity leaves every pose as it is.
        smallest_share: of the information of the best determined field; fields with less do not say how large it is.
        iterations: of the pose.
        fewest_points: inliers without which it is not looked for.
        largest_move: squared Mahalanobis distance, under the covariance of the pose as it was, from which a move is not
            made; the default is 99.9 % of chi square with six degrees of freedom.
    """

    correlation_mm: float = 20.0
    centres: int = 80
    sizes_mm: tuple[float, ...] = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0)
    evidence: float = 2.0
    smallest_share: float = 0.15
    iterations: int = 3
    fewest_points: int = 200
    largest_move: float = 22.5


@dataclass(frozen=True)
class RegistrarConfig:
    """Everything a `Registrar` can be told.

    Attributes:
        min_confidence: answers below it are refused.
        sure: an answer at or above it is final; below it the next proposer is asked as well.
        num_threads: of search, verification and refinement; 0 for all cores.
        seed: of whatever is drawn at random.
    """

    target: TargetConfig = field(default_factory=TargetConfig)
    source: SourceConfig = field(default_factory=SourceConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
    smooth_bias: SmoothBiasConfig = field(default_factory=SmoothBiasConfig)
    min_confidence: float = 0.5
    sure: float = 0.95
    num_threads: int = 0
    seed: int = 0


def from_dict(cls: type[T], values: Mapping[str, Any]) -> T:
    """A dataclass from nested mappings; what is absent keeps its default.

    Raises:
        ConfigError: for a name that the dataclass does not have or a value of another kind.
    """
    known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
    for name in values:
        if name not in known:
            raise ConfigError(f"one of {', '.join(known)}", repr(name), f"correct the name in {cls.__name__}")
    defaults = cls()
    return cls(**{name: _convert(getattr(defaults, name), value, name) for name, value in values.items()})


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """The settings of a nested dataclass as one mapping with dotted names (for ROS parameters)."""
    flat: dict[str, Any] = {}
    for name, value in vars(config).items():
        flat |= flatten(value, f"{prefix}{name}.") if is_dataclass(value) else {f"{prefix}{name}": value}
    return flat


def as_dict(config: Any) -> dict[str, Any]:
    """A nested dataclass as nested dictionaries; `from_dict` reads it back."""
    return asdict(config)


def _convert(default: Any, value: Any, name: str) -> Any:
    if is_dataclass(default):
        return from_dict(type(default), value)
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(default, tuple) and isinstance(value, list):
        value = tuple(value)
    if default is not None and type(value) is not type(default):
        raise ConfigError(f"{name} of type {type(default).__name__}", repr(value), "correct the value")
    return value
