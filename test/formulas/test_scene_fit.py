"""Which part of a scene a pose explains, and what lines of sight say of it; on a plane, by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
import tiny

from gapr_core.config import RegistrarConfig, SourceConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks.deformation import with_looks
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.confidence.features import FEATURES_OF, SCENE, measure
from gapr_core.registration.scenes import scene as scenes
from gapr_core.registration.scenes import scene_fit as explained
from gapr_core.registration.scenes.free_space import Visible
from gapr_core.registration.scenes.scene import Look
from gapr_core.registration.uncertainty import covariance

CONFIG = RegistrarConfig(num_threads=1, source=SourceConfig(normal_neighbours=8))


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
    heights = [0.0, 2.4, -2.4, 2.6, -2.6, 300.0]
    assert on_surface(source_of([[0.0, 0.0, z] for z in heights]), plane) == [True] * 3 + [False] * 3
    reach = 20.0 + 2.0 * plane.spacing_mm  # the end of the last element
    assert on_surface(source_of([[reach + x, 0.0, 1.5] for x in (1.9, 2.1)]), plane) == [True, False]


@pytest.mark.parametrize(("oriented", "expected"), [(True, [True, False, False]), (False, [True, False, True])])
def test_normals_must_agree_and_count_with_their_sign_where_it_is_known(plane, oriented, expected):
    normals = [[np.sqrt(1.0 - c * c), 0.0, c] for c in (0.71, 0.69, -0.71)]
    assert on_surface(source_of(np.zeros((3, 3)), normals, oriented), plane) == expected


def test_points_and_normals_are_moved_by_the_pose(plane):
    T = se3.exp([1.0, 2.0, 3.0, 0.5, -0.8, 0.3])
    points, normals = np.array([[0.0, 1.0, 0.5], [2.0, 1.0, 4.0]]), np.tile([0.0, 0.0, 1.0], (2, 1))
    back = se3.inverse(T)
    assert on_surface(source_of(se3.apply(back, points), normals @ back[:3, :3].T), plane, T) == [True, False]


@pytest.mark.parametrize(("others_on", "expected"), [(0, False), (5, False), (6, True), (11, True)])
def test_a_point_counts_when_most_of_its_first_neighbours_lie_on_the_surface(plane, others_on, expected):
    """Itself and eleven others are asked; more than half must lie on it. The thirteenth is not asked."""
    heights = [0.0, *([0.0] * others_on + [9.0] * (11 - others_on)), 0.0]
    neighbours = np.tile(np.arange(13), (13, 1))
    assert on_surface(source_of([[0.0, 0.0, z] for z in heights], neighbours=neighbours), plane)[0] is expected


def seen_by(*eyes):
    """A scene of a plane of 30 mm at z = 0 and a step of it 9 mm higher, by cameras; some of noise."""
    rng, looks = np.random.default_rng(3), []
    for eye in eyes:
        points = np.column_stack([rng.uniform(-15.0, 15.0, (400, 2)), rng.normal(0.0, 0.1, 400)])
        points[:, 2] += np.where(points[:, 0] > 3.0, 9.0, 0.0)
        looks.append(Look(points, np.array(eye)))
    return scenes.prepared(looks, CONFIG)


@pytest.fixture(scope="module")
def scene():
    return seen_by([0.0, 0.0, 300.0])


def test_the_part_is_chosen_again_after_each_refinement(plane, scene):
    """Two rounds: the second begins where the first one ended, and its part is that of the pose before it."""
    begin = se3.exp([0.0, 0.0, -1.5, 0.0, -0.15, 0.0])
    _, members, fit = explained.refine(begin, scene, plane, CONFIG)
    first = np.flatnonzero(explained._on_surface(begin, scene.source, plane, CONFIG))
    low = scene.source.points[:, 2] < 4.0
    assert len(first) < members.sum() and members[low].mean() > 0.9 and not members[~low].any()
    assert np.abs(fit.T[:3, 3] * [0.0, 0.0, 1.0]).max() < 0.1


def test_the_whole_cloud_is_refined_on_where_the_part_is_next_to_nothing(plane, scene):
    part, members, _ = explained.refine(se3.exp([0.0, 0.0, 60.0, 0.0, 0.0, 0.0]), scene, plane, CONFIG)
    assert members.all() and len(part.points) == 400


@pytest.mark.parametrize("eyes", [([0.0, 0.0, 300.0],), ([0.0, 0.0, 300.0], [40.0, 0.0, 300.0])])
def test_a_part_is_assessed_with_what_its_looks_err_by(plane, eyes):
    scene, classifier = seen_by(*eyes), Classifier.load()
    found = explained.refine(np.eye(4), scene, plane, CONFIG)
    part, members, fit = found
    a = explained.assess_part(found, tiny.candidates(2.0, 3.0), scene, plane, classifier, CONFIG)
    assert a.seen is scene.source and a.members is members and a.fit is fit
    assert a.judgement == classifier.judge(SCENE, a.features) and a.source is part
    np.testing.assert_array_equal(a.viewpoint, np.mean(eyes, axis=0))
    look = scene.look[members] if len(eyes) > 1 else None
    eye = covariance.eye_of(a.fit.T, np.mean(eyes, axis=0), CONFIG.sensor)
    alone = covariance.estimate(a.fit, CONFIG.covariance, CONFIG.sensor, a.source.around, eye=eye)
    np.testing.assert_allclose(a.uncertainty.covariance, with_looks(alone, a.fit, look).covariance)
    assert a.refusal.check == "unobserved turn"


def seen_as(explained=0.2, violating=0.05, compared=0.4):
    return Visible(*(np.array([x]) for x in (explained, violating, compared)))


def test_every_feature_of_a_scene_says_what_its_name_says(plane, scene, monkeypatch):
    """Of lines of sight by hand; of the fit as of any source, with the flatness of the whole cloud."""
    found = explained.refine(np.eye(4), scene, plane, CONFIG)
    monkeypatch.setattr(explained.clutter, "seen_of", lambda *words: seen_as())
    (part, members, fit), candidates = found, tiny.candidates(2.0, 3.0)
    a = explained.assess_part(found, candidates, scene, plane, Classifier.load(), CONFIG)
    np.testing.assert_array_equal(part.flatness_mm, scene.source.flatness_mm[members])
    shared = measure(fit, candidates, a.uncertainty, part, plane, CONFIG)
    values = dict(a.features)
    assert tuple(values) == FEATURES_OF[SCENE]
    expected = {name: value for name, value in shared.items() if name in values} | {
        "inlier_ratio": fit.counts.sum() / 400,
        "free_space_score": 0.2 - 0.2 * 0.2 - 2.0 * 0.05,
        "log_explained_mm2": np.log(1.0 + 0.2 * len(plane.points) * plane.spacing_mm**2),
        "explained_of_compared": 0.5,
        "violating_of_compared": 0.125,
        "rival_margin": np.log(1.5),
    }
    assert values == pytest.approx(expected)


@pytest.mark.parametrize(("scores", "margin"), [((1.0, 100.0), 3.0), ((1.0, 1e-9), -3.0), ((2.0,), 0.0)])
def test_the_margin_has_ends_and_a_pose_without_a_rival_has_none(plane, scores, margin):
    found = explained.features_of_view(seen_as(0.2, 3.0, 0.0), tiny.candidates(*scores), plane)
    assert found["rival_margin"] == margin and found["violating_of_compared"] == 1.0
    assert found["explained_of_compared"] == pytest.approx(0.2e6)  # nothing was compared: no division by 0
