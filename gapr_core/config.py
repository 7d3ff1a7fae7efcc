"""Settings of the registration with their defaults, units, ranges and helps; `gapr settings` lists them.

From Python: `RegistrarConfig(min_confidence=0.8)`. From a file: `gapr register --config FILE.yaml`. From the command
line: `--set refinement.iterations=5`. A value out of range raises `ConfigError`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from gapr_core.errors import ConfigError
from gapr_core.runtime.settings import Settings, setting

TUKEY = "Tukey scale of the first and the last iteration, and the number of iterations"


@dataclass(frozen=True)
class TargetConfig(Settings):
    """Preparation of the target."""

    most_points: int = setting(10_000, "points of the outer shell", low=200, high=1_000_000)
    fewest_points: int = setting(200, "fewer distinct points are refused", low=50)
    normal_neighbours: int = setting(12, "points that give a normal", low=4, high=200)
    quadric_neighbours: int = setting(16, "points that give a surface element", low=10, high=200)
    misfit_neighbours: int = setting(10, "neighbours whose distance to an element is its misfit", low=1, high=200)
    misfit_gain: float = setting(0.5, "variance of an element over its mean square misfit", low=0.0, high=100.0)
    view_directions: int = setting(96, "directions of view that find the outside of the target", low=6)
    flat_end_mm2: float = setting(200.0, "larger flat ends are left out; 0 keeps them", low=0, high=1e6, unit="mm^2")
    anchors: int = setting(1200, "points where the search places the source", low=10)
    field_reach_mm: float = setting(12.0, "reach of the distance field around the target", low=3, high=100, unit="mm")


@dataclass(frozen=True)
class SourceConfig(Settings):
    """Cleaning and thinning of a source."""

    fewest_points: int = setting(6, "fewer usable points are refused: as many as a pose has unknowns", low=6)
    most_points: int = setting(6000, "more points are thinned evenly", low=100, high=1_000_000)
    fitted_points: int = setting(
        1500, "kept points that are fitted and assessed, drawn at random; of a camera's cloud all are", low=100
    )
    normal_neighbours: int = setting(30, "points that give a normal", low=4, high=200)
    smallest_width_mm: float = setting(2.0, "a narrower cloud is refused: a line", low=0, high=1000, unit="mm")
    most_raw_points: int = setting(30_000, "larger clouds are first thinned to this number at random", low=1000)
    dense_points: int = setting(400, "least points of a cloud for the removal of isolated points", low=20)
    companions: int = setting(6, "a point with fewer near points is isolated", low=1, high=1000)
    isolated_mm: float = setting(12.0, "points at this distance or less are near", low=0, high=1000, unit="mm")
    isolated_gaps: float = setting(5.0, "or at this multiple of the typical distance of the cloud", low=0, high=1000)
    most_compared: int = setting(20_000, "points among which companions are searched", low=1000)


@dataclass(frozen=True)
class SearchConfig(Settings):
    """The weight-free search: reference points x anchors x spins, scored on the distance field."""

    references: int = setting(14, "points of the source to lay on anchors", low=1, high=1000)
    spins: int = setting(36, "turns about the normal", low=1, high=360)
    probes: int = setting(32, "points of the source that score a pose", low=3, high=1000)
    first_probes: int = setting(8, "probes after which a bad pose is discarded", low=1, high=1000)
    first_limit_mm: float = setting(
        7.0, "mean distance of these probes above which a pose is bad", low=0, high=100, unit="mm"
    )
    keep: int = setting(1500, "poses that go to verification", low=16, high=100_000)


@dataclass(frozen=True)
class VerificationConfig(Settings):
    """Selection of the proposals to refine further, and the limit of equal poses."""

    coarse_points: int = setting(192, "points of the coarse step", low=10)
    coarse_limits_mm: tuple[float, float, int] = setting((10.0, 5.0, 6), TUKEY, low=0.1, unit="mm")
    middle_points: int = setting(300, "points of the middle step", low=10)
    middle_poses: int = setting(200, "poses that reach the middle step", low=1)
    middle_limits_mm: tuple[float, float, int] = setting((6.0, 4.0, 10), TUKEY, low=0.1, unit="mm")
    final_poses: int = setting(8, "distinct poses compared in the end", low=2, high=1000)
    final_limits_mm: tuple[float, float, int] = setting((5.0, 4.0, 8), TUKEY, low=0.1, unit="mm")
    same_pose_mm: float = setting(4.0, "poses nearer to each other (rms over the source) are one", low=0.1, unit="mm")
    markers: int = setting(16, "source points of the comparison of two poses", low=3, high=1000)


@dataclass(frozen=True)
class RefinementConfig(Settings):
    """The last, robust point-to-surface refinement: Gauss-Newton until it converges."""

    rounds: int = setting(12, "most rounds; each has its own scale", low=1, high=1000)
    iterations: int = setting(3, "Gauss-Newton steps of a round", low=1, high=1000)
    tukey_scale: float = setting(3.0, "end of Tukey's weight, in standard deviations", low=1, high=100)
    clean_tukey_scale: float = setting(5.0, "the same where almost no residual lies beyond 3 of them", low=1, high=100)
    clean_share: float = setting(0.015, "largest share beyond 3 standard deviations for that", low=0, high=1)
    rest_mm: float = setting(1e-3, "converged when the points move less than this", low=1e-9, high=1.0, unit="mm")
    free_rounds: int = setting(2, "first rounds in which no patch is distrusted", low=0, high=1000)
    patch_scale: float = setting(6.0, "end of Tukey's weight for a patch's mean residual, in its deviations", low=1)
    smallest_sigma_mm: float = setting(0.15, "least standard deviation of the residuals", low=1e-9, high=10, unit="mm")
    largest_sigma_mm: float = setting(3.0, "largest standard deviation of the residuals", low=1e-9, high=50, unit="mm")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.smallest_sigma_mm > self.largest_sigma_mm:
            expected, given = "a smallest_sigma_mm that is not above largest_sigma_mm", f"{self.smallest_sigma_mm:g}"
            raise ConfigError(expected, f"{given} and {self.largest_sigma_mm:g}", "lower it, or raise the other")


@dataclass(frozen=True)
class CovarianceConfig(Settings):
    """Errors of the bone's model in the covariance."""

    model_mm: float = setting(
        0.3, "standard deviation of the thickness error of the bone's model; 0: it is exact",
        low=0, high=10, unit="mm",
    )  # fmt: skip


