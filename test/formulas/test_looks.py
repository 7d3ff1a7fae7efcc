"""What a camera saw from several places: which point from where, and what the places say together."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import tiny

from gapr_core.config import ClutterConfig, FreeSpaceConfig, RegistrarConfig, SourceConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.registration import apart, free_space, looks
from gapr_core.registration import source as sources
from gapr_core.registration.apart import Own
from gapr_core.registration.free_space import Visible
from gapr_core.registration.looks import MOST_PLACES, Look, Scene

EYES = np.array([[0.0, 0.0, 300.0], [0.0, 0.0, -300.0]])
CONFIG = RegistrarConfig(
    num_threads=1, source=SourceConfig(normal_neighbours=8), clutter=ClutterConfig(levelled_by=4)
)  # fmt: skip


@pytest.fixture(scope="module")
def source():
    return sources.prepare(tiny.on_ellipsoid(120), CONFIG.source)


def test_one_place_is_one_look():
    (look,) = looks.split([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0]], [4.0, 5.0, 6.0])
    assert look.points.tolist() == [[1.0, 2.0, 3.0]] and look.viewpoint.tolist() == [4.0, 5.0, 6.0]


def test_points_go_with_the_place_that_they_were_seen_from():
    points = np.arange(15.0).reshape(5, 3)
    points[2] = np.nan
    first, second = looks.split(points, EYES[[0, 1, 0, 1, 0]])
    assert first.viewpoint.tolist() == EYES[1].tolist() and first.points.tolist() == points[[1, 3]].tolist()
    assert second.viewpoint.tolist() == EYES[0].tolist() and second.points.tolist() == points[[0, 4]].tolist()


@pytest.mark.parametrize(("viewpoint", "said"), [
    ([1.0, 2.0], r"\(3,\) viewpoint"), (np.zeros((4, 3)), r"\(5, 3\) viewpoint"), (np.zeros((5, 2)), r"\(5, 3\)"),
    (np.full((5, 3), np.inf), "finite"), ([np.nan] * 3, "finite"), ("origin", "viewpoint"),
])  # fmt: skip
def test_a_viewpoint_that_is_none_is_refused(viewpoint, said):
    with pytest.raises(InvalidPointCloudError, match=said):
        looks.split(np.arange(15.0).reshape(5, 3), viewpoint)


@pytest.mark.parametrize(("count", "is_refused"), [(MOST_PLACES, False), (MOST_PLACES + 1, True)])
def test_there_are_only_so_many_places(count, is_refused):
    points = np.arange(3.0 * count).reshape(count, 3)
    if is_refused:
        with pytest.raises(InvalidPointCloudError, match=f"at most {MOST_PLACES} places"):
            looks.split(points, points)
    else:
        assert len(looks.split(points, points)) == count


@pytest.mark.parametrize("source", [np.full((2, 3), np.nan), np.empty((0, 3))])
def test_a_source_without_a_finite_point_is_refused_as_one_of_too_few(source):
    found = looks.split(source, EYES[: len(source)])
    assert [len(look.points) for look in found] == [0] * max(len(source), 1)
    assert looks.prepared(found, CONFIG).status.value == "TOO_FEW_POINTS"


def test_a_look_of_too_few_points_is_left_out_and_where_all_are_the_first_is_refused(source):
    enough, few = Look(source.points, EYES[0]), Look(source.points[:2], EYES[1])
    scene = looks.prepared([few, enough], CONFIG)
    assert isinstance(scene, Scene) and scene.viewpoints.tolist() == EYES[:1].tolist() and len(scene.images) == 1
    assert scene.left_out.tolist() == EYES[1:].tolist() and not len(looks.prepared([enough], CONFIG).left_out)
    refusal = looks.prepared([few, few], CONFIG)
    assert refusal.status.value == "TOO_FEW_POINTS" and "2 distinct" in refusal.reason


def test_a_camera_sees_the_cloud_levelled_over_its_neighbours_along_the_normals(source, monkeypatch):
    seen = []
    monkeypatch.setattr(free_space, "see", lambda *words: seen.append(words))
    scene = looks.scene_from([source], EYES[:1], CONFIG)
    ((levelled, normals, viewpoint, config),) = seen
    assert scene.source.oriented and viewpoint.tolist() == EYES[0].tolist() and config is CONFIG.clutter.free_space
    assert scene.regions == () and scene.look.tolist() == [0] * len(source.points)
    for k in (0, 17, 60):
        mean = source.points[source.neighbours[k][:4]].mean(axis=0)
        along = source.normals[k] * (source.normals[k] @ (mean - source.points[k]))
        assert levelled[k] == pytest.approx(source.points[k] + along)
    assert (((EYES[0] - source.points) * normals).sum(axis=1) >= 0.0).all()


def test_normals_of_a_scene_and_of_its_parts_point_to_the_place_of_each_point(source):
    above, below = (source.points[sign * source.points[:, 2] > 0.0] for sign in (1.0, -1.0))
    scene = looks.scene_from([sources.prepare(each, CONFIG.source) for each in (above, below)], EYES, CONFIG)
    is_above = scene.source.points[:, 2] > 0.0
    assert np.array_equal(scene.look, np.where(is_above, 0, 1)) and len(scene.images) == 2
    assert scene.viewpoint == pytest.approx(EYES.mean(axis=0))
    towards = EYES[scene.look] - scene.source.points
    assert scene.source.oriented and ((scene.source.normals * towards).sum(axis=1) >= 0.0).all()
    members = np.arange(len(is_above)) % 2 == 0
    part = scene.part(members, CONFIG)
    assert np.array_equal(part.points, scene.source.points[members]) and part.oriented
    assert ((part.normals * towards[members]).sum(axis=1) >= 0.0).all()


def visible(explained, violating, compared):
    return Visible(np.array([explained]), np.array([violating]), np.array([compared]), FreeSpaceConfig())


def test_every_place_counts_alike(monkeypatch):
    said = {"a": visible(0.2, 0.1, 0.5), "b": visible(0.4, 0.0, 0.9)}
    monkeypatch.setattr(free_space, "compare", lambda poses, points, normals, image, *how: said[image])
    scene = Scene(None, ("a", "b"), EYES, None)
    seen = scene.compare(None, None, None, 0.6, 3.0)
    found = [float(values[0]) for values in (seen.explained, seen.violating, seen.compared)]
    assert found == pytest.approx([0.3, 0.05, 0.7])
    assert scene.of(1).compare(None, None, None, 0.6, 3.0).explained.tolist() == [0.4]


HERE = Own(compared=0.2, on=0.12, near=0.18, seen_through=0.0, own_compared=0.2, own_on=0.13, away_mm=0.5)
BLIND = Own(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


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
    assert apart.is_apart(HERE._replace(**changes), near=0.9, on=0.8) is is_apart


def fits(monkeypatch, *found):
    monkeypatch.setattr(apart, "_own", lambda T, number, *rest: found[number])
    scene = SimpleNamespace(images=found, source=tiny.ellipsoid())
    return apart.look_fits(np.eye(4), scene, tiny.ellipsoid(), CONFIG)


def test_each_look_is_compared_with_the_widest_and_the_best(monkeypatch):
    poor, small = HERE._replace(near=0.07), HERE._replace(compared=0.019, on=0.01, near=0.018, own_on=0.01)
    found = fits(monkeypatch, HERE, poor, HERE, small, small._replace(compared=0.021))
    assert found.apart.tolist() == [False, True, False, False, False] and found.is_refused
    assert found.blind.tolist() == [False, False, False, True, False]
    assert not fits(monkeypatch, poor, poor).is_refused


def test_a_blind_look_is_the_measure_of_none(monkeypatch):
    half = HERE._replace(near=0.09, on=0.05, own_on=0.05)
    found = fits(monkeypatch, half, half, half, BLIND._replace(compared=0.001, near=0.001, on=0.001))
    assert not found.apart.any() and found.blind.tolist() == [False, False, False, True]


def test_what_a_look_shows_elsewhere_is_no_blindness(monkeypatch):
    """Where the bone is it could show hardly anything, and all of it a few millimetres on."""
    found = fits(monkeypatch, HERE, HERE, HERE, HERE._replace(compared=0.01, on=0.01, near=0.01, away_mm=6.0))
    assert found.apart.tolist() == [False, False, False, True] and not found.blind.any() and found.is_refused


@pytest.mark.parametrize(("looks", "blind", "is_refused"), [(3, 1, False), (4, 2, True), (2, 1, True), (4, 1, False)])
def test_a_pose_stands_where_less_than_half_of_the_looks_are_blind(monkeypatch, looks, blind, is_refused):
    found = fits(monkeypatch, *[HERE] * (looks - blind), *[BLIND] * blind)
    assert found.blind.sum() == blind and not found.apart.any() and found.is_refused is is_refused


def test_one_look_has_nothing_to_fit(monkeypatch):
    found = fits(monkeypatch, HERE._replace(own_on=0.9, away_mm=9.0))
    assert not found.is_refused and not found.apart.any() and not found.blind.any()


def test_the_refusal_names_the_places():
    refusal = apart.refusal_of(np.array([[10.0, 0.4, -5.0], [1.0, 2.0, 3.0]]))
    assert refusal.status.value == "AMBIGUOUS" and "from (10, 0, -5) and (1, 2, 3) mm" in refusal.reason


def test_each_look_is_laid_on_the_bone_by_its_own_points_near_it():
    """Two views of an ellipsoid from above, of which the second is shifted by 3 mm: its own pose is there."""
    target = tiny.ellipsoid(count=900)
    points = tiny.on_ellipsoid(1500)
    points = points[points[:, 2] > 0.0]
    shift = np.array([3.0, 0.0, 0.0])
    first, second = points[::2], points[1::2] + shift
    views = [sources.prepare(each, CONFIG.source) for each in (first, second)]
    scene = looks.scene_from(views, EYES[[0, 0]] + [[0.0] * 3, [1.0, 0.0, 0.0]], CONFIG)
    close = np.ones(len(scene.look), dtype=bool)
    here, moved = (apart._own(np.eye(4), number, close, scene, target, CONFIG.clutter) for number in (0, 1))
    assert here.away_mm < 0.5 and moved.away_mm == pytest.approx(3.0, abs=0.5)
    assert moved.own_on > moved.on + 0.02 and here.compared > 0.1 and here.near >= here.on
    far = apart._own(np.eye(4), 1, ~close, scene, target, CONFIG.clutter)
    assert far.away_mm == 0.0 and far.own_on == far.on
    aside = replace(scene, look=np.where(scene.look == 1, 5, scene.look))
    gone = apart._own(np.eye(4), 1, close, aside, target, CONFIG.clutter)
    assert gone.away_mm == 0.0 and gone.own_on == gone.on
