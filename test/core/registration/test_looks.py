"""A wound that a camera sees from several places, registered as one."""

import numpy as np
import pytest

from gapr_core import LookAccumulator, LookFit, Registrar, RegistrarConfig, RegistrationStatus, Tracker, metrics
from gapr_core.config import ClutterConfig
from gapr_core.data import pool, protocols
from gapr_core.errors import InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.registration.scenes import look_agreement

SUBJECT, SEED = 0, 5
MOTION = [4.0, -3.0, 3.0, 0.02, 0.03, -0.02]  # 6 mm and 2.4 deg


@pytest.fixture(scope="module")
def specimen():
    return pool.parametric_specimen("femur", SUBJECT)


@pytest.fixture(scope="module")
def pair(specimen):
    return protocols.make_pair("scene-C3-looks", specimen, SEED)


@pytest.fixture(scope="module")
def registrar():
    """Half of the regions propose: enough for a scene as easy as this one."""
    return Registrar(RegistrarConfig(num_threads=1, clutter=ClutterConfig(seeds=(6, 3))))


@pytest.fixture(scope="module")
def target(registrar, pair):
    return registrar.prepare(pair.target)


@pytest.fixture(scope="module")
def moved(pair):
    """The points and places of the looks, between the first two and the last two of which the bone moved."""
    T = se3.exp(MOTION, pair.source.mean(axis=0))
    late = (pair.metadata["look"] >= 2)[:, None]
    source, viewpoint = pair.source, pair.viewpoint
    return np.where(late, se3.apply(T, source), source), np.where(late, se3.apply(T, viewpoint), viewpoint)


def of_look(pair, number, points=None):
    return (pair.source if points is None else points)[pair.metadata["look"] == number]


def is_right(T, pair):
    return metrics.pose_error(T, pair.T_target_source, pair.source).is_right


@pytest.fixture(scope="module")
def result(registrar, pair, target):
    return registrar.register(pair.source, target, viewpoint=pair.viewpoint)


def test_the_looks_together_give_a_pose(result, pair):
    assert result.ok and result.confidence > 0.8 and is_right(result.T_target_source, pair)
    assert [look.fit for look in result.looks] == [LookFit.FITS] * 4


def test_the_order_of_the_points_says_nothing(registrar, pair, target, result):
    order = np.random.default_rng(0).permutation(len(pair.source))
    again = registrar.register(pair.source[order], target, viewpoint=pair.viewpoint[order])
    assert again.ok and again.confidence == pytest.approx(result.confidence, abs=0.1)
    assert se3.rms_apart_mm(again.T_target_source, result.T_target_source, pair.source) < 1.0


def test_looks_between_which_the_bone_moved_are_refused_by_this_rule_alone(registrar, moved, target, monkeypatch):
    result = registrar.register(moved[0], target, viewpoint=moved[1])
    assert result.status is RegistrationStatus.AMBIGUOUS and "show the bone elsewhere" in result.reason
    fits = [look.fit for look in result.looks]
    assert 1 <= fits.count(LookFit.APART) <= 3
    assert np.array_equal([look.viewpoint for look in result.looks], np.unique(moved[1], axis=0))
    monkeypatch.setattr(look_agreement, "look_fits", lambda *_: [LookFit.FITS] * 4)
    assert registrar.register(moved[0], target, viewpoint=moved[1]).ok


@pytest.mark.parametrize("tracked", [False, True])
def test_an_accumulator_of_looks_finds_the_bone_where_it_moved_to(registrar, pair, moved, target, tracked):
    looks = LookAccumulator(Tracker(registrar) if tracked else registrar)
    points, places = moved
    first = [looks.register(of_look(pair, n, points), target, viewpoint=of_look(pair, n, places)[0]) for n in (0, 1)]
    assert first[-1].ok and is_right(first[-1].T_target_source, pair)
    later = [looks.register(of_look(pair, n, points), target, viewpoint=of_look(pair, n, places)[0]) for n in (2, 3, 2)]
    assert not any(each.ok for each in later) and "restarts with them" in later[-1].reason
    last = looks.register(of_look(pair, 3, points), target, viewpoint=of_look(pair, 3, places)[0])
    back = se3.inverse(se3.exp(MOTION, pair.source.mean(axis=0)))
    assert last.ok and is_right(last.T_target_source @ se3.inverse(back), pair)


def test_a_look_of_too_few_points_is_named_and_as_the_newest_refused(registrar, pair, target):
    few = pair.source[:7] + 1.0
    places = np.vstack([pair.viewpoint, np.tile([[0.0, 0.0, 900.0]], (7, 1))])
    result = registrar.register(np.vstack([pair.source, few]), target, viewpoint=places)
    assert result.ok and {look.viewpoint[2] for look in result.looks if look.fit is LookFit.TOO_SMALL} == {900.0}
    looks = LookAccumulator(registrar)
    for number in (0, 1):
        looks.register(of_look(pair, number), target, viewpoint=of_look(pair, number, pair.viewpoint)[0])
    result = looks.register(few, target, viewpoint=pair.viewpoint[pair.metadata["look"] == 2][0])
    assert result.status is RegistrationStatus.TOO_FEW_POINTS and "too few points for an image" in result.reason
    assert len(looks.collected) == len(of_look(pair, 0)) + len(of_look(pair, 1))


def test_a_viewpoint_for_each_point_has_as_many_rows(registrar, pair, target):
    with pytest.raises(InvalidPointCloudError, match=r"viewpoint"):
        registrar.register(pair.source, target, viewpoint=pair.viewpoint[:-1])


def test_one_look_alone_is_what_its_place_alone_says(registrar, pair, target):
    source, places = of_look(pair, 0), of_look(pair, 0, pair.viewpoint)
    of_points, of_all = (registrar.register(source, target, viewpoint=v) for v in (places, places[0]))
    assert of_points.status == of_all.status and of_points.confidence == of_all.confidence
