"""Registration of a cloud that a camera took of a wound: most of it may be something else than the bone.

Regions propose, lines of sight decide. Every region of the cloud proposes poses as if it were bone; all of them are
ranked by what the camera would have seen of the target, first roughly, then, refined on more and more points, at the
scale of the noise. What is left of soft tissue lies in front of the bone, never inside it: there a point has to be
nearer to count.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.config import ClutterConfig, RegistrarConfig
from gapr_core.geometry import one_view, sampling
from gapr_core.registration.fit.kernels import distinct
from gapr_core.registration.fit.verification import Candidates, markers, support
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.proposals import regions
from gapr_core.registration.proposals.regions import Region
from gapr_core.registration.scenes.free_space import SAME_SURFACE_COS, Visible
from gapr_core.registration.scenes.kernels import refine_agreeing
from gapr_core.registration.scenes.scene import Scene
from gapr_core.runtime.parallel import in_pieces, in_threads

Array = NDArray[np.float64]

NAME = "scene"
INFERRED_POINTS, INFERRED_ROUNDS = 2000, (2, 1)  # points that show the camera's place; rounds for each, likelier first
LEAST_COS = 0.3  # cosine of incidence that nearly all points of a camera's cloud exceed
ORIGIN_DEG, ORIGIN_COS = 35.0, 0.15  # a cloud so near to the z axis may be in the frame of its camera
ORIGIN_ROUNDS = 4  # rounds of regions for that place
AT_THE_BONE = ("pointer", "ultrasound")  # sensors without lines of sight
GIVEN = -1  # in place of the index of a region
SMALLEST_SCORE = 1e-4  # a score below, and so one below 0, counts as this


@dataclass(frozen=True, eq=False)
class Pool:
    """Hypotheses on their way.

    Attributes:
        poses: (K, 4, 4) T_target_source, mm.
        region: (K,) index of the region that proposed each; `GIVEN` for a pose that was given.
        scores: (K,) of lines of sight (`Visible.score`), large is good; 0 before the first stage, and comparable within
            one stage, since each has tolerances of its own.
    """

    poses: Array
    region: NDArray[np.int64]
    scores: Array

    def __getitem__(self, some: NDArray[np.int64]) -> Pool:
        return Pool(self.poses[some], self.region[some], self.scores[some])

    def __add__(self, other: Pool) -> Pool:
        poses = np.concatenate([self.poses, other.poses])
        return Pool(poses, np.append(self.region, other.region), np.append(self.scores, other.scores))


def sees_from_afar(config: RegistrarConfig) -> bool:
    """Whether the place of a camera is to be inferred at all: not of a sensor that is at the bone."""
    return config.clutter.infer_viewpoint and config.sensor.kind not in AT_THE_BONE


def inferred_places(source: PreparedSource, config: RegistrarConfig) -> list[tuple[Array, int]]:
    """Where a cloud was seen from if nobody says it: (3,) mm, source frame, and rounds of regions; the likeliest first.

    The origin, where the cloud may be in the frame of its camera, and both ends of the line of sight that its surface
    shows. None where it cannot be a camera's: too few points, some that are grazed from wherever the others are seen,
    or a sensor that sees nothing from afar.
    """
    if not sees_from_afar(config) or len(source.points) < config.source.dense_points:
        return []
    points, normals = source.points, source.normals
    places = []
    if one_view.seen_from_origin(points, normals, ORIGIN_DEG, ORIGIN_COS):
        places.append((np.zeros(3), ORIGIN_ROUNDS))
    some = source.order[:INFERRED_POINTS]
    view = one_view.seen_from_one_place(points, normals, source.neighbours, some, source.spacing_mm)
    if view.steepest_cos >= LEAST_COS:
        places += zip(view.viewpoints, INFERRED_ROUNDS, strict=True)
    return places


def in_rounds(scene: Scene, config: ClutterConfig) -> Iterator[Scene]:
    """The same scene with the regions of one round after the other; no region comes twice."""
    return (replace(scene, regions=found) for found in regions.rounds(scene.source, config))


def propose(scene: Scene, target: PreparedTarget, start: Array, config: ClutterConfig, num_threads: int = 0) -> Pool:
    """Hypotheses of all regions, each refined on its own region; and those to start from (K, 4, 4)."""
    steps = steps_on(target, config.region_limits_mm, config)

    def work(region: Region) -> Array:
        poses = regions.search(region, target, config).poses
        return steps.refined(poses, region.source, region.source.order[: config.region_points])

    found = in_threads(work, scene.regions, num_threads=num_threads)
    label = np.repeat(np.arange(GIVEN, len(found)), [len(start), *map(len, found)])
    return Pool(np.concatenate([start, *found]), label, np.zeros(len(label)))


def has_proposed(pool: Pool) -> bool:
    """Whether any of the hypotheses is a region's own: what was given alone has no rival."""
    return bool((pool.region != GIVEN).any())


def verify(
    pool: Pool,
    scene: Scene,
    target: PreparedTarget,
    config: ClutterConfig,
    num_threads: int = 0,
    start: Array | None = None,
) -> Candidates:
    """From all hypotheses to a few distinct ones, refined and ranked; the best comes first.

    Poses to start from (K, 4, 4) reach the last step as they are, too: around them there may be little bone.
    """
    crowd = refine_around(rank_roughly(pool, scene, target, config, num_threads), scene, target, config, num_threads)
    best = _best_distinct(crowd, scene, config, config.final_poses)
    best = refine_on_all(best if start is None else given(start) + best, scene, target, config, num_threads)
    shares = support(best.poses, crowd.poses, scene.source, config.markers, config.same_pose_mm)
    return Candidates(best.poses, small_is_good(best.scores), shares)


