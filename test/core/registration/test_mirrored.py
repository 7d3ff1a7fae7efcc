"""A source whose mirror image fits better is refused: a flipped scan, or a bone of the other side."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig
from gapr_core.config import SensorConfig, SourceConfig
from gapr_core.data.parametric import make_bone
from gapr_core.registration.checks import costly as checks
from gapr_core.registration.fit import mirror
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.results import RegistrationStatus

CONFIG = RegistrarConfig(num_threads=1)
FLIP = np.array([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def pelvis():
    return make_bone("pelvis", 900_001)


@pytest.fixture(scope="module")
def registrar():
    return Registrar(CONFIG)


@pytest.fixture(scope="module")
def target(registrar, pelvis):
    return registrar.prepare(pelvis)


def seen(bone, count=1500, noise_mm=0.4):
    rng = np.random.default_rng(5)
    points = bone.sample(20_000, rng)[0]
    points = points[points[:, 1] > np.median(points[:, 1])]
    return points[rng.permutation(len(points))[:count]] + rng.normal(0.0, noise_mm, (count, 3))


def test_a_pelvis_is_accepted_and_a_flipped_one_is_not(registrar, target, pelvis):
    own, flipped = (registrar.register(seen(pelvis) * flip, target) for flip in (1.0, FLIP))
    assert own.ok and own.confidence > 0.9
    assert flipped.status is RegistrationStatus.LOW_CONFIDENCE and "flipped" in flipped.reason
    assert flipped.T_target_source is None and flipped.confidence <= CONFIG.rules.ruled_out


def test_nothing_but_this_rule_refuses_the_flipped_pelvis(target, pelvis):
    """No other rule; the probability is held still."""
    without = replace(CONFIG, rules=replace(CONFIG.rules, mirrored_better=10.0), min_confidence=0.0)
    assert Registrar(without).register(seen(pelvis) * FLIP, target).ok


def test_of_the_images_that_lie_on_the_bone_the_best_one_is_taken(target, monkeypatch):
    begun = []

    def refined(poses, *_):
        begun.extend(poses)
        return poses, np.array([3.0, 1.0, 2.0])

    monkeypatch.setattr(mirror, "refine_many", refined)
    monkeypatch.setattr(mirror, "_is_own_image", lambda image, target: True)
    np.testing.assert_array_equal(mirror._own_image(target, CONFIG.verification, 1), begun[1] @ mirror.FLIP)


def test_the_image_of_a_bone_is_a_reflection_and_found_once(registrar, target, monkeypatch):
    target = replace(target, cache={})
    image = mirror._own_image(target, CONFIG.verification, 1)
    assert np.linalg.det(image[:3, :3]) == pytest.approx(-1.0)
    mirror.is_symmetric(target, CONFIG)
    monkeypatch.setattr(mirror, "_own_image", None)  # is not called again
    np.testing.assert_array_equal(target.cache["own image", 0.0, CONFIG.verification], image)
    assert registrar.register(seen(make_bone("pelvis", 900_001)), target).ok


def test_the_image_is_found_where_a_sensor_with_a_stand_off_sees_the_bone(pelvis):
    """Targets that differ in the stand-off alone share their cache, and not their image."""
    target = Registrar(CONFIG).prepare(pelvis)
    raised = offset_surface(target, SensorConfig(standoff_mm=5.0))
    for each in (raised, target):
        found = mirror.image_margin(np.eye(4), sources.prepare(seen(pelvis)), each, CONFIG)
        assert found < mirror.LIMITS[1]
    assert {("own image", mm, CONFIG.verification) for mm in (0.0, 5.0)} <= target.cache.keys()


def test_what_is_kept_of_a_target_is_not_taken_for_that_of_other_settings(target):
    """A registrar that hardly refines took the pelvis for symmetric, and switched the rule off for all after it."""
    hasty = replace(CONFIG, verification=replace(CONFIG.verification, middle_limits_mm=(0.2, 0.1, 1)))
    fresh = replace(target, cache={("symmetric", 0.0, hasty.verification): True})
    assert mirror.is_symmetric(fresh, hasty) and not mirror.is_symmetric(fresh, CONFIG)


@pytest.mark.parametrize(("median_mm", "is_symmetric"), [(0.39, True), (0.41, False)])
def test_a_model_is_symmetric_where_most_of_it_lies_on_its_image(target, monkeypatch, median_mm, is_symmetric):
    """Models of an atlas do; what is not on it counts no more for being far off."""
    off_mm = lambda T, points, _: np.where(np.arange(len(points)) % 2, median_mm, np.arange(len(points)) % 4 * 50.0)  # noqa: E731
    monkeypatch.setattr(mirror, "distances_mm", off_mm)
    assert mirror.is_symmetric(replace(target, cache={}), CONFIG) is is_symmetric


def test_gross_points_that_lie_near_the_image_are_no_sign_of_a_flip(target, pelvis, monkeypatch):
    """Of the mean square most may be theirs; the other points lie on the bone itself."""
    source, refined_images = sources.prepare(seen(pelvis)), mirror._refined_images
    image_mm2 = []

    def with_gross_points(*given):
        poses, scores, own_mm2 = refined_images(*given)
        image_mm2.append(float(scores[0]))
        return poses, 0.8 * np.full_like(scores, own_mm2), own_mm2

    monkeypatch.setattr(mirror, "_refined_images", with_gross_points)
    assert mirror.image_margin(np.eye(4), source, target, CONFIG) > 0.0
    monkeypatch.setattr(mirror, "evaluate", lambda *_: SimpleNamespace(sigma_mm=0.4))
    assert mirror.image_margin(np.eye(4), source, target, CONFIG) == pytest.approx(0.0)
    assert image_mm2[0] > 0.4**2


def test_of_a_symmetric_model_no_source_is_refused_for_its_image(registrar, target, pelvis, monkeypatch):
    points = pelvis.sample(20_000, np.random.default_rng(2))[0]
    half = points[points[:, 0] > 0.0]
    symmetric = registrar.prepare(np.concatenate([half, half * FLIP]))
    assert mirror.is_symmetric(symmetric, CONFIG) and not mirror.is_symmetric(target, CONFIG)
    monkeypatch.setattr(mirror, "image_margin", lambda *_: -1.0)
    right_half = seen(pelvis)[seen(pelvis)[:, 0] > 0.0]
    assert registrar.register(right_half, symmetric).ok
    assert registrar.register(right_half * FLIP, symmetric).ok
    assert "mirror image" in registrar.register(right_half, target).reason


def test_a_bone_without_an_image_is_not_symmetric(target):
    assert not mirror.is_symmetric(replace(target, cache={("own image", 0.0, CONFIG.verification): None}), CONFIG)


def test_a_bone_without_an_image_has_the_largest_margin(target):
    unlike = replace(target, cache={("own image", 0.0, CONFIG.verification): None})
    assert mirror.image_margin(np.eye(4), None, unlike, CONFIG) == mirror.LIMITS[1]


@pytest.mark.parametrize(
    ("count", "below", "better", "better_mostly", "refused"),
    [
        (400, 0.0, 1.5, 1.5, True),
        (400, 0.0, 1.0, 1.0, False),
        (400, 0.0, 1.5, 0.9, False),  # gross points alone lie nearer to the image
        (400, 0.0, 0.9, 1.5, False),
        (401, 0.0, 1.5, 1.5, False),
        (401, 1.0, 1.5, 1.5, True),
        (401, 1.0, 1.0, 1.0, False),
    ],
)
def test_few_points_and_unsure_answers_are_registered_mirrored_as_well(
    monkeypatch, count, below, better, better_mostly, refused
):
    config = replace(CONFIG, rules=replace(CONFIG.rules, mirrored_below=below))
    registrar, femur = Registrar(config), make_bone("femur", 900_001)
    in_rounds, asked, own = Registrar._in_rounds, [], []

    def rounds(self, source, target, poses, clock, *enough):
        asked.append(source.points)
        if len(asked) == 1:
            own.append(in_rounds(self, source, target, poses, clock, *enough))
            return own[0]
        fit = SimpleNamespace(sigma_mm=own[0].fit.sigma_mm / np.sqrt(better_mostly))
        return SimpleNamespace(candidates=SimpleNamespace(scores=own[0].candidates.scores / better), fit=fit, seen=None)

    monkeypatch.setattr(Registrar, "_in_rounds", rounds)
    result = registrar.register(seen(femur, count), registrar.prepare(femur))
    assert (not result.ok and "mirror image" in result.reason) is refused
    assert len(asked) == (2 if count <= 400 or below else 1)
    if len(asked) == 2:
        gaps = np.sort(asked[0] * [1.0, 1.0, -1.0], axis=0) - np.sort(asked[1], axis=0)
        np.testing.assert_allclose(gaps, 0.0, atol=1e-9)


@pytest.mark.parametrize(("count", "is_enough", "rounds"), [(401, False, 2), (401, True, 1), (400, True, 2)])
def test_an_unsure_answer_that_is_enough_is_not_registered_mirrored_but_few_points_are(
    monkeypatch, count, is_enough, rounds
):
    registrar, femur = Registrar(CONFIG), make_bone("femur", 900_001)
    in_rounds, asked, seen_femur = Registrar._in_rounds, [], seen(femur, count)
    target = registrar.prepare(femur)
    monkeypatch.setattr(Registrar, "_in_rounds", lambda *given: asked.append(1) or in_rounds(*given))
    config = replace(CONFIG, rules=replace(CONFIG.rules, mirrored_below=1.0))
    Registrar(config).assess(seen_femur, target, enough=lambda assessment: is_enough)
    assert len(asked) == rounds


def test_nothing_is_registered_mirrored_where_the_image_on_the_bone_fits_better_already(monkeypatch):
    registrar, femur = Registrar(CONFIG), make_bone("femur", 900_001)
    in_rounds, asked = Registrar._in_rounds, []

    def rounds(self, source, *rest):
        asked.append(source)
        return in_rounds(self, source, *rest)

    monkeypatch.setattr(Registrar, "_in_rounds", rounds)
    monkeypatch.setattr(mirror, "image_margin", lambda *given: -1.0)
    result = registrar.register(seen(femur, 400), registrar.prepare(femur))
    assert "mirror image" in result.reason and len(asked) == 1


def test_all_points_of_a_source_are_registered_mirrored(pelvis):
    source = sources.prepare(seen(pelvis), SourceConfig(fitted_points=500))
    asked = []
    answer = SimpleNamespace(source=source, target=None)
    found = checks.full_image_margin(answer, CONFIG, lambda flipped, target: asked.append(flipped.whole))
    flipped = source.whole * [1.0, 1.0, -1.0]
    assert found == np.inf and np.array_equal(np.sort(asked[0], axis=0), np.sort(flipped, axis=0))


def test_the_image_of_what_a_camera_saw_is_compared_by_distances_and_not_by_scores_of_lines_of_sight(target, pelvis):
    answer, image = (Registrar(CONFIG).assess(seen(pelvis) * flip, target) for flip in (1.0, FLIP))
    in_scene = [replace(a, seen=a.source, candidates=replace(a.candidates, scores=1.0 / a.candidates.scores))
                for a in (answer, image)]  # fmt: skip
    found = [checks.full_image_margin(b, CONFIG, lambda *_, a=a: a) for a, b in ((answer, image), in_scene)]
    assert found[0] == found[1] < -1.0, "the source is flipped, and its image lies on the bone"


@pytest.mark.parametrize(
    ("seen_from", "asks_scene"),
    [({}, False), ({"seen": 1}, True), ({"seen": 1, "inferred_viewpoint": np.zeros(3)}, False)],
)
@pytest.mark.parametrize(
    ("times", "more", "refused"), [(1.0 / 0.98, 0.1, False), (1.0 / 1.02, 0.1, True), (1.0 / 1.02, 0.0, False)]
)
def test_the_image_of_a_known_scene_is_registered_as_one(
    monkeypatch, target, seen_from, asks_scene, times, more, refused
):
    """Of a wound on the other side's model the pose was nonsense, and so was its image on the bone: .65."""
    asked = []
    monkeypatch.setattr(checks.mirror, "is_symmetric", lambda *_: False)
    monkeypatch.setattr(checks.mirror, "image_margin", lambda *_: 0.0)
    monkeypatch.setattr(checks, "full_image_margin", lambda *_: asked.append("source") or np.log(times))
    answer = Registrar(CONFIG).assess(seen(make_bone("pelvis", 900_001)), target)
    answer = replace(answer, refusal=None, probability=0.6, **seen_from)

    def scene():
        asked.append("scene")
        image = replace(answer.candidates, scores=answer.candidates.scores * times)
        return replace(answer, candidates=image, probability=0.6 + more)

    found = checks.unless_mirrored(answer, CONFIG, False, lambda *_: pytest.fail("asked"), scene)
    is_refused = refused if asks_scene else times < 1.0
    assert asked == ["scene" if asks_scene else "source"] and (found.refusal is not None) is is_refused
    asked.clear()
    many = replace(CONFIG, rules=replace(CONFIG.rules, mirrored_points=len(answer.source.points)))
    checks.unless_mirrored(answer, many, True, lambda *_: pytest.fail("asked"), scene)
    assert asked == ([] if asks_scene else ["source"]), "of a sure scene a small part is no reason"


