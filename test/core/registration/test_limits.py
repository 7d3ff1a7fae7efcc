"""What no pose can be sure of: each limit alone, and what lifts it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import logit
from scipy.stats import chi2

from gapr_core import Registrar, RegistrarConfig, RegistrationStatus, Tracker
from gapr_core.config import LimitsConfig, SensorConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks import limits
from gapr_core.results import Refusal, RegistrationResult

SURE = 0.97
TIGHT = np.diag([0.01] * 3 + [np.radians(0.1) ** 2] * 3)


@pytest.fixture
def made(registrar, femur, target):
    """An answer of which the model is sure: so many points this far apart, residuals of 0.4 mm in all."""
    patch = femur.sample(400, np.random.default_rng(4))[0]
    answer = registrar.assess(patch, target)

    def of(count=1000, spacing_mm=1.0, gross=0, covariance=TIGHT, **more):
        side = int(np.ceil(np.sqrt(count)))
        feet = spacing_mm * np.column_stack([*np.indices((side, side)).reshape(2, -1), np.zeros(side * side)])[:count]
        signed, weights = np.full(count, 0.4), np.full(count, 0.7)
        weights[:gross], signed[:gross] = 0.0, 8.0
        signed *= np.sqrt((count - gross - 6) / (count - gross))
        up = np.tile([0.0, 0.0, 1.0], (count, 1))
        fit = replace(answer.fit, signed_mm=signed, weights=weights, gradients=up, moved=feet + signed[:, None] * up)
        uncertainty = replace(answer.uncertainty, covariance=covariance)
        source = SimpleNamespace(points=feet)
        given = {"fit": fit, "source": source, "uncertainty": uncertainty, "probability": SURE, "refusal": None}
        return replace(answer, **given | more)

    return of


def named(**sensor):
    return RegistrarConfig(num_threads=1, sensor=SensorConfig(**sensor))


def test_a_dense_source_of_a_pose_that_is_well_known_may_be_sure(made):
    for config in (RegistrarConfig(), named(kind="laser"), named(kind="pointer")):
        answer = made()
        assert limits.applied(answer, config) is answer


def test_few_points_do_not_say_whose_bone_it_is(made):
    few = made(249)
    found = limits.applied(few, RegistrarConfig())
    assert found.probability == 0.89 and found.refusal is None and list(found.contributions)[-1] == "sparse"
    assert sum(found.contributions.values()) - sum(few.contributions.values()) == pytest.approx(
        logit(0.89) - logit(SURE)
    )
    assert limits.applied(made(250), RegistrarConfig()).probability == SURE


def test_nor_do_points_without_neighbours(made):
    assert limits.with_neighbours(made(1000, spacing_mm=6.1)) == 0
    assert limits.with_neighbours(made(16, spacing_mm=5.9)) == 16
    assert limits.with_neighbours(made(16, spacing_mm=5.9, gross=8)) == 8  # points that count
    assert limits.with_neighbours(made(5000, spacing_mm=5.9)) == 5000
    assert limits.applied(made(1000, spacing_mm=6.1), RegistrarConfig()).probability == 0.89
    assert limits.applied(made(1000, spacing_mm=5.9), RegistrarConfig()).probability == SURE


def test_a_contact_that_a_pointer_sends_again_and_again_is_one_point(made):
    """40 places 5.5 mm apart, 20 times each within a tenth of a millimetre: no more than 40 say whose bone it is."""
    answer, rng = made(40, spacing_mm=5.5), np.random.default_rng(2)
    fit = answer.fit
    again = np.repeat(np.arange(40), 20)
    jitter = rng.uniform(-0.05, 0.05, (800, 3))
    many = replace(fit, signed_mm=fit.signed_mm[again], weights=fit.weights[again], gradients=fit.gradients[again],
                   moved=fit.moved[again] + jitter)  # fmt: skip
    held_still = replace(answer, fit=many, source=SimpleNamespace(points=many.feet))
    assert 40 <= limits.with_neighbours(held_still) < 250
    assert limits.applied(held_still, RegistrarConfig()).probability == 0.89


def test_a_camera_that_nobody_named_may_have_been_elsewhere(made):
    found = limits.applied(made(inferred_viewpoint=np.zeros(3)), RegistrarConfig())
    assert found.probability == 0.89 and found.refusal is None and list(found.contributions)[-1] == "inferred"
    asked = limits.applied(made(inferred_viewpoint=np.zeros(3)), RegistrarConfig(min_confidence=0.9))
    assert asked.refusal.status is RegistrationStatus.LOW_CONFIDENCE and "(viewpoint)" in asked.refusal.reason


@pytest.mark.parametrize(("standoff_mm", "probability"), [(3.4, SURE), (3.6, 0.89), (-3.6, 0.89), (None, SURE)])
def test_a_standoff_that_is_larger_than_a_pose_may_be_off_cannot_be_sure(made, standoff_mm, probability):
    found = limits.applied(made(), named(standoff_mm=standoff_mm))
    assert found.probability == probability
    assert (list(found.contributions)[-1:] == ["far_out"]) is (probability < SURE)


def test_what_is_no_surer_than_that_stays(made):
    unsure = made(60, probability=0.89)
    assert limits.applied(unsure, RegistrarConfig()) is unsure
    assert np.isnan(limits.applied(made(60, probability=np.nan), RegistrarConfig()).probability)
    assert limits.applied(made(60), RegistrarConfig(limits=LimitsConfig(most=1.0))).probability == SURE


def test_few_points_whose_noise_is_known_and_left_may_be_sure(made):
    """0.4 mm, the pose's six unknowns counted, may be 0.6 to 1.3 times what is stated."""
    for times, probability in ((1.29, SURE), (1.31, 0.89), (0.61, SURE), (0.59, 0.89)):
        found = limits.applied(made(40), named(noise_mm=0.4 / times))
        assert found.probability == probability
    assert list(found.contributions)[-1] == "sparse"
    assert limits.applied(made(7, gross=1), named(noise_mm=1.0)).probability == 0.89  # none left to be measured


