"""Sources of 6 to 60 points: prepared without fuss; the uncertainty, not a limit, decides."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logit

from gapr_core import Registrar, RegistrarConfig, RegistrationStatus, Tracker
from gapr_core.config import SensorConfig, SourceConfig
from gapr_core.geometry import se3
from gapr_core.registration import few_points
from gapr_core.registration import source as sources
from gapr_core.results import Refusal


@pytest.mark.parametrize("count", [6, 12, 30, 60, 200])
def test_few_points_are_prepared(count):
    points = np.random.default_rng(count).normal(size=(count, 3)) * [30.0, 20.0, 10.0]
    prepared = sources.prepare(points)
    assert len(prepared.points) == count
    assert np.isfinite(prepared.axes(prepared.order)).all()
    assert np.linalg.norm(prepared.normals, axis=1) == pytest.approx(np.ones(count))
    assert sorted(prepared.order) == list(range(count))
    assert prepared.neighbours.shape[1] <= max(6, count // 4)


def test_a_dense_source_has_the_neighbours_of_the_settings():
    points = np.random.default_rng(0).normal(size=(1000, 3)) * 30.0
    assert sources.prepare(points).neighbours.shape[1] == SourceConfig().normal_neighbours


def test_fewer_points_than_a_pose_has_unknowns_are_too_few():
    refusal = sources.prepare(np.random.default_rng(0).normal(size=(5, 3)) * 30.0)
    assert isinstance(refusal, Refusal)
    assert refusal.status is RegistrationStatus.TOO_FEW_POINTS


@pytest.mark.parametrize("apart_mm", [1e-162, 1e-12, 1e-3])
def test_points_that_all_but_coincide_are_no_trouble(apart_mm):
    rng = np.random.default_rng(0)
    crowd = rng.normal(size=(40, 3)) * apart_mm
    crowd[:, 0] += apart_mm * np.arange(40)
    prepared = sources.prepare(np.concatenate([crowd, rng.normal(size=(20, 3)) * 30.0]))
    assert sorted(prepared.order) == list(range(len(prepared.points)))
    assert np.isfinite(prepared.flatness_mm).all()


def test_a_dozen_points_with_an_initial_pose_are_answered_or_refused_by_their_uncertainty(registrar, femur, target):
    points, normals = femur.sample(4000, np.random.default_rng(4))
    touched = points[normals @ [0.0, 1.0, 0.0] > 0.3][:14]
    initial = se3.exp([2.0, 1.0, -2.0, 0.02, 0.0, 0.03], touched.mean(axis=0))
    result = registrar.register(touched, target, initial)
    assert result.status is not RegistrationStatus.TOO_FEW_POINTS
    best = result.hypotheses[0].T_target_source
    assert best.shape == (4, 4)
    assert result.ok or result.reason


SURE = 0.97


@pytest.fixture
def dots(registrar, femur, target):
    """An assessment of a source of so many points with residuals of 0.4 mm in all, of which the model is sure."""
    points = femur.sample(400, np.random.default_rng(4))[0]
    made = registrar.assess(points, target)

    def of(count, probability=SURE, refusal=None, gross=0):
        signed, weights = np.full(count, 0.4), np.full(count, 0.7)
        weights[:gross], signed[:gross] = 0.0, 8.0
        signed *= np.sqrt((count - gross - 6) / (count - gross))
        fit = replace(made.fit, signed_mm=signed, weights=weights)
        source = sources.prepare(points[:count])
        return replace(made, fit=fit, source=source, probability=probability, refusal=refusal)

    return of


def with_noise(noise_mm, **settings):
    return RegistrarConfig(num_threads=1, sensor=SensorConfig(noise_mm=noise_mm), **settings)


def test_few_points_do_not_say_whose_bone_it_is(dots):
    few, config = dots(249), RegistrarConfig()
    found = few_points.limited(few, config)
    assert found.probability == 0.89 and found.refusal is None
    assert sum(found.contributions.values()) - sum(few.contributions.values()) == pytest.approx(
        logit(0.89) - logit(SURE)
    )
    assert few_points.limited(dots(250), config).probability == SURE


def test_what_is_no_surer_than_that_stays(dots):
    unsure = dots(60, probability=0.89)
    assert few_points.limited(unsure, RegistrarConfig()) is unsure
    assert np.isnan(few_points.limited(dots(60, probability=np.nan), RegistrarConfig()).probability)


def test_few_points_whose_noise_is_known_and_left_may_be_sure(dots):
    """0.4 mm, the pose's six unknowns counted, may be at most 1.3 times what is stated."""
    assert few_points.limited(dots(40), with_noise(0.4 / 1.29)).probability == SURE
    assert few_points.limited(dots(40), with_noise(0.4 / 1.31)).probability == 0.89
    assert few_points.limited(dots(6), with_noise(10.0)).probability == 0.89


def test_a_gross_point_in_ten_does_not_count_and_more_are_no_noise(dots):
    assert few_points.limited(dots(40, gross=4), with_noise(0.4 / 1.29)).probability == SURE
    assert few_points.limited(dots(40, gross=5), with_noise(0.4 / 1.29)).probability == 0.89


def test_who_asks_for_more_than_few_points_can_say_reads_what_helps(dots):
    found = few_points.limited(dots(40), RegistrarConfig(min_confidence=0.9))
    assert found.refusal.status is RegistrationStatus.LOW_CONFIDENCE
    for word in ("40 points", "another subject", "0.89", "0.9", "250", "noise_mm"):
        assert word in found.refusal.reason
    refused = Refusal(RegistrationStatus.DEGENERATE, "flat")
    assert few_points.limited(dots(40, refusal=refused), RegistrarConfig(min_confidence=0.9)).refusal is refused


def test_a_registrar_and_a_tracker_limit_what_few_points_say(registrar, femur, target):
    points = femur.sample(120, np.random.default_rng(4))[0]
    noisy = points + np.random.default_rng(5).normal(0.0, 0.2, points.shape)
    stated = Registrar(with_noise(0.2), registrar.proposers)
    tracker = Tracker(registrar)
    tracker.register(noisy, target)
    for found in (registrar.register(noisy, target), tracker.register(noisy, target)):
        assert found.ok and found.confidence == 0.89 and found.contributions["few_points"] < 0.0
    assert stated.register(noisy, target).confidence > 0.9
