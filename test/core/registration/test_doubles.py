"""A source with the bone in it twice: the robust fit is sure of one copy, what it rejects is the other one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core import Registrar, Tracker
from gapr_core.geometry import se3
from gapr_core.registration.checks import second_copy as doubles
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.limits import applied
from gapr_core.results import RegistrationStatus

STEP = np.array([5.0, -2.0, 4.0, 0.02, 0.03, -0.02])


@pytest.fixture(scope="module")
def seen(femur):
    """(N, 3) one side of the femur's lower part with 0.3 mm of noise, mm."""
    rng = np.random.default_rng(3)
    points, normals = femur.sample(9000, rng)
    low = points[(normals[:, 1] < -0.2) & (points[:, 2] < np.quantile(points[:, 2], 0.4))]
    return low + rng.normal(0.0, 0.3, low.shape)


@pytest.fixture(scope="module")
def twice(seen):
    """The same after a step of a third of its points."""
    moved = np.random.default_rng(4).random(len(seen)) < 0.33
    points = seen.copy()
    points[moved] = se3.apply(se3.exp(STEP, seen.mean(axis=0)), seen[moved])
    return points


def assessed(registrar, points, target, **settings):
    rigidity = replace(registrar.config.rigidity, **settings)
    config = replace(registrar.config, rigidity=rigidity)
    found = Registrar(config, registrar.proposers, registrar.calibrations).assess(points, target)
    assert isinstance(found, Assessment)
    return found, applied(found, config)


def test_of_two_copies_none_is_believed_and_the_bound_reaches_from_one_to_the_other(registrar, seen, twice, target):
    found, _ = assessed(registrar, twice, target)
    step = se3.exp(STEP, seen.mean(axis=0))
    step_mm = se3.rms_apart_mm(step, np.eye(4), seen)
    assert found.deformed[doubles.NAME] == pytest.approx(step_mm, rel=0.15)
    assert next(iter(found.deformed)) == doubles.NAME
    assert (
        found.refusal.status is RegistrationStatus.AMBIGUOUS and found.probability == registrar.config.rules.ruled_out
    )
    shift_mm, turn_deg = se3.pose_error(step, np.eye(4), seen)
    assert f"in another pose, {shift_mm:.0f} mm and {turn_deg:.0f} deg away" in found.refusal.reason
    other = se3.exp(-STEP, seen.mean(axis=0))  # where the bone is by the fewer points
    assert found.tre95_mm > se3.rms_apart_mm(other, np.eye(4), target.points)


def test_only_this_rule_refuses_two_copies(registrar, seen, twice, target):
    found, limited = assessed(registrar, twice, target, doubled=2.0, strained=np.inf, apart=np.inf, layered=np.inf)
    assert doubles.NAME not in found.deformed and found.refusal is None and limited.probability > 0.9
    assert found.tre95_mm < 2.0
    assert se3.pose_error(found.fit.T, np.eye(4), seen).is_right, "the copy of most points"


@pytest.mark.parametrize(("on_bone", "is_copy"), [(0.59, False), (0.61, True)])
def test_of_the_rejected_points_most_lie_on_the_bone_in_a_copy(registrar, twice, target, on_bone, is_copy):
    alone, _ = assessed(registrar, twice, target, doubled=2.0)

    def register(source, poses):
        weights = (np.arange(len(source.points)) < on_bone * len(source.points)).astype(float)
        on_some = replace(alone.fit, T=poses[0], weights=weights, whole=None)
        return replace(alone, fit=on_some, source=source, probability=0.9)

    found = doubles.allowing_for_a_copy(alone, registrar.config, register)
    assert (doubles.NAME in found.deformed) is (found.refusal is not None) is is_copy


def test_outliers_tissue_and_few_rejected_points_are_no_copy(registrar, seen, target):
    rng = np.random.default_rng(5)
    some = rng.random(len(seen)) < 0.25
    outliers, tissue = seen.copy(), seen.copy()
    outliers[some] += rng.uniform(-15.0, 15.0, (some.sum(), 3))
    tissue[some] += [0.0, -1.0, 0.0] * rng.uniform(3.0, 12.0, (some.sum(), 1)) + rng.normal(0.0, 1.5, (some.sum(), 3))
    for points in (seen, outliers, tissue):
        assert doubles.NAME not in assessed(registrar, points, target)[0].deformed


def test_fewer_points_than_are_asked_for_say_nothing(registrar, twice, target):
    found, _ = assessed(registrar, twice, target)
    rests = found.fit.rests_on
    rejected = int((rests.weights == 0.0).sum())
    assert rejected > 30
    assert doubles.NAME in assessed(registrar, twice, target, rejected_points=rejected)[0].deformed
    assert doubles.NAME not in assessed(registrar, twice, target, rejected_points=rejected + 1)[0].deformed


def test_a_heap_of_points_and_a_line_are_no_source_and_no_error(registrar):
    heap, line = np.random.default_rng(0).normal(0.0, 0.05, (70, 3)), np.arange(70.0)[:, None] * [1.0, 0.0, 0.0]
    for points in (heap, line):
        assert doubles._registered(points, np.eye(4)[None], registrar.config, pytest.fail) is None


def test_copies_that_are_right_for_each_other_cost_no_more_than_the_limit(registrar, seen, target):
    points = seen.copy()
    moved = np.random.default_rng(4).random(len(seen)) < 0.33
    points[moved] += [2.3, -1.3, 2.3]
    found, limited = assessed(registrar, points, target)
    assert 2.0 < found.deformed[doubles.NAME] < 4.0 and found.refusal is None
    assert found.probability > 0.9 and limited.probability == registrar.config.limits.most
    assert doubles.NAME in limited.contributions


