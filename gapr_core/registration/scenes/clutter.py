"""Registration of a camera's cloud of a wound: regions propose poses as if they were bone, lines of sight decide.

Poses are ranked by the camera's view of the target: first roughly, then, refined on more and more points, at the scale
of the noise. Soft tissue lies in front of the bone, never inside it: there a point has to be nearer to count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core.config import ClutterConfig, RegistrarConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import one_view, sampling
from gapr_core.registration.fit.kernels import distinct
from gapr_core.registration.fit.verification import Candidates, markers, support
from gapr_core.registration.problem import source as sources
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
INFERRED_POINTS, INFERRED_ROUNDS = 2000, (2, 1)  # points that show the camera's place; rounds per place, likelier first
LEAST_COS = 0.3  # cosine of incidence that nearly all points of a camera's cloud exceed
ORIGIN_DEG, ORIGIN_COS = 35.0, 0.15  # a cloud this near to the z axis may be in the frame of its camera
ORIGIN_ROUNDS = 4  # rounds of regions for that place
AT_THE_BONE = ("pointer", "ultrasound")  # sensors without lines of sight
GIVEN = -1  # in place of the index of a region
SMALLEST_SCORE = 1e-4  # lower scores, negative ones too, count as this


@dataclass(frozen=True, eq=False)
class Pool:
    """Hypotheses between two stages."""

    poses: Array  # (K, 4, 4) T_target_source, mm
    region: NDArray[np.int64]  # (K,) index of the region that proposed each; `GIVEN` for a given pose
    # (K,) scores of lines of sight (`Visible.score`), large is good; 0 before the first stage. Comparable within one
    # stage, since each has tolerances of its own
    scores: Array

    def __getitem__(self, some: NDArray[np.int64]) -> Pool:
        return Pool(self.poses[some], self.region[some], self.scores[some])

    def __add__(self, other: Pool) -> Pool:
        poses = np.concatenate([self.poses, other.poses])
        return Pool(poses, np.append(self.region, other.region), np.append(self.scores, other.scores))


def sees_from_afar(config: RegistrarConfig) -> bool:
    """Return True where the place of a camera may be inferred: not for a sensor at the bone."""
    return config.clutter.infer_viewpoint and config.sensor.kind not in AT_THE_BONE


def inferred_places(source: PreparedSource, config: RegistrarConfig) -> list[tuple[Array, int]]:
    """Infer places, (3,) mm, source frame, that a cloud may be seen from, likeliest first, with their rounds.

    The origin, where the cloud may be in the frame of its camera, and both ends of the line of sight that its surface
    shows. None of too few points, of points grazed from there, or of a sensor that sees nothing from afar.
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


def possible_view(source: ArrayLike, config: RegistrarConfig) -> PreparedSource | None:
    """Prepare a source without a viewpoint as a possible view of a camera; None where it cannot be one."""
    if not sees_from_afar(config):
        return None
    try:
        scene = sources.prepare(source, config.source, config.num_threads, in_scene=True)
    except InvalidPointCloudError:
        return None  # some of all points are metres away; the fitted ones are not
    return scene if isinstance(scene, PreparedSource) else None


def propose(scene: Scene, target: PreparedTarget, start: Array, config: ClutterConfig, num_threads: int = 0) -> Pool:
    """Propose hypotheses of all regions, each refined on its own region, and the start poses (K, 4, 4)."""

    def work(region: Region) -> Array:
        poses, some = regions.search(region, target, config), region.source.order[: config.region_points]
        return refine_on(region.source, some, target, config.region_limits_mm, 1.0, poses)

    found = in_threads(work, scene.regions, num_threads=num_threads)
    label = np.repeat(np.arange(GIVEN, len(found)), [len(start), *map(len, found)])
    return Pool(np.concatenate([start, *found]), label, np.zeros(len(label)))


def verify(
    pool: Pool,
    scene: Scene,
    target: PreparedTarget,
    config: ClutterConfig,
    num_threads: int = 0,
    start: Array | None = None,
) -> Candidates:
    """Reduce all hypotheses to a few distinct ones, refined and ranked; the best comes first.

    Start poses (K, 4, 4) reach the last step as they are, too: around them there may be little bone.
    """
    crowd = refine_around(rank_roughly(pool, scene, target, config, num_threads), scene, target, config, num_threads)
    best = _best_distinct(crowd, scene, config, config.final_poses)
    best = refine_on_all(best if start is None else given(start) + best, scene, target, config, num_threads)
    shares = support(best.poses, crowd.poses, scene.source, config.markers, config.same_pose_mm)
    return Candidates(best.poses, 1.0 / np.maximum(best.scores, SMALLEST_SCORE), shares)