# Each kind has an entry in `KINDS` of registration/problem/sensor.py.
SENSOR_KINDS = ("unknown", "pointer", "ultrasound", "depth_camera", "laser", "structured_light")


@dataclass(frozen=True)
class SensorConfig(Settings):
    """The sensor of the source; a value of None stands for the usual one of its kind."""

    kind: str = setting("unknown", "kind of the sensor of the source", choices=SENSOR_KINDS)
    standoff_mm: float | None = setting(
        None, "mean distance of the points outside of the bone, which is subtracted", low=-10, high=10, unit="mm"
    )
    noise_mm: float | None = setting(None, "standard deviation of a point", low=1e-3, high=10, unit="mm")
    bias_mm: float | None = setting(None, "standard deviation of the smooth bias", low=1e-3, high=10, unit="mm")
    scale: float | None = setting(None, "standard deviation of the relative error of size", low=0, high=0.2)
    tracking_mm: float | None = setting(
        None, "standard deviation of the error of the whole cloud's place", low=0, high=10, unit="mm"
    )
    tracking_deg: float | None = setting(
        None, "the same of its attitude, about its centroid", low=0, high=10, unit="deg"
    )
    sparse_points: int = setting(2000, "with more points the stand-off of an unknown sensor falls as 1 / N", low=1)
    known_standoff_mm: float = setting(
        0.15, "standard deviation of a stated stand-off: contact is never full", low=1e-3, high=10, unit="mm"
    )