def test_a_mirrored_scene_without_a_pose_fits_no_better():
    assert checks.scene_image_margin(SimpleNamespace(), None) == np.inf


def test_a_source_is_mirrored_at_planes_along_the_bone_and_at_its_own(target, pelvis):
    points, T = seen(pelvis), np.diag([1.0, -1.0, -1.0, 1.0])
    found = mirror._reflections(T, points, target)
    long_axis = target.main_axes[0]
    of_bone, own = found[: mirror.PLANES], found[mirror.PLANES :]
    normals = [np.linalg.svd(np.eye(3) - H[:3, :3])[0][:, 0] for H in found]
    assert len(own) == 3
    for H, normal in zip(found, normals, strict=True):
        np.testing.assert_allclose(H[:3, :3], np.eye(3) - 2.0 * np.outer(normal, normal), atol=1e-9)
    for H in of_bone:
        np.testing.assert_allclose(H[:3, :3] @ long_axis, long_axis, atol=1e-9)
        np.testing.assert_allclose(H[:3, :3] @ target.centre_mm + H[:3, 3], target.centre_mm, atol=1e-9)
    turned = np.abs(np.array(normals[: mirror.PLANES]) @ normals[0])
    np.testing.assert_allclose(turned, np.abs(np.cos(np.arange(mirror.PLANES) * np.pi / mirror.PLANES)), atol=1e-9)
    middle = (points * [1.0, -1.0, -1.0]).mean(axis=0)
    for H in own:
        np.testing.assert_allclose(H[:3, :3] @ middle + H[:3, 3], middle, atol=1e-9)
    assert abs(np.linalg.det(np.array(normals[mirror.PLANES :]))) == pytest.approx(1.0)
