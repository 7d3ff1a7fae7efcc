"""The stages of a scene: which hypotheses come through, in which order, refined on what."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
from scipy.spatial import cKDTree

from gapr_core.config import ClutterConfig, SourceConfig
from gapr_core.geometry import sampling, se3
from gapr_core.registration.problem import source as sources
from gapr_core.registration.scenes import clutter, free_space
from gapr_core.registration.scenes.clutter import Pool
from gapr_core.registration.scenes.scene import Scene

CONFIG = ClutterConfig(
    same_pose_mm=2.0, markers=5, middle_poses=3, final_poses=2, kept_poses=2, levelled_by=4, region_points=12,
    middle_points=10, middle_reach_mm=15.0, final_points=20, coarse_points=30, middle_target_points=40,
    final_target_points=50,
)  # fmt: skip


@pytest.fixture(scope="module")
def source():
    return sources.prepare(tiny.on_ellipsoid(120), SourceConfig(normal_neighbours=8))


@pytest.fixture(scope="module")
def target():
    return tiny.ellipsoid(count=300)


@pytest.fixture
def scene(source):
    regions = [SimpleNamespace(source=source, centre=source.points[k]) for k in (0, 50)]
    return Scene(source, (None,), np.array([[0.0, 0.0, 300.0]]), np.zeros(len(source.points), dtype=np.int64), regions)


def shifts(*x_mm):
    return np.array([se3.exp([x, 0.0, 0.0, 0.0, 0.0, 0.0]) for x in x_mm])


def pool_of(*x_mm, scores=None, region=None):
    count = len(x_mm)
    region = np.zeros(count, dtype=np.int64) if region is None else np.array(region)
    return Pool(shifts(*x_mm), region, np.zeros(count) if scores is None else np.array(scores, dtype=float))


def places(poses):
    return np.asarray(poses)[:, 0, 3].round(6).tolist()


@pytest.fixture
def scored(monkeypatch):
    """The score of a pose is less the farther it is from x = 10 mm; notes the scales it is asked at."""
    asked = []

    def compare(poses, points, normals, image, on_mm, front_mm, num_threads):
        asked.append((len(points), on_mm, front_mm))
        return SimpleNamespace(score=0.5 - 0.01 * np.abs(poses[:, 0, 3] - 10.0))

    monkeypatch.setattr(free_space, "compare", compare)
    monkeypatch.setattr(free_space, "average", lambda seen: seen[0])
    return asked


@pytest.fixture
def refined(monkeypatch):
    """A refinement moves a pose by +1 mm along y; notes on how many points and at which limits."""
    asked = []

    def refine_agreeing(poses, points, normals, signed, *rest):
        asked.append((len(poses), len(points), rest[-2], rest[-1], signed))
        return poses + np.eye(4)[1][:, None] * np.eye(4)[3]

    monkeypatch.setattr(clutter, "refine_agreeing", refine_agreeing)
    return asked


def limits(first_last_count, front_share=1.0):
    """(I, 2) as the kernel gets them: inside and in front of the bone."""
    return np.linspace(*first_last_count)[:, None] * [1.0, front_share]


def spread_to(target, count):
    """How many points `count` evenly spread ones of the target really are."""
    return len(sampling.thin(target.points, count))


def test_the_best_of_each_group_are_kept_in_order(scene):
    pool = pool_of(0.0, 1.9, 2.1, 30.0, scores=[0.2, 0.5, 0.1, 0.3], region=[4, 5, 6, 7])
    found = clutter._best_distinct(pool, scene, CONFIG, 9)
    assert (
        places(found.poses) == [1.9, 30.0] and found.region.tolist() == [5, 7] and found.scores.tolist() == [0.5, 0.3]
    )
    apart = clutter._best_distinct(pool, scene, replace(CONFIG, same_pose_mm=0.1), 3)
    assert places(apart.poses) == [1.9, 30.0, 0.0]


def test_the_first_ranking_is_rough(scene, target, scored):
    found = clutter.rank_roughly(pool_of(0.0, 30.0, 9.0, 16.0), scene, target, CONFIG, 1)
    assert places(found.poses) == [9.0, 16.0, 0.0] and found.scores == pytest.approx([0.49, 0.44, 0.4])
    assert scored == [(spread_to(target, 30), CONFIG.coarse_on_mm, CONFIG.coarse_front_mm)]


def test_each_region_refines_its_own_hypotheses_on_what_lies_around_it(scene, target, scored, refined):
    pool = pool_of(0.0, 20.0, 30.0, region=[0, 1, -1])
    found = clutter.refine_around(pool, scene, target, CONFIG, 1)
    assert found.poses[:, 1, 3] == pytest.approx([1.0, 1.0, 1.0]) and places(found.poses) == [0.0, 20.0, 30.0]
    assert found.region.tolist() == [0, 1, -1] and found.scores == pytest.approx([0.4, 0.4, 0.3])
    assert scored == [(spread_to(target, 40), CONFIG.middle_on_mm, CONFIG.front_mm)] and pool.poses[
        :, 1, 3
    ] == pytest.approx([0.0] * 3)
    around = [(np.linalg.norm(scene.source.points - r.centre, axis=1) <= 15.0).sum() for r in scene.regions]
    some = [len(range(0, n, max(1, n // 10))) for n in around]
    assert [(poses, points) for poses, points, *_ in refined] == [(1, 10), (1, some[0]), (1, some[1])]
    assert refined[0][2] == pytest.approx(limits(CONFIG.middle_limits_mm, 0.6)) and refined[0][3] == 0.6


def test_a_given_pose_is_refined_on_the_first_points_of_a_small_cloud(scene, target, scored, refined):
    clutter.refine_around(pool_of(0.0, region=[-1]), scene, target, replace(CONFIG, middle_points=500), 1)
    assert refined[0][1] == len(scene.source.points)


def test_what_lies_around_is_thinned_evenly(scene, source):
    line = np.column_stack([np.arange(60.0), np.zeros((60, 2))])
    some = clutter._around(cKDTree(line), line[0], CONFIG)
    assert some.tolist() == list(range(16))  # 16 points within 15 mm, fewer than twice 10
    wide = clutter._around(cKDTree(line), line[0], replace(CONFIG, middle_reach_mm=29.0))
    assert wide.tolist() == list(range(0, 30, 3))
    few = clutter._around(cKDTree(line), line[0], replace(CONFIG, middle_reach_mm=5.0))
    assert few.tolist() == list(range(6))  # all, where there are fewer than 10


def test_the_last_step_refines_on_many_points_and_ranks_at_the_scale_of_the_noise(scene, target, scored, refined):
    found = clutter.refine_on_all(pool_of(0.0, 30.0, 9.0, 16.0), scene, target, CONFIG, 1)
    assert places(found.poses) == [9.0, 16.0] and found.poses[:, 1, 3] == pytest.approx([1.0, 1.0])
    assert {points for _, points, *_ in refined} == {20} and sum(poses for poses, *_ in refined) == 8
    half = len(refined) // 2
    for k, how in enumerate(refined):
        assert how[2] == pytest.approx(limits(CONFIG.final_limits_mm, 1.0 if k < half else 0.6))
    assert scored == [(spread_to(target, 50), CONFIG.on_mm, CONFIG.front_mm)]


@pytest.mark.parametrize("side", [0, 1])
def test_of_the_two_last_refinements_the_better_score_decides(scene, target, scored, monkeypatch, side):
    """Of one pose one refinement leads to x = 9 mm, the other to 2 mm; the score is best at 10 mm."""

    def refine_agreeing(poses, points, normals, signed, *rest):
        in_front = rest[-2][0, 1] < rest[-2][0, 0]
        return shifts(*[9.0 if in_front == bool(side) else 2.0] * len(poses))

    monkeypatch.setattr(clutter, "refine_agreeing", refine_agreeing)
    assert places(clutter.refine_on_all(pool_of(5.0), scene, target, CONFIG, 1).poses) == [9.0, 2.0]


def test_verification_gives_scores_that_are_small_for_good_and_the_support_of_the_crowd(scene, target, scored, refined):
    """Of the three distinct hypotheses that reach the middle step, one ends at each final pose."""
    config = replace(CONFIG, middle_poses=4)
    found = clutter.verify(pool_of(0.0, 30.0, 9.0, 16.0), scene, target, config, 1)
    assert places(found.poses) == [9.0, 16.0] and found.scores == pytest.approx([1 / 0.49, 1 / 0.44])
    assert found.poses[:, 1, 3] == pytest.approx([2.0, 2.0])  # refined twice
    assert found.support == pytest.approx([0.25, 0.25])  # within 2 mm of where the middle step left it
    far = clutter.verify(pool_of(-200.0, 2000.0), scene, target, CONFIG, 1)
    assert far.scores == pytest.approx([1e4, 1e4])  # a share below 0 counts as next to nothing


def test_a_pose_to_start_from_reaches_the_last_step_as_it_is(scene, target, scored, refined):
    config = replace(CONFIG, middle_poses=2, kept_poses=3)
    found = clutter.verify(pool_of(60.0, 9.0, 16.0, region=[-1, 0, 0]), scene, target, config, 1, shifts(60.0))
    assert dict(zip(places(found.poses), found.poses[:, 1, 3], strict=True)) == {9.0: 2.0, 16.0: 2.0, 60.0: 1.0}


@pytest.mark.parametrize(("apart_mm", "support"), [(1.24, 0.5), (1.26, 0.25)])
def test_support_counts_what_the_middle_step_left_within_the_distance(scene, target, monkeypatch, apart_mm, support):
    crowd = pool_of(0.0, 0.0, 40.0, 60.0, scores=[0.5, 0.4, 0.3, 0.2])
    crowd.poses[1, 1, 3] = apart_mm
    monkeypatch.setattr(clutter, "rank_roughly", lambda pool, *_: pool)
    monkeypatch.setattr(clutter, "refine_around", lambda pool, *_: pool)
    monkeypatch.setattr(clutter, "refine_on_all", lambda pool, *_: pool)
    config = replace(CONFIG, same_pose_mm=1.25, final_poses=1)
    assert clutter.verify(crowd, scene, target, config, 1).support.tolist() == [support]


def test_given_poses_come_first_and_each_hypothesis_names_its_region(scene, target, refined, monkeypatch):
    found = {0: shifts(1.0, 2.0), 1: shifts(3.0)}
    by_centre = {tuple(region.centre): found[k] for k, region in enumerate(scene.regions)}
    monkeypatch.setattr(clutter.regions, "search", lambda region, *_: by_centre[tuple(region.centre)])
    pool = clutter.propose(scene, target, shifts(7.0), CONFIG, 1)
    assert places(pool.poses) == [7.0, 1.0, 2.0, 3.0] and pool.region.tolist() == [-1, 0, 0, 1]
    assert pool.poses[:, 1, 3] == pytest.approx([0.0, 1.0, 1.0, 1.0]) and pool.scores.tolist() == [0.0] * 4
    assert {points for _, points, *_ in refined} == {12}
    assert refined[0][2] == pytest.approx(limits(CONFIG.region_limits_mm))


def test_the_points_of_a_target_are_spread_once_for_each_count(target):
    points, normals = clutter.spread(target, 37)
    assert 33 <= len(points) == len(normals) <= 37
    index = [int(np.flatnonzero((target.points == p).all(axis=1))[0]) for p in points]
    assert normals == pytest.approx(target.normals[index])
    assert clutter.spread(target, 37)[0] is points and 15 <= len(clutter.spread(target, 20)[0]) <= 20


def test_the_points_of_a_target_lie_where_its_sensor_sees_them(target):
    points, normals = clutter.spread(target, 37)
    farther_out, same = clutter.spread(replace(target, offset_mm=0.5), 37)
    assert farther_out == pytest.approx(points + 0.5 * normals) and np.array_equal(same, normals)
