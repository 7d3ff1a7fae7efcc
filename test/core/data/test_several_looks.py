"""Wounds that a tracked camera sees from several places."""

from dataclasses import replace

import numpy as np
import pytest
from shapes import ball_specimen

from gapr_core import InvalidPointCloudError
from gapr_core.data import pair_files, pool, protocols
from gapr_core.data.scenes import several_looks
from gapr_core.data.scenes.camera import View
from gapr_core.data.scenes.errors import under_layers
from gapr_core.data.scenes.several_looks import LOOKED_AT, LOOKS, LookedAt
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3

NO_ERROR = LookedAt((0.10, 0.30), errors=lambda view, rng: view)


@pytest.fixture(scope="module")
def specimen():
    return pool.parametric_specimen("femur", 0)


@pytest.fixture(scope="module")
def pair(specimen):
    return protocols.make_pair("scene-stereo-looks", specimen, 1)


@pytest.fixture(scope="module")
def exact(specimen):
    """Without errors of the camera; only its tracker errs."""
    return several_looks.several_looks(specimen, np.random.default_rng(3), (), kind=NO_ERROR)


def bone_mm(pair, specimen, number):
    """(n,) distance of the bone's points of a look to the bone, mm."""
    of_look = (pair.metadata["look"] == number) & pair.metadata["is_bone"]
    T = pair.T_target_source
    return specimen.distance(se3.apply(T, pair.source[of_look]) + pair.metadata["origin_mm"])


def test_each_point_knows_its_look_and_where_that_was(pair):
    look, places = pair.metadata["look"], pair.viewpoint
    assert places.shape == pair.source.shape and np.unique(look).tolist() == list(range(LOOKS))
    assert len(np.unique(places, axis=0)) == LOOKS
    away = [np.linalg.norm(pair.source[look == k].mean(axis=0) - places[look == k][0]) for k in range(LOOKS)]
    assert all(250.0 < mm < 650.0 for mm in away)


def test_later_looks_come_from_around_the_axis_of_the_wound(pair):
    T = pair.T_target_source
    centre = pair.metadata["wound_centre"] - pair.metadata["origin_mm"]
    axis, places = pair.metadata["wound_axis"], se3.apply(T, np.unique(pair.viewpoint, axis=0)) - centre
    off = np.degrees(np.arccos(places @ axis / np.linalg.norm(places, axis=1)))
    assert (off < 36.0).all() and (off > 14.0).sum() >= LOOKS - 1


def test_the_first_look_lies_on_the_bone_and_the_others_but_for_the_tracker(exact, specimen):
    medians = [float(np.median(bone_mm(exact, specimen, k))) for k in range(LOOKS)]
    assert medians[0] < 0.02 and all(0.02 < mm < 1.5 for mm in medians[1:])


def test_all_looks_show_one_region(exact):
    centre = se3.apply(
        se3.inverse(exact.T_target_source), (exact.metadata["wound_centre"] - exact.metadata["origin_mm"])[None]
    )
    away = np.linalg.norm(exact.source - centre, axis=1)
    of_first = away[exact.metadata["look"] == 0].max()
    assert away.max() < of_first + 3.0 and 0.10 <= exact.metadata["is_bone"][exact.metadata["look"] == 0].mean() <= 0.30