def test_a_gross_point_in_ten_does_not_count_and_more_are_no_noise(made):
    assert limits.applied(made(40, gross=4), named(noise_mm=0.4 / 1.29)).probability == SURE
    assert limits.applied(made(40, gross=5), named(noise_mm=0.4 / 1.29)).probability == 0.89


@pytest.mark.parametrize("sensor", [{"kind": "laser"}, {"noise_mm": 0.15}])
def test_residuals_far_beyond_the_noise_of_a_sensor_may_be_of_another_bone(made, sensor):
    """At most 2.5 times the root of 0.15^2 (a laser) and 0.3^2 (a model of a bone)."""
    most = 2.5 * np.hypot(0.15, 0.3) / 0.4
    for times, probability in ((0.99 * most, SURE), (1.01 * most, 0.89)):
        answer = made()
        larger = replace(answer, fit=replace(answer.fit, signed_mm=times * answer.fit.signed_mm))
        found = limits.applied(larger, named(**sensor))
        assert found.probability == probability
        assert limits.applied(larger, RegistrarConfig()).probability == SURE  # of a sensor that nobody named
    assert list(found.contributions)[-1] == "beyond_noise"


@pytest.mark.parametrize(
    ("sensor", "squares"),
    [
        ({"kind": "laser"}, 0.15**2 + 0.075**2),
        ({"kind": "laser", "noise_mm": 0.4}, 0.15**2 + 0.2**2),
        ({"bias_mm": 0.3}, 0.3**2 + 0.25**2),
        ({"kind": "ultrasound"}, 0.2**2 + 0.3**2 + 0.25**2),
    ],
)
def test_what_near_points_share_beyond_a_sensor_may_be_of_another_bone(made, sensor, squares):
    """At most 1.25 times the root of the squares of smooth and local error, half the noise and 0.1 (a model)."""
    most = 1.25 * np.sqrt(squares + 0.1**2)

    def sharing(smooth_mm, count=1000):
        answer = made(count)
        return replace(answer, uncertainty=replace(answer.uncertainty, smooth_mm=smooth_mm))

    for times, probability in ((0.99, SURE), (1.01, 0.89)):
        found = limits.applied(sharing(times * most), named(**sensor))
        assert found.probability == probability
        assert limits.applied(sharing(times * most), RegistrarConfig()).probability == SURE  # nobody named a sensor
    assert list(found.contributions)[-1] == "beyond_bias"
    for count, holds in ((30, False), (31, True)):  # no more than one average is of
        assert limits.is_beyond_bias(sharing(1.01 * most, count), named(**sensor)) is holds