def test_where_much_is_rejected_a_copy_may_lie_anywhere(registrar, seen, target):
    moved = np.random.default_rng(4).random(len(seen)) < 0.4
    points = seen.copy()
    far = se3.exp(np.array([35.0, -20.0, 10.0, 0.3, -0.2, 0.1]), seen.mean(axis=0))
    points[moved] = se3.apply(far, seen[moved])
    found, _ = assessed(registrar, points, target)
    assert found.refusal.status is RegistrationStatus.AMBIGUOUS and found.deformed[doubles.NAME] > 30.0
    assert found.tre95_mm > se3.rms_apart_mm(far, np.eye(4), target.points) / 2.0
    alone, _ = assessed(registrar, points, target, doubled_share=0.5)
    assert doubles.NAME not in alone.deformed and alone.refusal is None, "nothing else knows it"
    assert alone.probability > 0.9
    asked = []
    for a in (alone, replace(alone, seen=alone.source)):
        assert doubles.allowing_for_a_copy(a, registrar.config, lambda *_: asked.append(1)) is a
    assert len(asked) == 1, "and not in a camera's cloud, whose rejected points are tissue"


def test_no_stream_makes_such_an_answer_believed(registrar, seen, twice, target):
    tracker = Tracker(registrar)
    rng = np.random.default_rng(6)
    clouds = [seen, seen, *[twice] * 3]
    answers = [tracker.register(points + rng.normal(0.0, 0.1, points.shape), target) for points in clouds]
    assert [str(result.status) for result in answers] == ["OK", "OK", *["AMBIGUOUS"] * 3]


def test_two_copies_in_a_camera_s_cloud_are_not_believed_either(registrar, seen, twice, target):
    viewpoint = seen.mean(axis=0) - [0.0, 420.0, 0.0]
    answers = [registrar.register(points, target, viewpoint=viewpoint) for points in (seen, twice)]
    assert doubles.NAME not in answers[0].contributions and answers[0].confidence > 0.9
    assert not answers[1].ok and "in another pose" in answers[1].reason


def test_the_way_to_a_copy_of_the_source_is_added_to_the_covariance_in_full(registrar, seen, twice, target):
    alone, _ = assessed(registrar, twice, target, doubled=2.0)
    way = se3.exp(STEP, seen.mean(axis=0))
    rejected = replace(alone.source, points=alone.source.points[:50] + 30.0)
    copy = replace(alone, fit=replace(alone.fit, T=way @ alone.fit.T), source=rejected)
    added = doubles._with_copy(alone, copy, 0.6).uncertainty.covariance - alone.uncertainty.covariance
    middle = alone.centre_mm
    twist = np.r_[se3.apply(way, middle[None])[0] - middle, Rotation.from_matrix(way[:3, :3]).as_rotvec()]
    np.testing.assert_allclose(added, np.outer(twist, twist), atol=1e-9)


@pytest.mark.parametrize(("probability", "is_refused"), [(0.79, False), (0.8, True)])
def test_a_doubtful_copy_leaves_the_answer_its_share_of_the_points_of_both(
    registrar, twice, target, probability, is_refused
):
    alone, _ = assessed(registrar, twice, target, doubled=2.0)
    rejected = (~alone.residuals.inlier).sum()

    def register(source, poses):
        fit = replace(alone.fit, T=poses[0], weights=np.ones(len(source.points)), whole=None)
        return replace(alone, fit=fit, source=source, probability=probability)

    found = doubles.allowing_for_a_copy(alone, registrar.config, register)
    share = 1.0 - rejected / len(twice)
    assert (found.refusal is not None) is is_refused and found.most == pytest.approx(share)
    assert found.probability == (registrar.config.rules.ruled_out if is_refused else pytest.approx(share))


@pytest.mark.parametrize(("before", "after"), [(1.0, 0.6), (0.5, 0.5)])
def test_a_copy_makes_no_answer_surer_than_it_may_be(registrar, twice, target, before, after):
    alone, _ = assessed(registrar, twice, target, doubled=2.0)
    assert doubles._with_copy(replace(alone, most=before), alone, 0.6).most == after


def test_an_answer_that_is_less_probable_than_its_share_stays_so_in_a_stream(registrar, twice, target):
    alone, _ = assessed(registrar, twice, target, doubled=2.0)
    found = doubles._with_copy(replace(alone, probability=0.55), alone, 0.6)
    assert (found.probability, found.most) == (0.55, 0.6) and doubles.NAME not in found.contributions


@pytest.mark.parametrize(("away_mm", "is_copy"), [(0.0, False), (30.0, True)])
def test_a_copy_that_was_looked_for_anywhere_changes_nothing_where_it_lies_as_the_answer_does(
    registrar, twice, target, monkeypatch, away_mm, is_copy
):
    alone, _ = assessed(registrar, twice, target, doubled=2.0)
    monkeypatch.setattr(doubles, "_elsewhere", lambda *_: None)
    T = se3.exp([away_mm, 0.0, 0.0, 0.0, 0.0, 0.0]) @ alone.fit.T

    def register(source, poses):
        fit = replace(alone.fit, T=T, weights=np.ones(len(source.points)), whole=None)
        return replace(alone, fit=fit, source=source, probability=0.9)

    found = doubles.allowing_for_a_copy(alone, registrar.config, register)
    assert (found is not alone) is (doubles.NAME in found.deformed) is is_copy