def small_is_good(scores: Array) -> Array:
    """(K,) scores of lines of sight as those of `Candidates`, where mean squares stand for other sources: 1 / score.

    What reads them, a rule or a feature, compares a rival with the best by their ratio. A pose that explains half as
    much of the bone is a rival of twice the score, just as one that leaves twice the mean square.
    """
    return np.asarray(1.0 / np.maximum(scores, SMALLEST_SCORE))


def rank_roughly(pool: Pool, scene: Scene, target: PreparedTarget, config: ClutterConfig, num_threads: int = 0) -> Pool:
    """The best distinct ones by what the camera would have seen, at the scale of what a region leaves open."""
    pool = _scored(pool, scene, target, config.coarse_points, config.coarse_on_mm, config.coarse_front_mm, num_threads)
    return _best_distinct(pool, scene, config, config.middle_poses)


def refine_around(
    pool: Pool, scene: Scene, target: PreparedTarget, config: ClutterConfig, num_threads: int = 0
) -> Pool:
    """Each refined on what lies around its region and hardly in front of the bone, and scored again."""
    steps = steps_on(target, config.middle_limits_mm, config, config.front_share)
    tree = cKDTree(scene.source.points[scene.source.order])
    poses = pool.poses.copy()

    def work(label: int) -> None:
        of_it = np.flatnonzero(pool.region == label)
        is_given = label == GIVEN
        near = np.arange(config.middle_points) if is_given else _around(tree, scene.regions[label].centre, config)
        some = scene.source.order[near[near < len(scene.source.order)]]
        poses[of_it] = steps.refined(pool.poses[of_it], scene.source, some)

    in_threads(work, np.unique(pool.region), num_threads=num_threads)
    pool = replace(pool, poses=poses)
    return _scored(pool, scene, target, config.middle_target_points, config.middle_on_mm, config.front_mm, num_threads)


def refine_on_all(
    pool: Pool, scene: Scene, target: PreparedTarget, config: ClutterConfig, num_threads: int = 0
) -> Pool:
    """Each refined on all points whose normals agree, ranked at the scale of the noise.

    Twice: on those hardly in front of the bone, which tissue pulls at less, and on both sides alike, which noise does
    not shift. The score decides.
    """
    some, refined = scene.source.order[: config.final_points], []
    for front_share in (1.0, config.front_share):
        steps = steps_on(target, config.final_limits_mm, config, front_share)
        refined += in_pieces(partial(steps.refined, source=scene.source, some=some), pool.poses, num_threads)
    pool = replace(pool + pool, poses=np.concatenate(refined))
    pool = replace(pool, scores=seen_of(pool.poses, scene, target, config, num_threads).score)
    return _best_distinct(pool, scene, config, config.kept_poses)


def seen_of(poses: Array, scene: Scene, target: PreparedTarget, config: ClutterConfig, num_threads: int = 0) -> Visible:
    """What the camera saw of the target under poses (K, 4, 4), at the scale of the noise."""
    points, normals = spread(target, config.final_target_points)
    return scene.compare(poses, points, normals, config.on_mm, config.front_mm, num_threads)


def _around(tree: cKDTree, centre: Array, config: ClutterConfig) -> NDArray[np.int64]:
    near = np.sort(tree.query_ball_point(centre, config.middle_reach_mm))
    return near[:: max(1, len(near) // config.middle_points)]


@dataclass(frozen=True, eq=False)
class Steps:
    """Gauss-Newton steps on a target: one per row of limits (I, 2), mm, on points whose normals agree up to a cosine.

    The limits are those of points inside and outside of the target.
    """

    target: PreparedTarget
    limits_mm: Array
    same_surface_cos: float

    def refined(self, poses: Array, source: PreparedSource, some: NDArray[np.int64]) -> Array:
        """Poses (K, 4, 4) refined on some of the points."""
        points, normals, surface = source.points[some], source.normals[some], self.target.kernel_view
        how = source.oriented, *surface, self.limits_mm, self.same_surface_cos
        return np.asarray(refine_agreeing(np.ascontiguousarray(poses), points, normals, *how))


def steps_on(
    target: PreparedTarget, limits_mm: tuple[float, float, int], config: ClutterConfig, front_share: float = 1.0
) -> Steps:
    """Of falling limits (first, last, how many), mm, and a share of each for points in front of the bone."""
    both = np.outer(np.linspace(*limits_mm), [1.0, front_share])
    return Steps(target, both, SAME_SURFACE_COS)


def _scored(
    pool: Pool, scene: Scene, target: PreparedTarget, count: int, on_mm: float, front_mm: float, num_threads: int
) -> Pool:
    points, normals = spread(target, count)
    seen = scene.compare(pool.poses, points, normals, on_mm, front_mm, num_threads)
    return replace(pool, scores=seen.score)


def spread(target: PreparedTarget, count: int) -> tuple[Array, Array]:
    """At most `count` evenly spread points of the target, where its sensor sees them, and normals; kept with it."""
    key = "spread", count, target.offset_mm
    if key not in target.cache:
        some = sampling.thin(target.points, count)
        normals = target.normals[some]
        target.cache[key] = target.points[some] + target.offset_mm * normals, normals
    return target.cache[key]  # type: ignore[no-any-return]


def given(poses: Array) -> Pool:
    """Hypotheses (K, 4, 4) that no region proposed."""
    return Pool(poses, np.full(len(poses), GIVEN), np.zeros(len(poses)))


def _best_distinct(pool: Pool, scene: Scene, config: ClutterConfig, most: int) -> Pool:
    ranked = np.argsort(-pool.scores, kind="stable")
    kept = distinct(markers(pool.poses, scene.source, config.markers), ranked, config.same_pose_mm, most)
    return pool[kept]
