"""Which part of a scene a pose explains, and what a refusal says of the rest; on a plane, by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny

from gapr_core.config import ClutterConfig, PartConfig, RegistrarConfig, SourceConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks import rigidity
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.unknowns import Finding
from gapr_core.registration.confidence import features
from gapr_core.registration.confidence.features import OTHER_BONE, SCENE_FEATURES
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.scenes import scene_fit as explained
from gapr_core.registration.scenes.free_space import Visible
from gapr_core.registration.scenes.scene_fit import Explained
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
from gapr_core.results import Refusal, RegistrationStatus

CONFIG = RegistrarConfig(
    num_threads=1, clutter=ClutterConfig(part_mm=2.0), part=PartConfig(crowd=4, most_alone=0.5),
    source=SourceConfig(normal_neighbours=8, dense_points=20),
)  # fmt: skip
REFUSED = Refusal(RegistrationStatus.AMBIGUOUS, "another pose fits")


@pytest.fixture(scope="module")
def plane():
    return tiny.plane(size_mm=40.0)


def source_of(points, normals=None, oriented=True, neighbours=None):
    points = np.asarray(points, dtype=float)
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1)) if normals is None else np.asarray(normals, dtype=float)
    neighbours = np.arange(len(points))[:, None] if neighbours is None else np.asarray(neighbours)
    return SimpleNamespace(points=points, normals=normals, oriented=oriented, neighbours=neighbours)


def on_surface(source, plane, T=None, config=CONFIG):
    return explained._on_surface(np.eye(4) if T is None else T, source, plane, config).tolist()


def test_points_are_on_the_surface_up_to_a_distance_above_below_and_aside(plane):
    heights = [0.0, 1.9, -1.9, 2.1, -2.1, 300.0]
    assert on_surface(source_of([[0.0, 0.0, z] for z in heights]), plane) == [True] * 3 + [False] * 3
    reach = 20.0 + 2.0 * plane.spacing_mm  # the end of the last element
    assert on_surface(source_of([[reach + x, 0.0, 1.2] for x in (1.5, 1.7)]), plane) == [True, False]


@pytest.mark.parametrize(("oriented", "expected"), [(True, [True, False, False]), (False, [True, False, True])])
def test_normals_must_agree_and_count_with_their_sign_where_it_is_known(plane, oriented, expected):
    normals = [[np.sqrt(1.0 - c * c), 0.0, c] for c in (0.71, 0.69, -0.71)]
    assert on_surface(source_of(np.zeros((3, 3)), normals, oriented), plane) == expected


def test_points_and_normals_are_moved_by_the_pose(plane):
    T = se3.exp([1.0, 2.0, 3.0, 0.5, -0.8, 0.3])
    points, normals = np.array([[0.0, 1.0, 0.5], [2.0, 1.0, 4.0]]), np.tile([0.0, 0.0, 1.0], (2, 1))
    back = se3.inverse(T)
    assert on_surface(source_of(se3.apply(back, points), normals @ back[:3, :3].T), plane, T) == [True, False]


@pytest.mark.parametrize(("others_on", "expected"), [(0, False), (1, False), (2, True), (3, True)])
def test_a_point_counts_when_most_of_its_first_neighbours_lie_on_the_surface(plane, others_on, expected):
    """Itself and three others are asked (crowd 4); more than half must lie on it. The fifth is not asked."""
    heights = [0.0, *([0.0] * others_on + [9.0] * (3 - others_on)), 0.0]
    neighbours = np.tile(np.arange(5), (5, 1))
    assert on_surface(source_of([[0.0, 0.0, z] for z in heights], neighbours=neighbours), plane)[0] is expected


@pytest.fixture
def described(monkeypatch):
    """Replaces description and refinement; notes which points were described and where each refinement began."""
    seen = []

    def refine_fully(T, points, target, config, neighbours):
        T = se3.exp([0.0, 0.0, -1.5, 0.0, 0.0, 0.0]) @ T
        seen.append((len(points), T[2, 3]))
        zeros = np.zeros(len(points))
        return Fit(T, 0.5, zeros, (points[:, 2] < 2.6).astype(float), None, zeros, se3.apply(T, points))

    monkeypatch.setattr(explained, "refine_fully", refine_fully)
    return seen


def scene_of(points):
    """Its parts are described by their points alone."""
    source = source_of(points)
    part = SimpleNamespace
    return SimpleNamespace(
        source=source, part=lambda members, config: part(points=source.points[members], neighbours=None)
    )


def test_the_part_is_chosen_again_after_each_refinement(plane, described):
    """40 points at 0, 35 at 3 mm: at first only the first lie within 2 mm; moved down by 1.5 mm, all do."""
    points = [[0.1 * k, 0.0, 0.0] for k in range(40)] + [[0.1 * k, 1.0, 3.0] for k in range(35)]
    scene = scene_of(points)
    found = explained.refine(np.eye(4), scene, plane, CONFIG)
    assert described == [(40, -1.5), (75, -3.0)]
    assert found.members.sum() == 75 and found.share == pytest.approx(40 / 75)
    once = explained.refine(np.eye(4), scene, plane, replace(CONFIG, part=replace(CONFIG.part, rounds=1)))
    assert once.members.tolist() == [True] * 40 + [False] * 35 and once.share == pytest.approx(40 / 75)


@pytest.mark.parametrize(("count", "all_of_it"), [(29, True), (30, False)])
def test_the_whole_cloud_is_refined_on_where_the_part_is_next_to_nothing(plane, described, count, all_of_it):
    points = [[0.1 * k, 0.0, 0.0] for k in range(count)] + [[0.1 * k, 1.0, 50.0] for k in range(20)]
    explained.refine(np.eye(4), scene_of(points), plane, CONFIG)
    assert described[0][0] == (count + 20 if all_of_it else count)


def part_of(share, count=10):
    zeros = np.zeros(count)
    weights = (np.arange(count) < round(share * count)).astype(float)
    fit = Fit(np.eye(4), 0.5, zeros, weights, None, zeros, np.zeros((count, 3)))
    return Explained(SimpleNamespace(points=np.zeros((count, 3)), around=None), np.ones(count, dtype=bool), fit)


def camera_s():
    """A scene seen from one place."""
    return SimpleNamespace(source=object(), viewpoint=np.ones(3), viewpoints=np.ones((1, 3)), images=(None,))


@pytest.fixture
def judged(monkeypatch):
    """Replaces covariance, features and the judge; `probability` and `refusal` are what the judge says."""
    verdict = SimpleNamespace(probability=0.9, refusal=None)

    def judge(fit, candidates, uncertainty, features, source, target, calibration, config):
        return Assessment(fit, candidates, uncertainty, features, verdict.probability, verdict.refusal, source, target)

    monkeypatch.setattr(explained, "judge", judge)
    monkeypatch.setattr(explained, "measure", lambda part, *_: {"inlier_ratio": part.share})
    monkeypatch.setattr(explained.covariance, "estimate", lambda *_, **__: None)
    return verdict


@pytest.mark.parametrize(("probability", "share", "refusal", "status"), [
    (0.5, 0.4, None, None), (0.49, 0.5, None, None), (0.49, 0.4, None, "CLUTTER"), (0.3, 0.4, REFUSED, "CLUTTER"),
    (0.9, 0.4, REFUSED, "AMBIGUOUS"), (0.3, 0.6, REFUSED, "AMBIGUOUS"),
])  # fmt: skip
def test_clutter_is_named_where_little_is_explained_and_the_pose_is_not_believed(
    judged, probability, share, refusal, status
):
    judged.probability, judged.refusal = probability, refusal
    scene, part = camera_s(), part_of(share)
    assessed_part = explained.assess_part(part, None, scene, None, None, CONFIG)
    assert assessed_part.refusal is refusal  # a stream may still raise the probability
    found = explained.named_clutter(assessed_part, CONFIG)
    assert (found.refusal and found.refusal.status.value) == status
    assert found.seen is scene.source and found.members is part.members and found.probability == probability
    assert found.viewpoint is scene.viewpoint
    if status == "CLUTTER":
        assert "in the best pose 40 % of the cloud" in found.refusal.reason
        assert (refusal.reason if refusal else "no pose of it is certain") in found.refusal.reason


@pytest.mark.parametrize(("looks", "log_ratio", "is_added"), [(2, 5.0, True), (2, 0.0, False), (1, 5.0, False)])
def test_the_covariance_holds_what_the_looks_err_by_against_each_other(judged, monkeypatch, looks, log_ratio, is_added):
    known, changes, part = PoseUncertainty(np.eye(6), 0.1, 0.2, 0.3), np.ones((10, 12)), part_of(0.4)
    asked = []

    def of_looks(fit, look, config):
        asked.append(look)
        return rigidity.Deformation(Finding(log_ratio, 0.7), changes, 0.0)

    monkeypatch.setattr(explained.covariance, "estimate", lambda *_, **__: known)
    monkeypatch.setattr(rigidity, "of_looks", of_looks)
    monkeypatch.setattr(rigidity, "covariance_added_by", lambda fit, errors, config: errors[:6, :6] ** 2)
    scene = SimpleNamespace(source=None, viewpoint=np.ones(3), viewpoints=np.ones((looks, 3)), images=(None,) * looks)
    scene.look = np.arange(10) % looks
    found = explained.assess_part(part, None, scene, None, None, CONFIG).uncertainty
    assert found.covariance == pytest.approx(np.eye(6) + (0.49 if is_added else 0.0))
    assert len(asked) == (looks > 1) and all(np.array_equal(look, scene.look) for look in asked)


def test_the_bone_in_two_poses_is_no_clutter(judged):
    scene, part = camera_s(), part_of(0.4)
    judged.probability, judged.refusal = 0.3, REFUSED
    found = replace(explained.assess_part(part, None, scene, None, None, CONFIG), deformed={"doubled": 30.0})
    assert explained.named_clutter(found, CONFIG) is found


def assessed(plane, probability=0.2, count=20, off=13, **more):
    points = np.column_stack([0.1 * np.arange(count), np.zeros(count), np.where(np.arange(count) < off, 9.0, 0.0)])
    fit = SimpleNamespace(T=np.eye(4))
    return Assessment(fit, None, None, {}, probability, None, source_of(points), plane, **more)


@pytest.mark.parametrize(("change", "is_named"), [
    ({}, True), ({"count": 40, "off": 26}, True), ({"off": 12}, False), ({"off": 5}, False),
    ({"probability": 0.5}, False), ({"count": 19, "off": 13}, False),
])  # fmt: skip
def test_a_dense_cloud_that_lies_mostly_off_the_bone_is_named_clutter(plane, change, is_named):
    """20 points are dense here; 7 of 20 on the bone are less than .4 of them, 8 are not."""
    a = assessed(plane, **change)
    found = explained.named_clutter(a, CONFIG)
    if not is_named:
        assert found is a
        return
    assert found.refusal.status is RegistrationStatus.CLUTTER
    for part in ("in the best pose 35 % of the cloud", "say where the camera was"):
        assert part in found.refusal.reason


def test_lines_of_sight_give_shares_areas_and_the_margin_to_the_rival(plane):
    seen = Visible(*(np.array([x]) for x in (0.2, 0.05, 0.4)), CONFIG.clutter.free_space)
    found = explained._visible_features(seen, Candidates(None, np.array([2.0, 3.0, 9.0]), None), plane)
    assert found["free_space_score"] == pytest.approx(0.2 - 0.2 * 0.2 - 2.0 * 0.05)
    assert found["log_explained_mm2"] == pytest.approx(np.log(1.0 + 0.2 * len(plane.points) * plane.spacing_mm**2))
    assert found["explained_of_compared"] == pytest.approx(0.5)
    assert found["violating_of_compared"] == pytest.approx(0.125)
    assert found["rival_margin"] == pytest.approx(np.log(1.5))


def test_the_explained_area_counts_the_points_of_the_bone_by_their_spacing():
    bone = SimpleNamespace(points=np.zeros((50, 3)), spacing_mm=3.0)
    seen = Visible(*(np.array([x]) for x in (0.2, 0.05, 0.4)), CONFIG.clutter.free_space)
    found = explained._visible_features(seen, Candidates(None, np.array([2.0, 3.0]), None), bone)
    assert found["log_explained_mm2"] == pytest.approx(np.log(1.0 + 0.2 * 50 * 9.0))


def test_every_feature_of_a_scene_says_what_its_name_says(monkeypatch):
    """The part has 12 points, 9 of them inliers; the scene has 30."""
    rng, T = np.random.default_rng(2), se3.exp([1.0, 2.0, 3.0, 0.3, -0.2, 0.1])
    points, gradients = rng.uniform(-15.0, 15.0, (12, 3)) + [40.0, 0.0, -5.0], rng.normal(size=(12, 3))
    gradients /= np.linalg.norm(gradients, axis=1, keepdims=True)
    normals = rng.normal(size=(12, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = np.where(np.arange(12) < 3, 0.0, 0.5)
    fit = Fit(T, 0.5, np.zeros(12), weights, gradients, np.zeros(12, dtype=int), se3.apply(T, points))
    alone = np.arange(12)[:, None]  # neighbours without a curvature
    part, members = SimpleNamespace(points=points, normals=normals, patches=alone), np.arange(30) < 12
    known = PoseUncertainty(np.diag([4.0, 1.0, 0.25, 1e-4, 4e-4, 1e-6]), 0.1, 0.2, 0.3)
    candidates = Candidates(None, np.array([2.0, 3.0]), np.array([0.7, 0.1]))
    bone = SimpleNamespace(points=np.zeros((50, 3)), spacing_mm=3.0, half_extent_mm=50.0)
    scene, asked = SimpleNamespace(source=SimpleNamespace(flatness_mm=np.where(members, 0.3, 9.0))), []
    seen = Visible(*(np.array([x]) for x in (0.2, 0.05, 0.4)), CONFIG.clutter.free_space)
    monkeypatch.setattr(explained.clutter, "seen_of", lambda *words: asked.append(words) or seen)
    monkeypatch.setattr(features, "of_another_bone", lambda *words: dict.fromkeys(OTHER_BONE, 0.125))
    found = explained.measure(Explained(part, members, fit), candidates, known, scene, bone, CONFIG)
    assert set(found) == set(SCENE_FEATURES) and np.array_equal(asked[0][0], T[None])
    assert found["log_sigma"] == pytest.approx(np.log(0.5)) and found["log_excess"] == pytest.approx(np.log(0.5 / 0.3))
    assert (found["smooth_misfit"], found["short_misfit"], found["support"]) == (0.2, 0.3, 0.7)
    assert found["inlier_ratio"] == pytest.approx(9 / 30) and found["log_points"] == pytest.approx(np.log(12))
    assert found["log_shift_sd"] == pytest.approx(np.log(2.0))
    assert found["log_turn_sd"] == pytest.approx(np.log(np.degrees(0.02)))
    cosines = [abs((T[:3, :3] @ normals[k]) @ gradients[k]) for k in range(3, 12)]
    assert found["normal_agreement"] == pytest.approx(np.median(cosines))
    reach = max(np.linalg.norm(p - points.mean(axis=0)) for p in points)
    assert found["extent"] == pytest.approx(reach / 50.0) and found["scale_z"] == 0.125
    scene.source.flatness_mm = np.full(30, 0.01)  # a source without noise counts as having a tenth of a millimetre
    blind = Explained(part, members, replace(fit, weights=np.zeros(12)))
    found = explained.measure(blind, candidates, known, scene, bone, CONFIG)
    assert found["log_excess"] == pytest.approx(np.log(5.0)) and found["normal_agreement"] == 0.0


@pytest.mark.parametrize(("scores", "margin"), [([1.0, 100.0], 3.0), ([1.0, 1e-9], -3.0)])
def test_the_margin_has_ends(plane, scores, margin):
    seen = Visible(*(np.array([x]) for x in (0.2, 3.0, 0.0)), CONFIG.clutter.free_space)
    found = explained._visible_features(seen, Candidates(None, np.array(scores), None), plane)
    assert found["rival_margin"] == margin and found["violating_of_compared"] == 1.0
    assert found["explained_of_compared"] == pytest.approx(0.2e6)  # nothing was compared: no division by 0


def test_a_pose_without_a_rival_has_no_margin(plane):
    seen = Visible(*(np.array([x]) for x in (0.2, 3.0, 0.0)), CONFIG.clutter.free_space)
    assert explained._visible_features(seen, Candidates(None, np.array([2.0]), None), plane)["rival_margin"] == 0.0