@pytest.mark.parametrize(("rough_mm", "in_scene", "probability"), [(0.19, True, SURE), (0.21, True, 0.89),
                                                                   (0.21, False, SURE)])  # fmt: skip
def test_near_points_of_a_scene_that_err_alike_may_be_of_another_bone(made, rough_mm, in_scene, probability):
    """At most 0.4 times the scale of the residuals, 0.5 mm."""
    answer = made()
    features = dict(answer.features) | {"rough_misfit": rough_mm, "log_sigma": np.log(0.5)}
    answer = replace(answer, features=features, seen=answer.source if in_scene else None)
    found = limits.applied(answer, RegistrarConfig())
    assert found.probability == probability
    assert (list(found.contributions)[-1] == "rough") is (probability < SURE)


def test_no_pose_is_surer_than_its_covariance(made):
    loose = made(covariance=np.diag([2.0**2] * 3 + [1e-6] * 3))
    assert list(limits.applied(loose, RegistrarConfig()).contributions)[-1] == "uncertain"
    assert limits.applied(loose, RegistrarConfig()).probability == 0.89
    alone = RegistrarConfig(limits=LimitsConfig(loose_mm=1000.0))
    assert limits.applied(made(covariance=np.diag([1.5**2] * 3 + [1e-6] * 3)), alone).probability == SURE


def test_a_pose_that_leaves_the_bone_loose_may_be_of_another_bone(made):
    """Of a small noisy patch: it is right within 4 mm and 5 deg there, and millimetres off elsewhere."""
    turned = made(covariance=np.diag([1e-4] * 3 + [np.radians(0.6) ** 2] * 3))
    assert limits.right_share(turned.uncertainty.covariance) > 0.99 and turned.tre95_mm > 5.0
    found = limits.applied(turned, RegistrarConfig())
    assert found.probability == 0.89 and list(found.contributions)[-1] == "loose"
    for loose_mm, probability in ((1.01 * turned.tre95_mm, SURE), (0.99 * turned.tre95_mm, 0.89)):
        config = RegistrarConfig(limits=LimitsConfig(loose_mm=loose_mm))
        assert limits.applied(turned, config).probability == probability


def test_the_share_of_a_covariance_that_is_right_is_that_of_its_normal_distribution():
    shifts = np.diag([2.0**2] * 3 + [1e-9] * 3)
    assert limits.right_share(shifts) == pytest.approx(chi2.cdf((4.0 / 2.0) ** 2, 3), abs=0.02)
    turns = np.diag([1e-9] * 3 + [np.radians(3.0) ** 2] * 3)
    assert limits.right_share(turns) == pytest.approx(chi2.cdf((5.0 / 3.0) ** 2, 3), abs=0.02)
    one_way = np.outer([1.0, 1.0, 0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0, 0.0, 0.0]) * 4.0
    assert limits.right_share(one_way) == pytest.approx(chi2.cdf(4.0**2 / 8.0, 1), abs=0.02)
    assert limits.right_share(shifts + turns) == pytest.approx(chi2.cdf(4.0, 3) * chi2.cdf(25.0 / 9.0, 3), abs=0.02)


def test_who_asks_for_more_than_a_limit_allows_reads_what_helps(made):
    asked = RegistrarConfig(min_confidence=0.9)
    found = limits.applied(made(40), asked)
    assert found.refusal.status is RegistrationStatus.LOW_CONFIDENCE
    for word in ("0.89", "0.9", "another subject", "denser", "noise_mm"):
        assert word in found.refusal.reason
    refused = Refusal(RegistrationStatus.DEGENERATE, "flat")
    assert limits.applied(made(40, refusal=refused), asked).refusal is refused


def test_a_registrar_and_a_tracker_limit_what_few_points_say(registrar, femur, target):
    points = femur.sample(120, np.random.default_rng(4))[0]
    noisy = points + np.random.default_rng(5).normal(0.0, 0.2, points.shape)
    stated = Registrar(named(noise_mm=0.2), registrar.proposers)
    tracker = Tracker(registrar)
    tracker.register(noisy, target)
    for found in (registrar.register(noisy, target), tracker.register(noisy, target)):
        assert found.ok and found.confidence == 0.89 and found.contributions["sparse"] < 0.0
    assert stated.register(noisy, target).confidence > 0.9


