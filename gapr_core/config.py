"""Every setting of the registration with its default, unit, range and help: `gapr settings` lists them.

From Python: `RegistrarConfig(min_confidence=0.8)`. From a file: `gapr register --config FILE.yaml`. From the command
line: `--set refinement.iterations=5`. A value out of range raises `ConfigError`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

from gapr_core.errors import ConfigError
from gapr_core.runtime.settings import Settings, setting

TUKEY = "Tukey scale of the first and the last iteration, and the number of iterations"


@dataclass(frozen=True)
class TargetConfig(Settings):
    """How the target is prepared."""

    most_points: int = setting(10_000, "points of the outer shell", low=200, high=1_000_000)
    fewest_points: int = setting(200, "fewer distinct points are refused", low=50)
    normal_neighbours: int = setting(12, "points that give a normal", low=4, high=200)
    quadric_neighbours: int = setting(16, "points that give a surface element", low=10, high=200)
    misfit_neighbours: int = setting(10, "neighbours whose distance to an element is its misfit", low=1, high=200)
    misfit_gain: float = setting(0.5, "variance of an element over its mean square misfit", low=0.0, high=100.0)
    view_directions: int = setting(96, "directions from which the target is looked at to find its outside", low=6)
    flat_end_mm2: float = setting(200.0, "larger flat ends are left out; 0 keeps them", low=0, high=1e6, unit="mm^2")
    anchors: int = setting(1200, "points where the search places the source", low=10)
    field_reach_mm: float = setting(12.0, "reach of the distance field around the target", low=3, high=100, unit="mm")


@dataclass(frozen=True)
class SourceConfig(Settings):
    """How a source is cleaned and thinned."""

    fewest_points: int = setting(6, "fewer usable points are refused: as many as a pose has unknowns", low=6)
    most_points: int = setting(6000, "more points are thinned evenly", low=100, high=1_000_000)
    fitted_points: int = setting(
        1500, "of those kept so many, drawn at random, are fitted and assessed; of a camera's cloud all are", low=100
    )
    normal_neighbours: int = setting(30, "points that give a normal", low=4, high=200)
    smallest_width_mm: float = setting(2.0, "a narrower cloud is refused: a line", low=0, high=1000, unit="mm")
    most_raw_points: int = setting(100_000, "more are drawn from at random before the even thinning", low=1000)
    dense_points: int = setting(400, "points from which isolated points are looked for", low=20)
    companions: int = setting(6, "points that must be near a point, or it is isolated", low=1, high=1000)
    isolated_mm: float = setting(12.0, "points at this distance or less are near", low=0, high=1000, unit="mm")
    isolated_gaps: float = setting(5.0, "or at so many times the typical distance of the cloud", low=0, high=1000)
    most_compared: int = setting(20_000, "points among which companions are looked for", low=1000)


@dataclass(frozen=True)
class SearchConfig(Settings):
    """The weight-free search: reference points x anchors x spins, scored on the distance field."""

    references: int = setting(14, "points of the source that are laid on anchors", low=1, high=1000)
    spins: int = setting(36, "turns about the normal", low=1, high=360)
    probes: int = setting(32, "points of the source that score a pose", low=3, high=1000)
    first_probes: int = setting(8, "probes after which a bad pose is discarded", low=1, high=1000)
    first_limit_mm: float = setting(
        7.0, "mean distance of these probes above which a pose is bad", low=0, high=100, unit="mm"
    )
    keep: int = setting(1500, "poses that go to verification", low=16, high=100_000)


@dataclass(frozen=True)
class VerificationConfig(Settings):
    """Which proposals are refined further, and when two poses are the same."""

    coarse_points: int = setting(192, "points of the coarse step", low=10)
    coarse_limits_mm: tuple[float, float, int] = setting((10.0, 5.0, 6), TUKEY, low=0.1, unit="mm")
    middle_points: int = setting(300, "points of the middle step", low=10)
    middle_poses: int = setting(200, "poses that reach the middle step", low=1)
    middle_limits_mm: tuple[float, float, int] = setting((6.0, 4.0, 10), TUKEY, low=0.1, unit="mm")
    final_poses: int = setting(8, "distinct poses that are compared in the end", low=2, high=1000)
    final_limits_mm: tuple[float, float, int] = setting((5.0, 4.0, 8), TUKEY, low=0.1, unit="mm")
    same_pose_mm: float = setting(4.0, "poses nearer to each other (rms over the source) are one", low=0.1, unit="mm")
    markers: int = setting(16, "source points by which two poses are compared", low=3, high=1000)


@dataclass(frozen=True)
class RefinementConfig(Settings):
    """The last, robust point-to-surface refinement: Gauss-Newton until it converges."""

    rounds: int = setting(12, "most rounds; each has its own scale", low=1, high=1000)
    iterations: int = setting(3, "Gauss-Newton steps of a round", low=1, high=1000)
    tukey_scale: float = setting(3.0, "end of Tukey's weight, in standard deviations", low=1, high=100)
    clean_tukey_scale: float = setting(5.0, "the end where almost nothing lies beyond 3 of them", low=1, high=100)
    clean_share: float = setting(0.015, "share beyond 3 standard deviations that is almost nothing", low=0, high=1)
    rest_mm: float = setting(1e-3, "converged when the points move less than this", low=1e-9, high=1.0, unit="mm")
    free_rounds: int = setting(2, "first rounds in which no patch is distrusted", low=0, high=1000)
    patch_scale: float = setting(6.0, "end of Tukey's weight for a patch's mean residual, in its deviations", low=1)
    smallest_sigma_mm: float = setting(0.15, "least standard deviation of the residuals", low=1e-9, high=10, unit="mm")
    largest_sigma_mm: float = setting(3.0, "largest standard deviation of the residuals", low=1e-9, high=50, unit="mm")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.smallest_sigma_mm > self.largest_sigma_mm:
            what, given = "a smallest_sigma_mm that is not above largest_sigma_mm", f"{self.smallest_sigma_mm:g}"
            raise ConfigError(what, f"{given} and {self.largest_sigma_mm:g}", "lower it, or raise the other")


@dataclass(frozen=True)
class CovarianceConfig(Settings):
    """The errors of a source that the covariance allows for; `SensorConfig` says what is usual for a sensor."""

    correlation_mm: float = setting(
        20.0, "l of the bias's correlation exp(-d^2 / 2 l^2)", low=0.1, high=1000, unit="mm"
    )
    centres: int = setting(60, "points that span the bias", low=1, high=10_000)
    sizes_mm: tuple[float, ...] = setting(
        (0.005, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0),
        "standard deviations of the bias to choose from", low=1e-3, high=100, unit="mm",
    )  # fmt: skip
    smallest_share: float = setting(0.03, "least information of a usable field, over the largest", low=0, high=1)
    bias_gain: float = setting(2.1, "bias over what the residuals of a robust fit show of it", low=0, high=100)
    no_bias_mm: float = setting(0.035, "bias that residuals without any show on average", low=0, high=10, unit="mm")
    bias_spread: float = setting(1.0, "log standard deviation of the bias before the residuals", low=0.01, high=10)
    long_share: float = setting(0.5, "of the bias that all points share, over its size", low=0, high=10)
    linear_share: float = setting(
        0.6, "relative strain of the source times its root mean square radius, over the bias", low=0, high=10
    )
    local_correlation_mm: float = setting(
        8.0, "the same l of an error that near points share, such as that of a slice", low=0.1, high=1000, unit="mm"
    )
    local_centres: int = setting(160, "points that span that error", low=1, high=10_000)
    model_mm: float = setting(
        0.3, "standard deviation of an error by which the bone's model is too thick or too thin; 0: it is exact",
        low=0, high=10, unit="mm",
    )  # fmt: skip
    one_sided: float = setting(0.3, "length of the mean normal from which on a view has a beam", low=0, high=1)
    noise_points: float = setting(4.0, "points that the usual noise of the sensor is worth", low=0, high=1000)
    smooth_neighbours: int = setting(30, "points of an average that shows the smooth misfit", low=2, high=1000)
    short_neighbours: int = setting(12, "the same at short range, for the confidence alone", low=2, high=1000)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_ascending(self.sizes_mm)


def _check_ascending(sizes_mm: tuple[float, ...]) -> None:
    if len(sizes_mm) < 2 or any(small >= large for small, large in pairwise(sizes_mm)):
        raise ConfigError("two or more ascending sizes_mm", str(sizes_mm), "name the smallest size first")


# Each has an entry in `KINDS` of registration/problem/sensor.py.
SENSOR_KINDS = ("unknown", "pointer", "ultrasound", "depth_camera", "laser", "structured_light")


@dataclass(frozen=True)
class SensorConfig(Settings):
    """What measured the source; where a value is None, what is usual for the kind is taken."""

    kind: str = setting("unknown", "what measured the source", choices=SENSOR_KINDS)
    standoff_mm: float | None = setting(
        None, "mean distance of the points outside of the bone, which is subtracted", low=-10, high=10, unit="mm"
    )
    noise_mm: float | None = setting(None, "standard deviation of a point", low=1e-3, high=10, unit="mm")
    bias_mm: float | None = setting(None, "standard deviation of the smooth bias", low=1e-3, high=10, unit="mm")
    scale: float | None = setting(None, "standard deviation of the relative error of size", low=0, high=0.2)
    tracking_mm: float | None = setting(
        None, "standard deviation of an error of the whole cloud's place", low=0, high=10, unit="mm"
    )
    tracking_deg: float | None = setting(
        None, "the same of its attitude, about its centroid", low=0, high=10, unit="deg"
    )
    sparse_points: int = setting(2000, "with more points the stand-off of an unknown sensor falls as 1 / N", low=1)
    known_standoff_mm: float = setting(
        0.15, "standard deviation of a stand-off that is stated: contact is never full", low=1e-3, high=10, unit="mm"
    )


@dataclass(frozen=True)
class ScaleConfig(Settings):
    """How far the size of a source may be off, or it is of another bone. The confidence was fitted with these."""

    fewest_points: int = setting(8, "fewer inliers say nothing about the size", low=8, high=1000)
    widest: float = setting(0.3, "prior standard deviation of the relative size", low=0.01, high=1)
    standoff_mm: float = setting(0.5, "prior standard deviation of a stand-off", low=1e-3, high=10, unit="mm")
    sure: float = setting(0.005, "standard deviation of the relative size of the bone's model", low=0, high=0.1)
    usual: float = setting(0.05, "standard deviation of the relative sizes of other subjects' bones", low=1e-3, high=1)


@dataclass(frozen=True)
class SmoothBiasConfig(Settings):
    """The smooth bias that an accepted pose is corrected for (`gapr_core.registration.uncertainty.smooth_bias`)."""

    correlation_mm: float = setting(20.0, "l of its correlation exp(-d^2 / 2 l^2)", low=0.1, high=1000, unit="mm")
    centres: int = setting(60, "points that span it", low=1, high=10_000)
    sizes_mm: tuple[float, ...] = setting(
        (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0),
        "standard deviations to choose from", low=1e-3, high=100, unit="mm",
    )  # fmt: skip
    evidence: float = setting(2.0, "log likelihood ratio from which a bias is believed; infinity: never", low=0)
    smallest_share: float = setting(0.15, "information of a field over the largest, to have a say", low=0, high=1)
    iterations: int = setting(2, "steps of the pose", low=1, high=100)
    fewest_points: int = setting(200, "inliers without which no bias is looked for", low=10)
    largest_move: float = setting(22.5, "largest squared Mahalanobis distance of a move (chi square: 99.9 %)", low=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_ascending(self.sizes_mm)


@dataclass(frozen=True)
class RulesConfig(Settings):
    """When a pose may as well be another one, and is refused whatever its probability."""

    largest_turn_deg: float = setting(6.0, "standard deviation of a rotation that is not observed", low=0, unit="deg")
    largest_shift_mm: float = setting(5.0, "standard deviation of a shift that is not observed", low=0, unit="mm")
    equal_share: float = setting(0.015, "a rival whose mean square is larger by less is as good", low=0, high=1)
    equal_mm: float = setting(0.25, "the same as a length, whose square is added", low=0, high=10, unit="mm")
    largest_scale_z: float = setting(
        3.0, "standard deviations by which the size of a source may be off; more is another bone", low=0
    )
    other_size_better: float = setting(
        0.5, "log of mean squares by which a source grown or shrunk may fit better; more is another bone", low=0
    )
    mirrored_better: float = setting(
        0.01, "log of mean squares by which the mirrored source may fit better; more is another side", low=0
    )
    mirrored_points: int = setting(
        400, "a source of at most so many points is registered mirrored as well", low=0, high=1_000_000
    )
    mirrored_below: float = setting(0.95, "so is one whose answer is less sure than this, a scene too", low=0, high=1)
    push: float = setting(1.5, "how far a pose is pushed, in units of verification.same_pose_mm", low=1, high=100)
    pushed_motions: int = setting(
        3, "motions along which a pose is pushed; on a plane so many are not observed", low=1, high=6
    )
    ruled_out: float = setting(0.4, "largest confidence of a pose that a rule refuses", low=0, high=1)
    independent_points: float = setting(
        30.0, "independent residuals that a source counts for where hypotheses share the probability", low=0
    )


@dataclass(frozen=True)
class LimitsConfig(Settings):
    """What no pose can be sure of (`gapr_core.registration.checks.limits`)."""

    most: float = setting(0.89, "largest confidence where a limit holds; 1: none does", low=0, high=1)
    few_points: int = setting(250, "fewer near points show neither whose bone nor what size it is", low=0, high=10**6)
    noise_kept: tuple[float, float] = setting(
        (0.6, 1.3), "residuals over a stated noise between which they do say it", low=0, high=100
    )
    noise_exceeded: float = setting(2.5, "residuals over the known noise from which on they do not", low=0, high=100)
    model_mm: float = setting(0.3, "error of a bone's model from place to place", low=0, high=10, unit="mm")
    bias_exceeded: float = setting(1.25, "smooth misfit over what is known from which on they do not", low=0, high=100)
    shared_noise: float = setting(0.5, "share of a sensor's noise that near points may share", low=0, high=1)
    model_bias_mm: float = setting(0.1, "smooth error of the model of a bone", low=0, high=10, unit="mm")
    rough_exceeded: float = setting(
        0.4, "rough misfit in a scene over the scale of its residuals from which on they do not", low=0, high=100
    )
    covered: float = setting(0.9, "least share of the covariance within 4 mm and 5 deg", low=0, high=1)
    loose_mm: float = setting(5.0, "a larger tre95_mm does not say whose bone it is", low=0, high=1000, unit="mm")
    standoff_mm: float = setting(3.5, "no residual shows that a larger stated one is right", low=0, high=100, unit="mm")


@dataclass(frozen=True)
class CorticesConfig(Settings):
    """Sources that follow the inner and the outer cortex of a hollow bone."""

    share: float = setting(
        0.82, "residual scale to both cortices over that to the outer, below which both are followed", low=0, high=1
    )
    noise: float = setting(
        1.5, "residual scale to both cortices over the noise of the source, below which both are followed", low=0
    )
    largest_confidence: float = setting(0.85, "of such a source: the models were not fitted on any", low=0, high=1)


@dataclass(frozen=True)
class AccumulationConfig(Settings):
    """Which sources an `Accumulator` keeps."""

    off: float = setting(2.5, "a source so many times farther off the bone than all together is discarded", low=1)
    most_off: int = setting(3, "after so many of them in a row the bone has moved", low=1, high=1000)
    fewest_points: int = setting(20, "points of a source that is checked by itself; of fewer with those before", low=3)
    most_points: int = setting(6000, "kept of one source, and compared with", low=100, high=1_000_000)


@dataclass(frozen=True)
class RigidityConfig(Settings):
    """Whether what was measured is one rigid piece (`gapr_core.registration.checks.rigidity`)."""

    creeps: float = setting(
        6.0, "log likelihood ratio above which collected sources show that the bone moves; infinity: never", low=0
    )
    strained: float = setting(
        3.0, "log likelihood ratio above which a source shows that it is strained; infinity: never", low=0
    )
    apart: float = setting(
        6.0, "log likelihood ratio above which a source shows two halves in two poses; infinity: never", low=0
    )
    layered: float = setting(
        4.0, "log likelihood ratio above which a layer on the bone grows along a source; infinity: never", low=0
    )
    fewest_points: int = setting(200, "inliers without which none of these is looked for", low=12, high=1_000_000)
    doubled: float = setting(0.5, "as probable a pose makes rejected points a copy of the bone; above 1: never", low=0)
    doubled_share: float = setting(0.15, "with more points rejected a copy may lie anywhere on the bone", low=0, high=1)
    rejected_points: int = setting(30, "with fewer rejected points no copy is looked for", low=12, high=1_000_000)
    cells: int = setting(40, "cells over which residuals are averaged", low=12, high=1000)
    groups: int = setting(6, "groups of sources in time, whose residuals are averaged apart", low=2, high=100)
    correlation_mm: float = setting(
        20.0, "l of a smooth bias's correlation exp(-d^2 / 2 l^2)", low=0.1, high=1000, unit="mm"
    )


@dataclass(frozen=True)
class EvidenceConfig(Settings):
    """How the frames of a stream are combined (`gapr_core.registration.streams.evidence`)."""

    correlation: float = setting(0.8, "of two frames: 0 independent, 1 the same again", low=0, high=1)
    memory: float = setting(10.0, "frames after which a frame's weight has fallen to about 1/e", low=1)
    agree_mm: float = setting(15.0, "largest motion between frames (rms) that continues a track", low=0, unit="mm")
    stands: float = setting(
        0.8, "after a sure source a tracked answer of this confidence needs no search; above 1: it does", low=0, high=2
    )


@dataclass(frozen=True)
class FollowingConfig(Settings):
    """How far a pose is followed without an assessment (`gapr_core.registration.streams.following`)."""

    points: int = setting(1000, "points of a source that are refined", low=100, high=1_000_000)
    most_sources: int = setting(5, "sources in a row that are followed; then one is assessed", low=0, high=1000)
    largest_tre95_mm: float = setting(
        4.0, "largest bound of the error; that of a source whose view is weaker is larger", low=0, unit="mm"
    )
    largest_turn_deg: float = setting(2.5, "standard deviation of the least certain turn", low=0, unit="deg")
    largest_residual: float = setting(1.1, "residual over that of the assessed source", low=1, high=100)
    least_inliers: float = setting(0.95, "inlier ratio over that of the assessed source", low=0, high=1)


@dataclass(frozen=True)
class GuidanceConfig(Settings):
    """What a further look at the bone is assumed to give."""

    patch_mm: float = setting(30.0, "diameter of what a look shows", low=1, high=1000, unit="mm")
    patches: int = setting(250, "places that are compared", low=1, high=100_000)
    points: int = setting(60, "points of a look", low=1, high=100_000)
    noise_mm: float = setting(0.5, "least white noise of a point", low=1e-3, high=100, unit="mm")
    bias_mm: float = setting(0.7, "least bias that the points of a look share", low=0, high=100, unit="mm")
    seen_mm: float = setting(6.0, "a target point with a source point this near counts as seen", low=0, unit="mm")
    rivals: int = setting(50, "the likeliest other poses that a look is to exclude", low=0, high=100_000)


@dataclass(frozen=True)
class FreeSpaceConfig(Settings):
    """What a camera would have seen of a pose, point by point on its lines of sight."""

    smallest_pixel: float = setting(0.003, "least width of a pixel, as the tangent of an angle", low=1e-4, high=1)
    most_pixels: int = setting(160_000, "most pixels of the image; they grow where there would be more", low=100)
    reach: float = setting(0.006, "tangent up to which a point speaks for a line of sight", low=1e-4, high=1)
    widest_cos: float = setting(0.25, "cosine to the middle of the view up to which points are seen", low=0.01, high=1)
    facing_cos: float = setting(0.2, "cosine to the line of sight from which a surface is measured", low=0, high=1)
    hidden_mm: float = setting(3.0, "bone farther behind the measured point is hidden", low=0, unit="mm")
    slant_mm: float = setting(9.0, "largest difference in depth to a point in whose plane bone lies", low=0, unit="mm")
    same_surface_cos: float = setting(0.6, "cosine of normals up to which they are of one surface", low=0, high=1)
    violation_costs: float = setting(2.0, "cost of a share of the bone that the camera looked through", low=0)
    misfit_costs: float = setting(0.2, "cost of a share of the bone that lies off the measured surface", low=0)


@dataclass(frozen=True)
class ClutterConfig(Settings):
    """Clouds of a camera that saw more than bone: regions propose, lines of sight decide."""

    radii_mm: tuple[float, ...] = setting((30.0, 45.0), "radii of the regions that propose", low=5, unit="mm")
    seeds: tuple[int, ...] = setting((12, 6), "regions of each radius in a round", low=1, high=1000)
    rounds: int = setting(4, "rounds of other regions, until an answer is sure", low=1, high=100)
    hopeless: float = setting(0.1, "two in a row below, from a place that was inferred, are the last", low=0, high=1)
    smooth_neighbours: int = setting(8, "points, itself first, whose plane a point has and may share", low=3, high=200)
    bend_deg: float = setting(20.0, "larger angles between two planes are a fold", low=1, high=90, unit="deg")
    step_deg: float = setting(30.0, "neighbours farther above a plane are a step", low=1, high=90, unit="deg")
    references: int = setting(4, "points of a region that are laid on anchors", low=1, high=1000)
    spins: int = setting(24, "turns about the normal", low=1, high=360)
    probes: int = setting(32, "points of a region that score a pose", low=3, high=1000)
    first_limit_mm: float = setting(
        5.0, "mean distance of the first probes above which a pose is bad", low=0, high=100, unit="mm"
    )
    keep: int = setting(150, "poses that a region proposes", low=1, high=100_000)
    region_points: int = setting(64, "points of a region that refine its poses", low=10)
    region_limits_mm: tuple[float, float, int] = setting((8.0, 4.0, 4), TUKEY, low=0.1, unit="mm")
    coarse_points: int = setting(500, "target points of the coarse step", low=10)
    coarse_on_mm: float = setting(
        5.0, "coarse step: target points this near to the measured surface agree", low=0.01, unit="mm"
    )
    coarse_front_mm: float = setting(
        6.0, "coarse step: target points farther in front of it are impossible", low=0.01, unit="mm"
    )
    middle_poses: int = setting(500, "poses that reach the middle step", low=1)
    middle_reach_mm: float = setting(60.0, "around its region a pose is refined", low=5, unit="mm")
    middle_points: int = setting(300, "points of the middle step", low=10)
    middle_limits_mm: tuple[float, float, int] = setting((8.0, 2.5, 8), TUKEY, low=0.1, unit="mm")
    middle_target_points: int = setting(1500, "target points of the middle step", low=10)
    middle_on_mm: float = setting(2.5, "as coarse_on_mm, in the middle step", low=0.01, unit="mm")
    final_poses: int = setting(100, "poses that reach the final step", low=1)
    final_points: int = setting(1200, "points of the final step", low=10)
    final_limits_mm: tuple[float, float, int] = setting((5.0, 2.0, 8), TUKEY, low=0.1, unit="mm")
    final_target_points: int = setting(4000, "target points of the final step", low=10)
    front_share: float = setting(
        0.6, "of the middle and the final limits for points in front of the bone, where tissue lies", low=0.05, high=1
    )
    on_mm: float = setting(0.6, "as coarse_on_mm, in the final step", low=0.01, unit="mm")
    front_mm: float = setting(3.0, "as coarse_front_mm, in the middle and the final step", low=0.01, unit="mm")
    same_pose_mm: float = setting(4.0, "closer poses are the same", low=0, unit="mm")
    kept_poses: int = setting(8, "poses that are kept", low=2)
    part_mm: float = setting(2.5, "a point this near to the bone may be explained by it", low=0.1, unit="mm")
    region_fewest_points: int = setting(40, "fewer points are no region", low=10)
    levelled_by: int = setting(12, "neighbours over which the noise of a measured depth is averaged", low=1, high=200)
    markers: int = setting(16, "points by which two poses are compared", low=3, high=1000)
    infer_viewpoint: bool = setting(True, "a dense cloud without one that is refused as bone may be a camera's")
    inferred_points: int = setting(2000, "points by whose normals the place of its camera is inferred", low=10)
    inferred_rounds: tuple[int, int] = setting((2, 1), "rounds of regions for each place, the likelier first", low=1)
    inferred_least: float = setting(0.85, "least confidence of a pose that rests on such a place", low=0, high=1)
    least_cos: float = setting(0.3, "cosine of incidence that nearly all points of such a cloud exceed", low=0, high=1)
    origin_deg: float = setting(
        35.0, "a cloud so near to the z axis may be in the frame of its camera; 0: none is", low=0, high=90, unit="deg"
    )
    origin_cos: float = setting(0.15, "cosine of incidence that nearly all points exceed there", low=0, high=1)
    origin_rounds: int = setting(4, "rounds of regions for that place", low=1, high=100)
    free_space: FreeSpaceConfig = field(default_factory=FreeSpaceConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.seeds) != len(self.radii_mm):
            given = f"{self.seeds} for {self.radii_mm}"
            raise ConfigError("seeds for each of radii_mm", given, "name as many seeds as radii_mm")
        if not self.radii_mm:
            raise ConfigError("at least one of radii_mm", "none", "name one, and its seeds")


@dataclass(frozen=True)
class PartConfig(Settings):
    """The part of a scene that a pose explains, and when the rest is the reason of a refusal."""

    agreeing_cos: float = setting(0.7, "cosine of normals up to which a point may lie on the bone", low=0, high=1)
    crowd: int = setting(12, "neighbours that are asked whether they lie on it, too", low=1, high=200)
    most_alone: float = setting(0.5, "share of them that must exceed this", low=0, high=1)
    fewest_points: int = setting(30, "of a part; else the whole cloud is refined on", low=6)
    rounds: int = setting(2, "of choosing the part and refining on it", low=1, high=100)
    mostly_clutter: float = setting(0.5, "share that counts for the pose, below which clutter is named", low=0, high=1)
    mostly_off: float = setting(0.4, "the same without a viewpoint, as the share on the bone", low=0, high=1)


@dataclass(frozen=True)
class RegistrarConfig(Settings):
    """Every setting of a `Registrar`."""

    target: TargetConfig = field(default_factory=TargetConfig)
    source: SourceConfig = field(default_factory=SourceConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    clutter: ClutterConfig = field(default_factory=ClutterConfig)
    part: PartConfig = field(default_factory=PartConfig)
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    scale: ScaleConfig = field(default_factory=ScaleConfig)
    smooth_bias: SmoothBiasConfig = field(default_factory=SmoothBiasConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    rules: RulesConfig = field(default_factory=RulesConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    cortices: CorticesConfig = field(default_factory=CorticesConfig)
    accumulation: AccumulationConfig = field(default_factory=AccumulationConfig)
    rigidity: RigidityConfig = field(default_factory=RigidityConfig)
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    following: FollowingConfig = field(default_factory=FollowingConfig)
    guide: bool = setting(False, "say with every answer where another look would help most")
    min_confidence: float = setting(0.5, "poses with a lower confidence are refused", low=0, high=1)
    max_tre_mm: float = setting(0.0, "poses whose tre95_mm is larger are refused; 0: off", low=0, unit="mm")
    searched_below: float = setting(
        0.8, "a less confident answer goes to the next proposer; so does one from limits.most to sure", low=0, high=2
    )
    sure: float = setting(0.95, "nothing more is tried: no proposer, no regions, no search", low=0, high=2)
    num_threads: int = setting(0, "threads of a registration and its target; 0: all cores", low=0, high=1024)
    seed: int = setting(
        0, "seed of proposers that draw (ransac); other draws are always the same", low=0, high=2**31 - 1
    )

    @property
    def worth_checking(self) -> float:
        """Probability from which on the costly checks are asked: a stream raises it to its root at most."""
        return self.min_confidence**2

    @property
    def accepted_if_inferred(self) -> float:
        """Probability from which on a pose is accepted that rests on an inferred viewpoint; else `min_confidence`."""
        return max(self.min_confidence, self.clutter.inferred_least)

    @property
    def sure_from(self) -> float:
        """Probability from which on nothing more is tried."""
        return max(self.sure, self.min_confidence)