def test_layers_are_the_same_in_all_looks():
    """Two cameras see the same points: each is raised towards its camera by as much."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-30.0, 30.0, (400, 2)), np.zeros(400)])
    views = [View(points, np.zeros(400, dtype=np.int64), np.array([x, 0.0, 400.0])) for x in (-100.0, 100.0)]
    first, second = under_layers(views, np.random.default_rng(1))
    raised = [np.linalg.norm(view.points - points, axis=1) for view in (first, second)]
    assert raised[0].max() > 0.5
    apart = np.abs(raised[0] - raised[1])
    assert np.median(apart) < 1e-9 and apart.max() < 1e-9


def test_a_range_that_is_wrong_moves_a_look_along_its_sight(specimen):
    view = View(np.array([[0.0, 0.0, 100.0]]), np.zeros(1, dtype=np.int64), np.array([0.0, 0.0, 500.0]))
    assert several_looks._of_range(view, 1.01).points == pytest.approx(np.array([[0.0, 0.0, 96.0]]))


def test_the_range_is_wrong_by_one_factor_in_all_looks(specimen, monkeypatch):
    factors = []
    monkeypatch.setattr(several_looks, "_of_range", lambda view, factor: factors.append(factor) or view)
    several_looks.several_looks(specimen, np.random.default_rng(3), (), kind=replace(NO_ERROR, range_wrong=0.01))
    assert len(factors) == LOOKS and len(set(factors)) == 1 and factors[0] != 1.0


def test_one_look_is_the_first_of_the_same_wound(pair, specimen):
    one = protocols.make_pair("scene-stereo-look", specimen, 1)
    first = pair.metadata["look"] == 0
    assert np.array_equal(one.source, pair.source[first]) and one.viewpoint.tolist() == pair.viewpoint[0].tolist()
    assert one.metadata["bone_share"] == pytest.approx(pair.metadata["is_bone"][first].mean())


@pytest.mark.parametrize("name", sorted(LOOKED_AT))
def test_what_is_seen_of_a_scene_is_seen_of_its_looks(name, specimen):
    if name in ("scene-joint", "scene-theatre"):
        with pytest.raises(ConfigError, match="another bone"):
            protocols.make_pair(f"{name}-looks", specimen, 0)
    else:
        low, high = LOOKED_AT[name].bone_share
        assert low <= protocols.make_pair(f"{name}-look", specimen, 0).metadata["bone_share"] <= high


@pytest.mark.parametrize("name", ["scene-joint-looks", "scene-theatre-looks"])
def test_looks_at_a_joint_show_the_next_bone_of_the_same_subject_too(name):
    """Two balls 10 mm apart, as two bones of one scan."""
    bone, other = ball_specimen(40.0), ball_specimen(30.0, bone="other")
    other = replace(other, surface=replace(other.surface, points=other.surface.points + [80.0, 0.0, 0.0]))
    pair = protocols.make_pair(name, bone, 1, [other])
    is_bone, look = pair.metadata["is_bone"], pair.metadata["look"]
    assert pair.metadata["neighbour"] == "other" and len(np.unique(look)) == LOOKS
    low, high = LOOKED_AT[name.removesuffix("-looks")].bone_share
    assert low <= is_bone[look == 0].mean() <= high
    in_bone_frame = pair.T_target_source.copy()
    in_bone_frame[:3, 3] += pair.metadata["origin_mm"]
    away = np.linalg.norm(se3.apply(in_bone_frame, pair.source) - bone.surface.points.mean(axis=0), axis=1)
    assert np.median(np.abs(away[is_bone] - 40.0)) < 10.0  # but for layers on it, and a range that is wrong


def test_a_file_keeps_the_place_of_each_point(pair, tmp_path):
    pair_files.save_pair(tmp_path / "pair.npz", pair)
    source, _, places = pair_files.load_clouds(tmp_path / "pair.npz")
    assert places == pytest.approx(pair.viewpoint, abs=1e-3) and len(places) == len(source)
    assert pair_files.load_pair(tmp_path / "pair.npz").viewpoint == pytest.approx(pair.viewpoint, abs=1e-3)
    assert pair_files.load_facts(tmp_path / "pair.npz").viewpoint.shape == pair.viewpoint.shape


def test_a_file_with_other_places_than_points_is_refused(pair, tmp_path):
    np.savez(tmp_path / "pair.npz", source=pair.source, target=pair.target, viewpoint=pair.viewpoint[:-1])
    with pytest.raises(InvalidPointCloudError, match="viewpoint"):
        pair_files.load_clouds(tmp_path / "pair.npz")


def test_a_look_that_shows_hardly_anything_is_taken_from_elsewhere(specimen, monkeypatch):
    seen, asked = several_looks._seen_from, []

    def hidden_at_first(setting, around, radius, rng):
        view = seen(setting, around, radius, rng)
        asked.append(around)
        return view.of(np.arange(several_looks.FEWEST_POINTS - (len(asked) < 3)))

    monkeypatch.setattr(several_looks, "_seen_from", hidden_at_first)
    pair = several_looks.several_looks(specimen, np.random.default_rng(3), (), kind=NO_ERROR)
    assert len(asked) == LOOKS + 1 and len(set(asked)) == LOOKS + 1
    assert (np.bincount(pair.metadata["look"])[1:] == several_looks.FEWEST_POINTS).all()
    monkeypatch.setattr(several_looks, "_seen_from", lambda setting, *_: View(np.empty((0, 3)), np.empty(0), None))
    with pytest.raises(ConfigError, match="hidden from all"):
        several_looks.several_looks(specimen, np.random.default_rng(3), (), kind=NO_ERROR)


def test_a_tracker_errs_about_the_camera_and_takes_it_along(monkeypatch):
    view = View(np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]), np.zeros(2, dtype=np.int64), np.array([0.0, 0.0, 500.0]))
    monkeypatch.setattr(several_looks, "TRACKED_MM", 0.0)
    turned = several_looks._tracked(view, np.random.default_rng(1))
    assert turned.camera == pytest.approx(view.camera) and 0.1 < np.linalg.norm(turned.points[0]) < 3.0
    assert np.linalg.norm(turned.points - turned.camera, axis=1) == pytest.approx(
        np.linalg.norm(view.points - view.camera, axis=1)
    )
    monkeypatch.setattr(several_looks, "TRACKED_MM", 0.3)
    monkeypatch.setattr(several_looks, "TRACKED_DEG", 0.0)
    shifted = several_looks._tracked(view, np.random.default_rng(1))
    step = shifted.camera - view.camera
    assert 0.05 < np.linalg.norm(step) < 1.5 and shifted.points == pytest.approx(view.points + step)


def test_all_looks_lie_under_the_same_layers(specimen, monkeypatch):
    asked = []
    monkeypatch.setattr(several_looks, "under_layers", lambda views, rng: asked.append(len(views)) or views)
    several_looks.several_looks(specimen, np.random.default_rng(3), (), kind=replace(NO_ERROR, under_layers=True))
    assert asked == [LOOKS]