@dataclass(frozen=True)
class ClutterConfig(Settings):
    """Clouds of a camera that show more than bone: regions propose, lines of sight decide."""

    radii_mm: tuple[float, ...] = setting((30.0, 45.0), "radii of the proposing regions", low=5, unit="mm")
    seeds: tuple[int, ...] = setting((12, 6), "regions of each radius in a round", low=1, high=1000)
    rounds: int = setting(4, "rounds of other regions, until an answer is sure", low=1, high=100)
    hopeless: float = setting(0.1, "two rounds in a row below end the search from an inferred place", low=0, high=1)
    smooth_neighbours: int = setting(8, "neighbours, itself first, of the plane that a point shares", low=3, high=200)
    bend_deg: float = setting(20.0, "larger angles between two planes are a fold", low=1, high=90, unit="deg")
    step_deg: float = setting(30.0, "neighbours farther above a plane are a step", low=1, high=90, unit="deg")
    references: int = setting(4, "points of a region to lay on anchors", low=1, high=1000)
    spins: int = setting(24, "turns about the normal", low=1, high=360)
    probes: int = setting(32, "points of a region that score a pose", low=3, high=1000)
    first_limit_mm: float = setting(
        5.0, "mean distance of the first probes above which a pose is bad", low=0, high=100, unit="mm"
    )
    keep: int = setting(150, "poses that a region proposes", low=1, high=100_000)
    region_points: int = setting(64, "points of a region for the refinement of its poses", low=10)
    region_limits_mm: tuple[float, float, int] = setting((8.0, 4.0, 4), TUKEY, low=0.1, unit="mm")
    coarse_points: int = setting(500, "target points of the coarse step", low=10)
    coarse_on_mm: float = setting(
        5.0, "coarse step: target points this near to the measured surface agree", low=0.01, unit="mm"
    )
    coarse_front_mm: float = setting(
        6.0, "coarse step: target points farther in front of it are impossible", low=0.01, unit="mm"
    )
    middle_poses: int = setting(500, "poses that reach the middle step", low=1)
    middle_reach_mm: float = setting(60.0, "reach around its region within which a pose is refined", low=5, unit="mm")
    middle_points: int = setting(300, "points of the middle step", low=10)
    middle_limits_mm: tuple[float, float, int] = setting((8.0, 2.5, 8), TUKEY, low=0.1, unit="mm")
    middle_target_points: int = setting(1500, "target points of the middle step", low=10)
    middle_on_mm: float = setting(2.5, "as coarse_on_mm, in the middle step", low=0.01, unit="mm")
    final_poses: int = setting(100, "poses that reach the final step", low=1)
    final_points: int = setting(1200, "points of the final step", low=10)
    final_limits_mm: tuple[float, float, int] = setting((5.0, 2.0, 8), TUKEY, low=0.1, unit="mm")
    final_target_points: int = setting(4000, "target points of the final step", low=10)
    front_share: float = setting(
        0.6, "share of the middle and final limits for points in front of the bone, where tissue lies", low=0.05, high=1
    )
    on_mm: float = setting(0.6, "as coarse_on_mm, in the final step", low=0.01, unit="mm")
    front_mm: float = setting(3.0, "as coarse_front_mm, in the middle and the final step", low=0.01, unit="mm")
    same_pose_mm: float = setting(4.0, "closer poses are the same", low=0, unit="mm")
    kept_poses: int = setting(8, "poses to keep", low=2)
    part_mm: float = setting(2.5, "distance from the bone up to which it may explain a point", low=0.1, unit="mm")
    region_fewest_points: int = setting(40, "fewer points are no region", low=10)
    levelled_by: int = setting(12, "neighbours for the average of a measured depth", low=1, high=200)
    markers: int = setting(16, "points of the comparison of two poses", low=3, high=1000)
    infer_viewpoint: bool = setting(True, "a dense cloud without a viewpoint, refused as bone, may be a camera's")

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.seeds) != len(self.radii_mm):
            given = f"{self.seeds} for {self.radii_mm}"
            raise ConfigError("seeds for each of radii_mm", given, "name as many seeds as radii_mm")
        if not self.radii_mm:
            raise ConfigError("at least one of radii_mm", "none", "name one, and its seeds")


@dataclass(frozen=True)
class RegistrarConfig(Settings):
    """Every setting of a `Registrar`."""

    target: TargetConfig = field(default_factory=TargetConfig)
    source: SourceConfig = field(default_factory=SourceConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    clutter: ClutterConfig = field(default_factory=ClutterConfig)
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    guide: bool = setting(False, "add to every answer where another look would help most")
    min_confidence: float = setting(0.5, "poses with a lower confidence are refused", low=0, high=1)
    other_bone_prior: float = setting(
        0.3, "probability, before the data, that the source is of another subject's bone", low=0, high=1
    )
    max_tre_mm: float = setting(0.0, "poses whose tre95_mm is larger are refused; 0: off", low=0, unit="mm")
    sure: float = setting(0.95, "confidence from which no other proposer and no region is tried", low=0, high=2)
    num_threads: int = setting(0, "threads of a registration and its target; 0: all cores", low=0, high=1024)

    @property
    def worth_checking(self) -> float:
        """Least probability for the costly checks: a stream raises a probability at most to its square root."""
        return self.min_confidence**2

    @property
    def sure_from(self) -> float:
        """Probability from which nothing more is tried."""
        return max(self.sure, self.min_confidence)
