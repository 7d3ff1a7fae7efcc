"""A camera looks at a bone between things that are not bone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import logit

from gapr_core import Registrar, RegistrarConfig, RegistrationStatus, Tracker
from gapr_core.config import ClutterConfig, SensorConfig, SourceConfig
from gapr_core.geometry import se3, visibility
from gapr_core.registration.checks import image, table
from gapr_core.registration.confidence.additive import Additive, Curve
from gapr_core.registration.confidence.classifier import Classifier, Judgement
from gapr_core.registration.confidence.features import BONE, FEATURES_OF, SCENE
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.source import prepare
from gapr_core.registration.scenes import clutter
from gapr_core.registration.scenes import scene as scenes
from gapr_core.registration.streams.memory import PreviousPoses, TrackingRegistrar
from gapr_core.runtime.clock import Clock
from gapr_core.surface import Surface

ONE_THREAD = RegistrarConfig(num_threads=1)
T_SOURCE_TARGET = se3.exp(np.array([80.0, -40.0, 25.0, 0.4, -1.1, 0.7]), np.zeros(3))


def judging(scene, bone=0.01):
    """A classifier of which the pose of a scene has this probability, and that of a source of bone alone another."""
    pose = {kind: Additive(float(logit(each)), ()) for kind, each in ((SCENE, scene), (BONE, bone))}
    return Classifier(pose, dict.fromkeys(FEATURES_OF, Additive(99.0, ())))


def seeing(scene, bone=0.01):
    return Registrar(ONE_THREAD, classifier=judging(scene, bone))


@pytest.fixture(scope="module")
def scene(femur):
    """(N, 3) one end of a femur and a tilted cloth around it, both as a camera sees them; and the camera."""
    rng = np.random.default_rng(2)
    points, normals = femur.sample(60_000, rng)
    middle = points[points[:, 2] < np.quantile(points[:, 2], 0.2)].mean(axis=0)
    ahead = np.array([0.0, 1.0, 0.0])
    seen = visibility.seen_from(-ahead, points, normals, 1.5) & (np.linalg.norm(points - middle, axis=1) < 60.0)
    bone = points[seen & (rng.random(len(points)) < 0.2)]
    x, z = rng.uniform(-90.0, 90.0, (2, 3500))
    cloth = middle + np.stack([x, -5.0 + 0.3 * x + 6.0 * np.sin(z / 20.0), z], axis=1)
    gap = np.hypot(*(cloth - middle)[:, [0, 2]].T) > 62.0
    cloud = np.vstack([bone, cloth[gap]])
    cloud += rng.normal(0.0, 0.4, cloud.shape)
    return se3.apply(T_SOURCE_TARGET, cloud), se3.apply(T_SOURCE_TARGET, (middle - 450.0 * ahead)[None])[0], len(bone)


@pytest.fixture(scope="module")
def method():
    return Registrar(RegistrarConfig(num_threads=1, min_confidence=0.0))


@pytest.fixture(scope="module")
def result(method, target, scene):
    return method.register(scene[0], target, viewpoint=scene[1])


def test_the_bone_is_found_between_what_is_not_bone(result, scene):
    assert len(result.hypotheses) > 1 and result.proposer == clutter.NAME
    shift_mm, turn_deg = se3.pose_error(
        result.hypotheses[0].T_target_source, se3.inverse(T_SOURCE_TARGET), scene[0][: scene[2]]
    )
    assert shift_mm < 2.0 and turn_deg < 2.0


def test_residuals_say_which_points_were_taken_for_bone(result, scene):
    points, _, count = scene
    bone = {tuple(p) for p in points[:count]}
    is_bone = np.array([tuple(p) in bone for p in result.residuals.points])
    assert result.residuals.inlier[is_bone].mean() > 0.8 and result.residuals.inlier[~is_bone].mean() < 0.1


def test_without_the_bone_what_is_mostly_clutter_is_refused_as_such(target, scene):
    result = seeing(0.49).register(scene[0][scene[2] :], target, viewpoint=scene[1])
    assert result.status is RegistrationStatus.CLUTTER and result.T_target_source is None
    assert "crop" in result.reason and result.hypotheses


def test_nobody_has_to_say_where_the_camera_was(target, scene):
    points, viewpoint, count = scene
    result = Registrar(ONE_THREAD).register(points, target)
    assert result.ok and result.proposer == clutter.NAME
    shift_mm, turn_deg = se3.pose_error(result.T_target_source, se3.inverse(T_SOURCE_TARGET), points[:count])
    assert shift_mm < 2.0 and turn_deg < 2.0
    ways = [place - points.mean(axis=0) for place in (result.inferred_viewpoint, viewpoint)]
    assert np.dot(*[way / np.linalg.norm(way) for way in ways]) > np.cos(np.radians(30.0))


@pytest.mark.parametrize("settings", [{"clutter": ClutterConfig(infer_viewpoint=False)},
                                      {"source": SourceConfig(dense_points=100_000)}])  # fmt: skip
def test_a_cloud_that_cannot_be_a_camera_s_is_taken_for_bone_alone(target, scene, settings):
    result = Registrar(RegistrarConfig(num_threads=1, **settings)).register(scene[0], target)
    assert not result.ok and result.inferred_viewpoint is None and result.proposer != clutter.NAME


@pytest.mark.parametrize(("probability", "is_taken"), [(0.49, False), (0.51, True)])
def test_a_pose_that_rests_on_an_inferred_place_is_taken_where_it_is_accepted(target, scene, probability, is_taken):
    result = seeing(probability).register(scene[0], target)
    assert result.ok is is_taken and (result.inferred_viewpoint is not None) is is_taken


@pytest.mark.parametrize(("kind", "asked"), [("unknown", 2), ("depth_camera", 2), ("pointer", 0), ("ultrasound", 0)])
def test_sensors_that_touch_the_bone_or_skin_have_no_lines_of_sight(scene, kind, asked):
    config = RegistrarConfig(sensor=SensorConfig(kind=kind))
    assert len(clutter.inferred_places(prepare(scene[0], in_scene=True), config)) == asked
    assert (clutter.possible_view(scene[0], config) is not None) is bool(asked), "nothing is prepared in vain"


def test_a_pose_that_a_later_check_refuses_is_none_and_the_first_refusal_stands(target, scene, monkeypatch):
    monkeypatch.setattr(image, "log_ratio", lambda a, *_: np.inf if a.inferred_viewpoint is None else -1.0)
    result = seeing(0.9).register(scene[0], target)
    assert not result.ok and result.inferred_viewpoint is None and "mirror image" not in result.reason


def test_a_few_points_metres_away_do_not_turn_a_refusal_into_an_error(target, scene, monkeypatch):
    """They may not be among the points that are drawn as bone; of all points they are some."""
    monkeypatch.setattr(sources, "_drawn", lambda points, most: np.flatnonzero(points[:, 0] < 1500.0)[:most])
    rng = np.random.default_rng(7)
    many = np.vstack([scene[0]] * 4) + rng.normal(0.0, 0.3, (4 * len(scene[0]), 3))
    far = scene[0].mean(axis=0) + [3000.0, 0.0, 0.0] + rng.normal(0.0, 1.0, (8, 3))
    result = Registrar(ONE_THREAD).register(np.vstack([many, far]), target)
    assert isinstance(result.status, RegistrationStatus)


def test_a_stream_with_a_viewpoint_is_seen_from_there_to_the_last_cloud(target, scene):
    """A tracker that left it out would infer one of its own, and find the bone as well."""
    rng = np.random.default_rng(3)
    tracker = Tracker(seeing(0.97))
    for proposer in (clutter.NAME, PreviousPoses.name, PreviousPoses.name):
        points = scene[0] + rng.normal(0.0, 0.1, scene[0].shape)
        result = tracker.register(points, target, viewpoint=scene[1])
        assert result.ok and result.proposer == proposer and result.inferred_viewpoint is None


def test_a_scene_without_a_viewpoint_is_looked_for_where_the_last_one_lay(target, scene, monkeypatch):
    memory, given = PreviousPoses(), []
    memory.poses = np.stack([se3.inverse(T_SOURCE_TARGET), np.eye(4)])
    method = TrackingRegistrar(memory, Registrar(ONE_THREAD))

    def nothing(scene, target, poses, *settings):
        given.append(poses)
        return clutter.Pool(np.empty((0, 4, 4)), np.empty(0, dtype=int), np.empty(0))

    monkeypatch.setattr(clutter, "propose", nothing)
    method.assess(scene[0], target)
    assert given and all(np.array_equal(poses, memory.poses[:1]) for poses in given)


@pytest.fixture
def of_views(target, scene):
    """A tracker that has a pose of the scene, whose camera it inferred."""
    made = Tracker(seeing(0.97))
    assert made.register(scene[0], target).inferred_viewpoint is not None
    return made


def test_the_next_view_is_compared_with_what_is_remembered_and_not_taken_for_bone(of_views, target, scene, monkeypatch):
    monkeypatch.setattr(TrackingRegistrar, "_as_bone", lambda *_: pytest.fail("it was taken for bone"))
    monkeypatch.setattr(clutter, "propose", lambda *_: pytest.fail("a region was asked"))
    shift, first = np.array([2.0, -3.0, 1.0]), of_views._memory.place
    found = of_views.register(scene[0] + shift, target)
    assert found.ok and found.proposer == PreviousPoses.name
    assert found.inferred_viewpoint == pytest.approx(first + shift, abs=30.0)
    truth = se3.inverse(T_SOURCE_TARGET) @ se3.exp([*-shift, 0.0, 0.0, 0.0])
    error = se3.pose_error(found.T_target_source, truth, scene[0][: scene[2]] + shift)
    assert error.rte_mm < 1.0 and error.rre_deg < 1.0


@pytest.mark.parametrize("nearest", [0, 1])
def test_of_several_places_the_one_near_the_last_is_asked_first(of_views, target, scene, monkeypatch, nearest):
    """And all of them where it is not sure: the camera may be on the other side now."""
    places = [(np.array([0.0, 0.0, z]), 1) for z in (-500.0, 500.0)]
    monkeypatch.setattr(clutter, "inferred_places", lambda *_: places)
    of_views._memory.place = np.array([0.0, 10.0, (-400.0, 400.0)[nearest]])
    assert of_views._tracking._places_of(None) == [places[nearest], places[1 - nearest]]
    of_views._memory.place = None
    assert of_views._tracking._places_of(None) == places == of_views.registrar._places_of(None)


def test_a_view_that_a_check_refuses_is_no_answer_by_itself(of_views, target, scene, monkeypatch):
    monkeypatch.setattr(image, "log_ratio", lambda a, *_: -1.0 if a.proposer == PreviousPoses.name else np.inf)
    assert of_views.register(scene[0] + 0.01, target).proposer == clutter.NAME


@pytest.mark.parametrize(("probability", "proposer"), [(0.79, clutter.NAME), (0.81, PreviousPoses.name)])
def test_what_is_remembered_of_a_view_has_to_stand(of_views, target, scene, monkeypatch, probability, proposer):
    monkeypatch.setattr(of_views._tracking, "classifier", judging(probability))
    assert of_views.register(scene[0] + 0.01, target).proposer == proposer


def test_in_a_stream_of_views_an_unsure_one_is_no_bone_that_speaks_against_it(of_views, target, scene, monkeypatch):
    """As bone alone it is nonsense; nor does such nonsense speak against the views."""
    alone = seeing(0.02).register(scene[0] + 0.01, target)
    assert alone.inferred_viewpoint is None and alone.confidence < 0.02, "a source by itself is refused as bone"
    with monkeypatch.context() as changed:
        changed.setattr(of_views._tracking, "classifier", judging(0.02))
        result = of_views.register(scene[0] + 0.01, target)
    assert not result.ok and result.inferred_viewpoint is not None
    assert [of_views.register(scene[0] + shift, target) for shift in (0.02, 0.03)][-1].ok


def test_what_was_refused_as_bone_says_nothing_in_a_stream_of_views(of_views, target, scene):
    nonsense = np.random.default_rng(0).uniform(-40.0, 40.0, (300, 3))
    alone = of_views.register(scene[0] + 0.01, target).confidence
    of_views.reset()
    of_views.register(scene[0], target)
    assert not of_views.register(nonsense, target).ok
    assert of_views.register(scene[0] + 0.01, target).confidence == pytest.approx(alone)


def test_a_given_place_or_an_answer_as_bone_ends_a_stream_of_views(of_views, target, scene):
    assert of_views.register(scene[0] + 0.01, target, viewpoint=scene[1]).ok
    assert of_views._memory.place is None


@pytest.mark.parametrize(
    ("probabilities", "most", "asked"),
    [
        ((0.09, 0.09, 0.9, 0.9), 4, 2),
        ((0.5, 0.09, 0.09, 0.9), 4, 3),
        ((0.09, 0.11, 0.09, 0.11), 4, 4),
        ((0.96, 0.0, 0.0, 0.0), 4, 1),
        ((0.09, 0.09, 0.09, 0.09), None, 4),
    ],
)
def test_two_hopeless_rounds_of_what_may_be_no_scene_are_the_last(target, scene, probabilities, most, asked):
    left = list(probabilities)

    class Scripted(Classifier):
        def judge(self, kind, features):
            return Judgement(float(logit(left.pop(0))), 3.0)

    config = RegistrarConfig(num_threads=1, clutter=ClutterConfig(seeds=(2, 1), middle_poses=50, final_poses=10))
    seen = scenes.prepared(scenes.split(scene[0], scene[1]), config)
    registrar = Registrar(config, classifier=Scripted({}, {}))
    found = registrar._in_scene(seen, target, np.empty((0, 4, 4)), Clock(), most)
    assert found.rounds == asked == len(probabilities) - len(left)


def test_a_wound_on_the_model_of_the_other_side_is_refused(femur, target, scene, monkeypatch):
    """Only the mirrored scene, registered as one, shows it; three of 38 were accepted."""
    other = Surface(femur.points * [-1.0, 1.0, 1.0], femur.faces[:, ::-1])
    rising = Curve("free_space_score", np.array([0.0, 0.2]), np.array([0.0, 2.0]))
    by_score = replace(judging(0.5), pose={SCENE: Additive(0.0, (rising,)), BONE: Additive(-5.0, ())})
    for name in ("LARGEST_TURN_DEG", "LARGEST_SHIFT_MM"):
        monkeypatch.setattr(table, name, 1e3)
    monkeypatch.setattr(table, "EQUAL_MM", 0.0)
    monkeypatch.setattr(table, "flat_valley", lambda a, config: a)
    method = Registrar(ONE_THREAD, classifier=by_score)
    result = method.register(scene[0], method.prepare(other), viewpoint=scene[1])
    assert not result.ok and "the mirror image of the source fits the bone better" in result.reason
    assert method.register(scene[0], target, viewpoint=scene[1]).ok


@pytest.fixture
def tracker(target, scene):
    """It has a pose of the scene."""
    made = Tracker(seeing(0.97))
    first = made.register(scene[0], target, viewpoint=scene[1])
    assert first.ok and first.proposer == clutter.NAME and made._has_track
    return made


def test_the_next_scene_is_compared_with_what_is_remembered_and_no_region_proposes(tracker, target, scene, monkeypatch):
    monkeypatch.setattr(clutter, "propose", lambda *_: pytest.fail("a region was asked"))
    shift = np.array([2.0, -3.0, 1.0])
    found = tracker.register(scene[0] + shift, target, viewpoint=scene[1] + shift)
    assert found.ok and found.proposer == PreviousPoses.name and len(found.hypotheses) > 1
    truth = se3.inverse(T_SOURCE_TARGET) @ se3.exp([*-shift, 0.0, 0.0, 0.0])
    error = se3.pose_error(found.T_target_source, truth, scene[0][: scene[2]] + shift)
    assert error.rte_mm < 1.0 and error.rre_deg < 1.0
    assert tracker._since_full == 1


def test_every_so_many_scenes_one_is_registered_in_full(target, scene):
    tracker = Tracker(seeing(0.97), recheck=2)
    found = [tracker.register(scene[0] + 0.01 * n, target, viewpoint=scene[1]).proposer for n in range(4)]
    assert found == [clutter.NAME, PreviousPoses.name, clutter.NAME, PreviousPoses.name]


def test_regions_propose_where_what_is_remembered_is_not_sure(tracker, target, scene, monkeypatch):
    """All that is remembered is tried with them."""
    asked, propose = [], clutter.propose

    def noted(scene, target, start, *more):
        asked.append(start)
        return propose(scene, target, start, *more)

    monkeypatch.setattr(clutter, "propose", noted)
    monkeypatch.setattr(tracker, "_is_sure", False)  # so that nothing but a sure answer stands
    monkeypatch.setattr(tracker._tracking, "config", replace(tracker.config, sure=1.1))
    remembered = tracker._memory.poses
    found = tracker.register(scene[0] + 0.01, target, viewpoint=scene[1])
    assert found.proposer == clutter.NAME and np.array_equal(asked[0], remembered)


@pytest.mark.parametrize("most", [0.0, 0.01, 0.5])
def test_a_remembered_pose_has_no_more_support_than_the_last_full_registration_gave_it(tracker, target, scene, most):
    """Of four remembered poses its own is a quarter; of all that regions propose, a right one is a fiftieth."""
    tracker._memory.support = most
    seen = scenes.prepared(scenes.split(scene[0], scene[1]), tracker.config)
    found = tracker._tracking._remembered(seen, target, Clock(), lambda answer: True)
    assert found.features["support"] <= most and (found.features["support"] == most or most == 0.5)


def test_what_a_full_registration_found_of_support_is_remembered(target, scene):
    tracker = Tracker(Registrar(ONE_THREAD))
    first = tracker.register(scene[0], target, viewpoint=scene[1])
    assert tracker._memory.support == first.features["support"] > 0.0
    tracker.register(scene[0] + 0.01, target, viewpoint=scene[1])
    assert tracker._memory.support == first.features["support"], "a tracked answer has none of its own"


def test_regions_propose_where_only_one_remembered_pose_is_left(tracker, target, scene):
    """Nothing would compete with it."""
    tracker._memory.poses = tracker._memory.poses[[0, 0]]
    assert tracker.register(scene[0] + 0.01, target, viewpoint=scene[1]).proposer == clutter.NAME


def test_several_looks_are_always_registered_in_full(tracker, target, scene):
    looks = np.where(np.arange(len(scene[0]))[:, None] % 2, scene[1], scene[1] + [60.0, 0.0, 0.0])
    assert tracker.register(scene[0], target, viewpoint=looks).proposer == clutter.NAME


def test_a_cloud_that_is_sure_as_bone_is_not_asked_for_its_camera(target, femur, monkeypatch):
    monkeypatch.setattr(clutter, "inferred_places", lambda *_: pytest.fail("asked"))
    seen = femur.sample(3000, np.random.default_rng(5))[0]
    assert Registrar(ONE_THREAD).register(seen, target).ok


def test_what_is_not_sure_as_a_camera_s_either_keeps_its_first_refusal(target, scene):
    points = scene[0][scene[2] :]
    blind = RegistrarConfig(num_threads=1, clutter=ClutterConfig(infer_viewpoint=False))
    first, second = (Registrar(config).register(points, target) for config in (blind, RegistrarConfig(num_threads=1)))
    assert (first.status, first.reason, first.confidence) == (second.status, second.reason, second.confidence)
    assert second.inferred_viewpoint is None


def test_both_ends_of_the_line_of_sight_are_tried(target, scene, monkeypatch):
    ways = clutter.inferred_places(prepare(scene[0], in_scene=True), RegistrarConfig())
    monkeypatch.setattr(clutter, "inferred_places", lambda *_: ways[::-1])  # as if the wrong one was likelier
    result = Registrar(ONE_THREAD).register(scene[0], target)
    assert result.ok
    np.testing.assert_array_equal(result.inferred_viewpoint, ways[0][0])


def test_a_refusal_of_clutter_with_a_viewpoint_behind_the_surface_asks_to_check_it(target, femur):
    """All of the cloud is bone; only the viewpoint is wrong, as one in another frame or unit is."""
    points, normals = femur.sample(6000, np.random.default_rng(5))
    seen = points[normals @ [0.0, 1.0, 0.0] > 0.3]
    viewpoint = seen.mean(axis=0) - [0.0, 400.0, 0.0]
    result = Registrar(ONE_THREAD).register(seen, target, viewpoint=viewpoint)
    assert result.status is RegistrationStatus.CLUTTER and "check the viewpoint" in result.reason


def test_a_refused_cloud_that_lies_on_the_bone_is_not_called_clutter(target, femur):
    shaft = femur.sample(4000, np.random.default_rng(5))[0]
    along = np.abs(shaft[:, 2] - shaft[:, 2].mean())
    result = Registrar(ONE_THREAD).register(shaft[along < 40.0], target)
    assert not result.ok and result.status is not RegistrationStatus.CLUTTER


def test_a_few_points_in_view_of_their_camera_are_refused_without_an_error(method, target, scene):
    result = method.register(scene[0][:9], target, viewpoint=scene[1])
    assert not result.ok and "no pose" in result.reason


def in_the_frame_of_its_camera(scene):
    """The points of a scene, moved so that the camera is in the origin and looks along z."""
    points, viewpoint, _ = scene
    ahead = points.mean(axis=0) - viewpoint
    return (points - viewpoint) @ Rotation.align_vectors([[0.0, 0.0, 1.0]], [ahead])[0].as_matrix().T


@pytest.mark.parametrize("origin_deg", [35.0, 0.0])
def test_the_frame_of_a_camera_says_where_it_was_where_its_surface_does_not(target, scene, monkeypatch, origin_deg):
    """With `LEAST_COS` 1 no cloud is seen so squarely that the surface says it."""
    monkeypatch.setattr(clutter, "LEAST_COS", 1.0)
    monkeypatch.setattr(clutter, "ORIGIN_DEG", origin_deg)
    result = seeing(0.9).register(in_the_frame_of_its_camera(scene), target)
    assert result.ok is bool(origin_deg)
    assert not result.ok or np.array_equal(result.inferred_viewpoint, np.zeros(3))


def test_the_origin_comes_first_and_has_rounds_of_its_own(scene):
    source = prepare(in_the_frame_of_its_camera(scene), in_scene=True)
    places = clutter.inferred_places(source, ONE_THREAD)
    assert [rounds for _, rounds in places] == [clutter.ORIGIN_ROUNDS, *clutter.INFERRED_ROUNDS]
    assert not places[0][0].any()


def test_a_pose_that_was_given_is_not_weighed_against_nothing(method, target, scene, monkeypatch):
    """Where no region proposed anything it was the only hypothesis: no rival, and no AMBIGUOUS."""
    points, viewpoint, _ = scene
    truth, alone = se3.inverse(T_SOURCE_TARGET), clutter.propose

    def no_regions(scene, target, given, *more):
        return clutter.given(given)

    monkeypatch.setattr(clutter, "propose", no_regions)
    found = method.register(points, target, initial=truth, viewpoint=viewpoint)
    assert found.status is RegistrationStatus.LOW_CONFIDENCE and "no pose to begin with" in found.reason
    calls = []

    def later(scene, target, given, *more):
        calls.append(len(given))
        return (no_regions if len(calls) == 1 else alone)(scene, target, given, *more)

    monkeypatch.setattr(clutter, "propose", later)
    found = method.register(points, target, initial=truth, viewpoint=viewpoint)
    assert found.ok and len(found.hypotheses) > 1 and calls[:2] == [1, 1], "it is still there in the next round"
