"""What a camera saw from several places: which point from where, and what the places say together."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
from scipy.special import logit

from gapr_core.config import ClutterConfig, RegistrarConfig, SourceConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.confidence.classifier import Judgement
from gapr_core.registration.problem import source as sources
from gapr_core.registration.scenes import free_space, look_agreement
from gapr_core.registration.scenes import scene as scenes
from gapr_core.registration.scenes.free_space import Visible
from gapr_core.registration.scenes.look_agreement import LookShares
from gapr_core.registration.scenes.scene import MOST_PLACES, Look, Scene
from gapr_core.results import Effect, Finding, LookFit, Refusal, RegistrationStatus

EYES = np.array([[0.0, 0.0, 300.0], [0.0, 0.0, -300.0]])
CONFIG = RegistrarConfig(
    num_threads=1, source=SourceConfig(normal_neighbours=8), clutter=ClutterConfig(levelled_by=4)
)  # fmt: skip


@pytest.fixture(scope="module")
def source():
    return sources.prepare(tiny.on_ellipsoid(120), CONFIG.source)


def test_one_place_is_one_look():
    (look,) = scenes.split([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]], [4.0, 5.0, 6.0])
    assert look.points.tolist() == [[1.0, 2.0, 3.0]] and look.viewpoint.tolist() == [4.0, 5.0, 6.0]


def test_points_go_with_the_place_that_they_were_seen_from():
    points = np.arange(15.0).reshape(5, 3)
    points[2] = np.nan
    first, second = scenes.split(points, EYES[[0, 1, 0, 1, 0]])
    assert first.viewpoint.tolist() == EYES[1].tolist() and first.points.tolist() == points[[1, 3]].tolist()
    assert second.viewpoint.tolist() == EYES[0].tolist() and second.points.tolist() == points[[0, 4]].tolist()


@pytest.mark.parametrize(("viewpoint", "said"), [
    ([1.0, 2.0], r"\(3,\) viewpoint"), (np.zeros((4, 3)), r"\(5, 3\) viewpoint"), (np.zeros((5, 2)), r"\(5, 3\)"),
    (np.full((5, 3), np.inf), "finite"), ([np.nan] * 3, "finite"), ("origin", "viewpoint"),
])  # fmt: skip
def test_a_viewpoint_that_is_none_is_refused(viewpoint, said):
    with pytest.raises(InvalidPointCloudError, match=said):
        scenes.split(np.arange(15.0).reshape(5, 3), viewpoint)


@pytest.mark.parametrize(("count", "is_refused"), [(MOST_PLACES, False), (MOST_PLACES + 1, True)])
def test_there_are_only_so_many_places(count, is_refused):
    points = np.arange(3.0 * count).reshape(count, 3)
    if is_refused:
        with pytest.raises(InvalidPointCloudError, match=f"at most {MOST_PLACES} places"):
            scenes.split(points, points)
    else:
        assert len(scenes.split(points, points)) == count


@pytest.mark.parametrize("source", [np.full((2, 3), np.nan), np.empty((0, 3))])
def test_a_source_without_a_finite_point_is_refused_as_one_of_too_few(source):
    (look,) = scenes.split(source, EYES[: len(source)])
    assert not len(look.points) and scenes.prepared([look], CONFIG).status.value == "TOO_FEW_POINTS"


def test_where_a_point_that_is_none_was_seen_from_does_not_matter():
    points, places = np.arange(12.0).reshape(4, 3), EYES[[0, 1, 1, 0]].copy()
    points[1], places[1] = np.nan, np.nan
    first, second = scenes.split(points, places)
    assert first.points.tolist() == points[[2]].tolist() and second.points.tolist() == points[[0, 3]].tolist()
    places[2] = np.nan
    with pytest.raises(InvalidPointCloudError, match="finite"):
        scenes.split(points, places)


def test_looks_stay_apart_where_their_places_are_the_same():
    seen = [Look(np.ones((2, 3)), EYES[0]), Look(np.zeros((1, 3)), EYES[0])]
    again = scenes.split(np.concatenate([look.points for look in seen]), seen)
    assert len(again) == 2 and all(look is given for look, given in zip(again, seen, strict=True))


def test_a_look_of_too_few_points_is_left_out_and_where_all_are_the_first_is_refused(source):
    enough, few = Look(source.points, EYES[0]), Look(source.points[:2], EYES[1])
    scene = scenes.prepared([few, enough], CONFIG)
    assert isinstance(scene, Scene) and scene.viewpoints.tolist() == EYES[:1].tolist() and len(scene.images) == 1
    assert scene.names.tolist() == [1] and scene.given.tolist() == EYES[::-1].tolist()
    for count, names in ((39, [1]), (40, [0, 1])):
        scene = scenes.prepared([Look(source.points[:count], EYES[1]), enough], CONFIG)
        assert scene.names.tolist() == names and len(scene.images) == len(names)
    assert scenes.prepared([Look(source.points[:39], EYES[1])], CONFIG).names.tolist() == [0]
    refusal = scenes.prepared([few, few], CONFIG)
    assert refusal.status.value == "TOO_FEW_POINTS" and "2 distinct" in refusal.reason


def test_looks_that_are_no_body_together_are_refused(source, monkeypatch):
    """Each is one by itself; of both together the points that are no outliers may be a line."""
    line, prepare = Refusal(RegistrationStatus.DEGENERATE, "a line"), sources.prepare

    def prepared(points, *how, **more):
        return line if len(points) > len(source.points) else prepare(points, *how, **more)

    monkeypatch.setattr(sources, "prepare", prepared)
    assert scenes.prepared([Look(source.points, eye) for eye in EYES], CONFIG) is line


def test_a_camera_sees_the_cloud_levelled_over_its_neighbours_along_the_normals(source, monkeypatch):
    seen = []
    monkeypatch.setattr(free_space, "see", lambda *words: seen.append(words))
    scene = scenes.scene_from(source, EYES[0], CONFIG)
    ((levelled, normals, viewpoint),) = seen
    assert scene.source.oriented and viewpoint.tolist() == EYES[0].tolist()
    assert scene.regions == () and scene.look.tolist() == [0] * len(source.points)
    for k in (0, 17, 60):
        mean = source.points[source.neighbours[k][:4]].mean(axis=0)
        along = source.normals[k] * (source.normals[k] @ (mean - source.points[k]))
        assert levelled[k] == pytest.approx(source.points[k] + along)
    assert (((EYES[0] - source.points) * normals).sum(axis=1) >= 0.0).all()


def test_normals_of_a_scene_and_of_its_parts_point_to_the_place_of_each_point(source):
    above, below = (source.points[sign * source.points[:, 2] > 0.0] for sign in (1.0, -1.0))
    scene = scenes.prepared([Look(above, EYES[0]), Look(below, EYES[1])], CONFIG)
    is_above = scene.source.points[:, 2] > 0.0
    assert np.array_equal(scene.look, np.where(is_above, 0, 1)) and len(scene.images) == 2
    assert [len(look.source.points) for look in scene.each] == [is_above.sum(), (~is_above).sum()]
    assert [look.viewpoints[0].tolist() for look in scene.each] == EYES.tolist() and scene.names.tolist() == [0, 1]
    towards = EYES[scene.look] - scene.source.points
    assert scene.source.oriented and ((scene.source.normals * towards).sum(axis=1) >= 0.0).all()
    members = np.arange(len(is_above)) % 2 == 0
    part = scene.part(members, CONFIG)
    assert np.array_equal(part.points, scene.source.points[members]) and part.oriented
    assert ((part.normals * towards[members]).sum(axis=1) >= 0.0).all()


def visible(explained, violating, compared):
    return Visible(np.array([explained]), np.array([violating]), np.array([compared]))


def test_every_place_counts_alike(monkeypatch):
    said = {"a": visible(0.2, 0.1, 0.5), "b": visible(0.4, 0.0, 0.9)}
    monkeypatch.setattr(free_space, "compare", lambda poses, points, normals, image, *how: said[image])
    scene = Scene(None, ("a", "b"), EYES, None)
    seen = scene.compare(None, None, None, 0.6, 3.0)
    found = [float(values[0]) for values in (seen.explained, seen.violating, seen.compared)]
    assert found == pytest.approx([0.3, 0.05, 0.7])


HERE = LookShares(compared=0.2, on=0.12, near=0.18, seen_through=0.0, own_compared=0.2, own_on=0.13, away_mm=0.5)
NOTHING = LookShares(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(("changes", "is_apart"), [
    ({}, False),
    ({"own_on": 0.172, "away_mm": 2.1}, True),  # of .2 that it could show, .26 more elsewhere
    ({"own_on": 0.168, "away_mm": 2.1}, False),  # .24 more
    ({"own_on": 0.172, "away_mm": 1.9}, False),  # as near as noise takes it
    ({"own_on": 0.172, "away_mm": 2.1, "own_compared": 0.25}, False),  # .21 of what it could show there
    ({"seen_through": 0.032}, True), ({"seen_through": 0.028}, False),  # .15 of .2 is .03
    ({"near": 0.089}, True), ({"near": 0.091}, False),  # half of the share of the best, .9, is .09 of .2
    ({"on": 0.047}, True), ({"on": 0.049}, False),  # .3 of the share of the best, .8, is .048 of .2
])  # fmt: skip
def test_a_look_is_apart_where_it_fits_elsewhere_looks_through_the_bone_or_hardly_agrees(changes, is_apart):
    assert look_agreement.is_apart(HERE._replace(**changes), near=0.9, on=0.8) is is_apart


FIT, APART, BLIND = LookFit.FITS, LookFit.APART, LookFit.BLIND


def fits(monkeypatch, *found):
    monkeypatch.setattr(look_agreement, "_shares_of_look", lambda T, number, *rest: found[number])
    scene = SimpleNamespace(images=found, source=tiny.ellipsoid())
    return look_agreement.look_fits(np.eye(4), scene, tiny.ellipsoid(), CONFIG)


def test_each_look_is_compared_with_the_widest_and_the_best(monkeypatch):
    poor, small = HERE._replace(near=0.07), HERE._replace(compared=0.019, on=0.01, near=0.018, own_on=0.01)
    found = fits(monkeypatch, HERE, poor, HERE, small, small._replace(compared=0.021))
    assert found == [FIT, APART, FIT, BLIND, FIT]
    assert fits(monkeypatch, poor, poor) == [FIT, FIT]


def test_what_lies_more_than_10_mm_off_the_bone_is_not_laid_on_it(monkeypatch):
    asked = []
    monkeypatch.setattr(look_agreement, "_shares_of_look", lambda T, number, close, *_: asked.append(close) or HERE)
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -9.0], [0.0, 0.0, 11.0], [0.0, 900.0, 0.0]])
    scene = SimpleNamespace(images=(0, 1), source=SimpleNamespace(points=points))
    assert look_agreement.look_fits(np.eye(4), scene, tiny.plane(), CONFIG) == [FIT, FIT]
    assert [each.tolist() for each in asked] == 2 * [[True, True, False, False]]


def test_a_blind_look_is_the_measure_of_none(monkeypatch):
    half = HERE._replace(near=0.09, on=0.05, own_on=0.05)
    found = fits(monkeypatch, half, half, half, NOTHING._replace(compared=0.001, near=0.001, on=0.001))
    assert found == [FIT, FIT, FIT, BLIND]


def test_what_a_look_shows_elsewhere_is_no_blindness(monkeypatch):
    """Where the bone is it could show hardly anything, and all of it a few millimetres on."""
    found = fits(monkeypatch, HERE, HERE, HERE, HERE._replace(compared=0.01, on=0.01, near=0.01, away_mm=6.0))
    assert found == [FIT, FIT, FIT, APART]


def test_one_look_has_nothing_to_fit(monkeypatch):
    assert fits(monkeypatch, HERE._replace(own_on=0.9, away_mm=9.0)) == [FIT]


def agreed(monkeypatch, fits, own=(), probability=0.8, names=None, given=None):
    """What a pose is worth whose looks fit so, where looks by themselves have the poses `own`, by number."""
    fit = SimpleNamespace(T=np.eye(4))
    common = Assessment(fit, None, None, {}, Judgement(float(logit(probability)), 3.0), 0.0, None, None)
    given = 100.0 * np.arange(3.0 * len(fits)).reshape(-1, 3) if given is None else given
    names = np.arange(len(fits)) if names is None else np.array(names)
    scene = SimpleNamespace(images=fits, each=range(len(fits)), names=names, given=given)
    monkeypatch.setattr(look_agreement, "look_fits", lambda *_: list(fits))
    return look_agreement.unless_apart(common, scene, None, dict(own).get, CONFIG)


def alone(x_mm, deg=0.0, probability=0.8, findings=()):
    """A look by itself has a pose so far away, turned so much about the middle of what it shows."""
    points = np.array([[50.0, 0.0, 0.0], [70.0, 0.0, 0.0]])
    turn = se3.exp([x_mm, 0.0, 0.0, 0.0, 0.0, np.radians(deg)], points.mean(axis=0))
    fit, source = SimpleNamespace(T=turn), SimpleNamespace(points=points)
    return Assessment(fit, None, None, {}, Judgement(float(logit(probability)), 3.0), 0.0, source, None, findings)


@pytest.mark.parametrize(("fits", "is_refused"), [
    ([FIT] * 4, False), ([FIT, APART, FIT, FIT], True), ([FIT, BLIND, FIT], False), ([FIT, BLIND, BLIND, FIT], True),
    ([FIT, BLIND], True), ([FIT, FIT, FIT, BLIND], False), ([BLIND, FIT, BLIND, BLIND], True),
])  # fmt: skip
def test_a_pose_stands_where_no_look_is_apart_and_less_than_half_of_them_are_blind(monkeypatch, fits, is_refused):
    found = agreed(monkeypatch, fits)
    assert [look.fit for look in found.looks] == fits and (found.refusal is not None) is is_refused
    assert any(each.check == look_agreement.CHECK for each in found.findings) is is_refused


def test_the_refusal_names_the_places(monkeypatch):
    refusal = agreed(monkeypatch, [APART, FIT, BLIND]).refusal
    assert refusal.status.value == "AMBIGUOUS" and "from (0, 100, 200) and (600, 700, 800) mm" in refusal.text


@pytest.mark.parametrize(("own", "fits"), [
    (alone(2.9), True), (alone(3.1), False), (alone(0.0, 2.9), True), (alone(0.0, 3.1), False),
    (alone(0.0, probability=0.49), False),
    (alone(0.0, findings=(Finding("x", Effect.REFUSE, 1.0, 0.5, RegistrationStatus.DEGENERATE, ""),)), False),
    (None, False),
])  # fmt: skip
def test_a_look_that_seems_apart_fits_where_it_alone_has_the_same_pose(monkeypatch, own, fits):
    found = agreed(monkeypatch, [FIT, APART, FIT], {1: own})
    assert [look.fit for look in found.looks] == [FIT, FIT if fits else APART, FIT]
    assert (found.refusal is None) is fits


def test_each_look_that_seems_apart_is_asked_by_itself(monkeypatch):
    found = agreed(monkeypatch, [APART, FIT, APART], {0: alone(1.0), 1: alone(1.0)})
    assert [look.fit for look in found.looks] == [FIT, FIT, APART] and found.refusal is not None


def test_looks_of_too_few_points_are_named_and_refuse_nothing(monkeypatch):
    given = np.arange(12.0).reshape(4, 3)
    found = agreed(monkeypatch, [FIT, BLIND, FIT], names=[0, 2, 3], given=given)
    assert [look.fit for look in found.looks] == [FIT, LookFit.TOO_SMALL, BLIND, FIT] and found.refusal is None
    assert all(np.array_equal(look.viewpoint, place) for look, place in zip(found.looks, given, strict=True))


def test_looks_are_not_asked_of_a_pose_that_is_refused_anyway(monkeypatch):
    found = agreed(monkeypatch, [APART, BLIND, BLIND], probability=0.2)
    assert {look.fit for look in found.looks} == {LookFit.NOT_ASKED} and found.refusal is None


def test_of_one_place_nothing_is_said(monkeypatch):
    assert agreed(monkeypatch, [FIT], given=np.zeros((1, 3))).looks == ()


def test_each_look_is_laid_on_the_bone_by_its_own_points_near_it():
    """Two views of an ellipsoid from above, of which the second is shifted by 3 mm: its own pose is there."""
    target = tiny.ellipsoid(count=900)
    points = tiny.on_ellipsoid(1500)
    points = points[points[:, 2] > 0.0]
    shift = np.array([3.0, 0.0, 0.0])
    first, second = points[::2], points[1::2] + shift
    scene = scenes.prepared([Look(first, EYES[0]), Look(second, EYES[0] + [1.0, 0.0, 0.0])], CONFIG)
    close = np.ones(len(scene.look), dtype=bool)
    here, moved = (look_agreement._shares_of_look(np.eye(4), number, close, scene, target, CONFIG) for number in (0, 1))
    assert here.away_mm < 0.5 and moved.away_mm == pytest.approx(3.0, abs=0.5)
    assert moved.own_on > moved.on + 0.02 and here.compared > 0.1 and here.near >= here.on
    settings = CONFIG.clutter
    spread = look_agreement.clutter.spread(target, settings.final_target_points)
    common = scene.each[1].compare(np.eye(4)[None], *spread, settings.middle_on_mm, settings.front_mm, 1)
    assert (moved.compared, moved.near) == pytest.approx((common.compared[0], common.explained[0]), abs=1e-12)
    far = look_agreement._shares_of_look(np.eye(4), 1, ~close, scene, target, CONFIG)
    assert far.away_mm == 0.0 and far.own_on == far.on
    aside = replace(scene, look=np.where(scene.look == 1, 5, scene.look))
    gone = look_agreement._shares_of_look(np.eye(4), 1, close, aside, target, CONFIG)
    assert gone.away_mm == 0.0 and gone.own_on == gone.on