def test_a_strained_source_is_of_another_bone_or_of_a_bone_that_moved(made):
    answer = made()
    assert not answer.deformed and limits.applied(answer, RegistrarConfig()).probability == SURE
    found = limits.applied(made(deformed={"strained": 0.6}), RegistrarConfig())
    assert found.probability == 0.89 and list(found.contributions)[-1] == "strained"


def test_a_source_of_two_halves_in_two_poses_is_not_sure(made):
    found = limits.applied(made(deformed={"apart": 0.6}), RegistrarConfig())
    assert found.probability == 0.89 and list(found.contributions)[-1] == "apart"


def test_a_source_under_a_layer_that_grows_is_not_sure(made):
    found = limits.applied(made(deformed={"layered": 0.6}), RegistrarConfig())
    assert found.probability == 0.89 and list(found.contributions)[-1] == "layered"


def test_a_registration_of_a_bent_source_says_so_and_widens_its_bound(registrar, target, femur):
    """Only this limit holds: with it off, the same answer is sure."""
    points = femur.sample(6000, np.random.default_rng(8))[0]
    points = points[points[:, 2] > np.quantile(points[:, 2], 0.7)]
    middle = np.median(points, axis=0)
    bent = points.copy()
    above = points[:, 2] > middle[2]
    bent[above] = se3.apply(se3.exp(np.radians([0, 0, 0, 4.0, 0.0, 0.0]), middle), points[above])
    rigidity = replace(registrar.config.rigidity, strained=np.inf)
    asked, unasked = (
        Registrar(replace(registrar.config, rigidity=each), registrar.proposers, registrar.calibrations)
        for each in (rigidity, replace(rigidity, apart=np.inf))
    )
    good, found, blind = (each.register(x, target) for each, x in ((asked, points), (asked, bent), (unasked, bent)))
    assert good.ok and "apart" not in good.contributions
    assert found.ok and found.confidence <= 0.89 and "apart" in found.contributions
    assert "apart" not in blind.contributions
    assert found.tre95_mm > 1.2 * blind.tre95_mm


def test_a_registration_of_a_strained_source_says_so_and_widens_its_bound(registrar, target, femur):
    """Slices that are 3 % too far apart: only this limit holds, and without it the bound is too narrow."""
    points = femur.sample(6000, np.random.default_rng(5))[0]
    points = points[points[:, 2] > np.quantile(points[:, 2], 0.6)] + np.random.default_rng(6).normal(0, 0.3, (2400, 3))
    strained = points * [1.0, 1.0, 1.03]
    never = replace(registrar.config, rigidity=replace(registrar.config.rigidity, strained=np.inf))
    unasked = Registrar(never, registrar.proposers, registrar.calibrations)
    good, found, blind = (
        each.register(source, target)
        for each, source in ((registrar, points), (registrar, strained), (unasked, strained))
    )
    assert good.ok and "strained" not in good.contributions
    assert found.ok and found.confidence <= 0.89 and "strained" in found.contributions
    assert "strained" not in blind.contributions
    assert found.tre95_mm > 1.5 * blind.tre95_mm


def test_the_limit_that_held_says_what_helps_and_features_say_nothing():
    assert limits.why_no_surer({"margin": -2.0, "scale_z": 1.0}) == ""
    for limit in limits.LIMITS:
        assert limits.why_no_surer({"margin": -2.0, limit.name: -1.5}) == limit.why


def test_an_answer_is_no_surer_than_what_several_sources_leave_open(registrar):
    """The log odds of its contributions sum up to its confidence still."""
    config = registrar.config
    sure = RegistrationResult(
        RegistrationStatus.OK, np.eye(4), confidence=SURE, contributions={"margin": float(logit(SURE))}
    )
    found = limits.no_surer(sure, limits.MOVING, config)
    assert found.ok and found.confidence == 0.89
    assert sum(found.contributions.values()) == pytest.approx(logit(0.89))
    assert limits.no_surer(found, limits.DOUBTED, config) is found
    refused = limits.no_surer(sure, limits.MOVING, replace(config, min_confidence=0.9))
    assert refused.status is RegistrationStatus.LOW_CONFIDENCE and "collect more" in refused.reason
    assert limits.no_surer(sure, limits.MOVING, replace(config, min_confidence=0.89)).ok
    assert limits.no_surer(refused, limits.MOVING, config) is refused