def rank_roughly(pool: Pool, scene: Scene, target: PreparedTarget, config: ClutterConfig, num_threads: int = 0) -> Pool:
    """Rank the distinct poses by the camera's view, within the tolerance of a fit to a region."""
    pool = _scored(pool, scene, target, config.coarse_points, config.coarse_on_mm, config.coarse_front_mm, num_threads)
    return _best_distinct(pool, scene, config, config.middle_poses)


def refine_around(
    pool: Pool, scene: Scene, target: PreparedTarget, config: ClutterConfig, num_threads: int = 0
) -> Pool:
    """Refine each pose on the points around its region and hardly in front of the bone, and score it again."""
    tree = cKDTree(scene.source.points[scene.source.order])
    poses = pool.poses.copy()

    def work(label: int) -> None:
        of_it = np.flatnonzero(pool.region == label)
        is_given = label == GIVEN
        near = np.arange(config.middle_points) if is_given else _around(tree, scene.regions[label].centre, config)
        some = scene.source.order[near[near < len(scene.source.order)]]
        how = target, config.middle_limits_mm, config.front_share
        poses[of_it] = refine_on(scene.source, some, *how, pool.poses[of_it])

    in_threads(work, np.unique(pool.region), num_threads=num_threads)
    pool = replace(pool, poses=poses)
    return _scored(pool, scene, target, config.middle_target_points, config.middle_on_mm, config.front_mm, num_threads)


def refine_on_all(
    pool: Pool, scene: Scene, target: PreparedTarget, config: ClutterConfig, num_threads: int = 0
) -> Pool:
    """Refine each pose on all points whose normals agree, and rank at the scale of the noise.

    Twice: hardly in front of the bone, where tissue pulls, and on both sides alike, as noise does not shift that.
    """
    some, refined = scene.source.order[: config.final_points], []
    for front_share in (1.0, config.front_share):
        refine = partial(refine_on, scene.source, some, target, config.final_limits_mm, front_share)
        refined += in_pieces(refine, pool.poses, num_threads)
    pool = replace(pool + pool, poses=np.concatenate(refined))
    pool = replace(pool, scores=seen_of(pool.poses, scene, target, config, num_threads).score)
    return _best_distinct(pool, scene, config, config.kept_poses)


def seen_of(poses: Array, scene: Scene, target: PreparedTarget, config: ClutterConfig, num_threads: int = 0) -> Visible:
    """Compare the camera's view with the target under poses (K, 4, 4), at the scale of the noise."""
    points, normals = spread(target, config.final_target_points)
    return scene.compare(poses, points, normals, config.on_mm, config.front_mm, num_threads)


def _around(tree: cKDTree, centre: Array, config: ClutterConfig) -> NDArray[np.int64]:
    near = np.sort(tree.query_ball_point(centre, config.middle_reach_mm))
    return near[:: max(1, len(near) // config.middle_points)]


def refine_on(
    source: PreparedSource,
    some: NDArray[np.int64],
    target: PreparedTarget,
    limits_mm: tuple[float, float, int],
    front_share: float,
    poses: Array,
) -> Array:
    """Refine poses (K, 4, 4) on some points, those whose normals agree with the target's, by falling limits.

    The limits (first, last, number), mm, are scaled by `front_share` in front of the bone.
    """
    both = np.outer(np.linspace(*limits_mm), [1.0, front_share])
    how = source.oriented, *target.kernel_view, both, SAME_SURFACE_COS
    return np.asarray(refine_agreeing(np.ascontiguousarray(poses), source.points[some], source.normals[some], *how))


def _scored(
    pool: Pool, scene: Scene, target: PreparedTarget, count: int, on_mm: float, front_mm: float, num_threads: int
) -> Pool:
    points, normals = spread(target, count)
    seen = scene.compare(pool.poses, points, normals, on_mm, front_mm, num_threads)
    return replace(pool, scores=seen.score)


def spread(target: PreparedTarget, count: int) -> tuple[Array, Array]:
    """Spread at most `count` points over the target, where its sensor sees them, with normals; kept with it."""
    key = "spread", count, target.offset_mm
    if key not in target.cache:
        some = sampling.thin(target.points, count)
        normals = target.normals[some]
        target.cache[key] = target.points[some] + target.offset_mm * normals, normals
    return target.cache[key]  # type: ignore[no-any-return]


def given(poses: Array) -> Pool:
    """Pool hypotheses (K, 4, 4) that no region proposed."""
    return Pool(poses, np.full(len(poses), GIVEN), np.zeros(len(poses)))


def _best_distinct(pool: Pool, scene: Scene, config: ClutterConfig, most: int) -> Pool:
    ranked = np.argsort(-pool.scores, kind="stable")
    kept = distinct(markers(pool.poses, scene.source, config.markers), ranked, config.same_pose_mm, most)
    return pool[kept]
