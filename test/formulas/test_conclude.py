"""The one fold: numbers and findings become an answer, or a refusal with its reason and its questions."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from gapr_core.config import RegistrarConfig, SensorConfig, SourceConfig
from gapr_core.registration.checks.conclude import by_threshold, conclude, standoff_question, unit_question
from gapr_core.registration.confidence.features import FEATURE_LABELS, FEATURES_OF, against
from gapr_core.registration.problem.sensor import offset_surface
from gapr_core.registration.scenes.scene_fit import mostly_clutter
from gapr_core.results import Effect, Finding, RegistrationStatus

CONFIG = RegistrarConfig(num_threads=1, source=SourceConfig(dense_points=100))
REFUSED = Finding("x", Effect.REFUSE, 1.0, 1.1, RegistrationStatus.AMBIGUOUS, "another pose fits", "look elsewhere")
WIDENED = Finding("y", Effect.WIDEN, 9.0, 3.0, RegistrationStatus.OK, "it is strained")
CLUTTER = Finding("clutter", Effect.REFUSE, 0.2, 0.5, RegistrationStatus.CLUTTER, "only 20 % is bone", "crop it")


@pytest.fixture(scope="module")
def a():
    return tiny.assessed(tiny.on_ellipsoid(80), tiny.ellipsoid(count=500), proposer="search", rounds=2)


def test_an_answer_carries_the_pose_its_errors_and_both_numbers(a):
    wider = a.with_finding(WIDENED)
    found = conclude(replace(wider, other_bone_prior=0.2), replace(CONFIG, min_confidence=0.9), CLUTTER)
    assert found.ok and not found.reason and np.array_equal(found.T_target_source, a.fit.T)
    assert found.confidence == replace(a, other_bone_prior=0.2).confidence
    assert (found.pose_probability, found.bone_evidence) == (a.judgement.pose_probability, 3.0)
    assert (found.tre_mm, found.tre95_mm, found.factor95) == (a.tre_mm, a.tre95_mm, 1.0)
    assert np.array_equal(found.covariance, a.uncertainty.covariance) and np.array_equal(found.centre_mm, a.centre_mm)
    assert (found.proposer, found.rounds, found.inlier_ratio, found.findings) == ("search", 2, 0.75, (WIDENED,))
    assert found.features is a.features and found.contributions is a.judgement.contributions
    assert len(found.hypotheses) == 2 and len(found.residuals.points) == 80


@pytest.mark.parametrize(
    ("pose", "bone", "factor95", "findings", "clutter", "said", "status", "text"),
    [
        (3.0, 3.0, 1.0, (), None, [], "OK", ""),
        (3.0, 3.0, 1.0, (REFUSED,), None, ["x"], "AMBIGUOUS", "another pose fits; look elsewhere"),
        (-1.0, 3.0, 99.0, (WIDENED, REFUSED), None, ["y", "x"], "AMBIGUOUS", "another pose fits; look elsewhere"),
        (-1.0, 3.0, 99.0, (WIDENED,), None, ["y", "min_confidence"], "LOW_CONFIDENCE", "probability of only 0.26"),
        (3.0, -3.0, 1.0, (), None, ["min_confidence"], "LOW_CONFIDENCE", "may be of another subject's bone"),
        (np.nan, 3.0, 1.0, (), None, ["min_confidence"], "LOW_CONFIDENCE", "probability of only nan"),
        (3.0, 3.0, 99.0, (), None, ["max_tre_mm"], "IMPRECISE", "the error over the bone is below"),
        (3.0, 3.0, 99.0, (), CLUTTER, ["clutter"], "CLUTTER", "only 20 % is bone; the error over the bone"),
        (
            3.0,
            3.0,
            1.0,
            (REFUSED,),
            CLUTTER,
            ["x", "clutter"],
            "CLUTTER",
            "only 20 % is bone; another pose fits; crop it",
        ),
        (3.0, 3.0, 1.0, (WIDENED,), CLUTTER, ["y"], "OK", ""),
    ],
)
def test_a_finding_comes_before_a_threshold_and_clutter_names_them_all(
    a, pose, bone, factor95, findings, clutter, said, status, text
):
    judgement = replace(a.judgement, pose_log_odds=pose, bone_evidence=bone)
    changed = replace(a, judgement=judgement, other_bone_prior=0.1, factor95=factor95, findings=findings)
    found = conclude(changed, replace(CONFIG, max_tre_mm=10.0), clutter)
    assert [each.check for each in found.findings] == said and found.status.value == status
    assert text in found.reason and bool(found.reason) is not found.ok
    assert len(found.hypotheses) == 2 and found.residuals is not None and found.features
    if not found.ok:
        assert found.T_target_source is found.covariance is found.tre95_mm is None


@pytest.mark.parametrize(("confidence", "pose", "tre95_mm", "check"), [
    (0.5, 0.6, 2.0, None), (0.499, 0.499, 1.0, "min_confidence"), (0.499, 0.5, 1.0, "min_confidence"),
    (0.9, 0.9, 2.01, "max_tre_mm"), (0.9, 0.9, np.nan, "max_tre_mm"), (np.nan, 0.9, 1.0, "min_confidence"),
])  # fmt: skip
def test_each_threshold_refuses_alone(confidence, pose, tre95_mm, check):
    found = by_threshold(confidence, pose, tre95_mm, replace(CONFIG, max_tre_mm=2.0), "size of the residuals")
    assert (found and found.check) == check
    assert by_threshold(0.9, 0.9, 1e6, CONFIG) is None, "0 mm switches it off"
    if check == "min_confidence" and pose < 0.5:
        assert found.text.endswith("0.49; against it: size of the residuals")
    elif check == "min_confidence":
        assert "another subject's bone" in found.text and "against it" not in found.text


def test_the_two_features_that_speak_most_against_a_pose_are_named():
    adds = {"mirror_margin": -1.72, "log_sigma": -0.8, "margin": 2.0, "size_margin": -0.6, "extent": -0.1}
    assert against(adds) == "fit of the mirrored source, size of the residuals"
    assert against({"log_sigma": -0.49, "margin": 2.0}) == ""
    assert set(FEATURE_LABELS) == {name for names in FEATURES_OF.values() for name in names}


def cloud_of(extent_mm):
    return np.array([[0.0, 0.0, 0.0], [0.0, 0.0, extent_mm]])


@pytest.mark.parametrize(("extent_mm", "unit"), [
    (40.0, "cm"), (6.0, "cm"), (0.4, "m"), (1.5, ""), (100.0, ""), (400.0, ""),
])  # fmt: skip
def test_a_unit_is_asked_for_where_the_cloud_would_have_the_size_of_the_bone_in_it(extent_mm, unit):
    found = unit_question(cloud_of(extent_mm), cloud_of(400.0))
    assert (found is not None) is bool(unit)
    if unit:
        assert found.text == f"the cloud is {extent_mm:.3g} mm across, the bone 400 mm: is the cloud in {unit}?"
        assert found.effect is Effect.ASK


def test_no_unit_is_asked_for_where_the_cloud_would_be_too_wide_for_the_bone_in_it():
    """The first cloud of a probe on a femur's head: 45 mm across, as the whole femur in cm, but as wide as long."""
    rng = np.random.default_rng(0)
    femur, ball = rng.uniform(-1.0, 1.0, (2, 500, 3))
    thin = unit_question(femur * [4.0, 3.0, 20.0], femur * [40.0, 30.0, 200.0])
    assert thin is not None and unit_question(ball * 13.0, femur * [40.0, 30.0, 200.0]) is None


@pytest.fixture(scope="module")
def lifted():
    """A hundred points of an egg, 1.5 mm outside of it, with .2 mm of noise."""
    egg, rng = tiny.ellipsoid(count=1500), np.random.default_rng(4)
    some = rng.permutation(1500)[:150]
    return lambda mm: tiny.assessed(
        egg.points[some] + (mm + rng.normal(0.0, 0.2, 150))[:, None] * egg.normals[some], egg, pose=-1.0
    )


@pytest.mark.parametrize(("off_mm", "stated_mm", "says"), [
    (0.0, None, ""), (1.5, 1.5, ""),
    (1.5, None, "it fits better 1.5 mm outside of the bone: is the radius of the tip subtracted"),
    (-1.5, None, "it fits better 1.5 mm inside of the bone"),
    (2.5, 1.0, "it fits better 2.5 mm outside of the bone: is the standoff_mm of 1 right?"),
    (0.0, 1.5, "it fits better on the bone: is the standoff_mm of 1.5 right?"),
])  # fmt: skip
def test_a_stand_off_is_asked_for_where_the_source_would_fit_clearly_better(lifted, off_mm, stated_mm, says):
    sensor = SensorConfig(standoff_mm=stated_mm)
    a, config = lifted(off_mm), replace(CONFIG, sensor=sensor)
    found = standoff_question(replace(a, target=offset_surface(a.target, sensor)), config)
    assert (found is not None) is bool(says)
    if says:
        assert says in found.text and found.effect is Effect.ASK and found.statistic < found.threshold < 0.0


def test_only_the_refusal_of_an_improbable_pose_of_bone_alone_asks_for_the_stand_off(lifted):
    a = lifted(1.5)
    asked = conclude(a, CONFIG)
    assert [each.check for each in asked.findings] == ["min_confidence", "stand-off"]
    assert "; it fits better 1.5 mm outside of the bone" in asked.reason
    others = (a.with_finding(REFUSED), replace(a, seen=a.source, members=np.full(150, True)))
    assert not any("it fits better" in conclude(each, CONFIG).reason for each in others)


def test_a_degenerate_refusal_asks_for_the_unit(a):
    degenerate = replace(REFUSED, status=RegistrationStatus.DEGENERATE)
    tenth = replace(a, source=replace(a.source, points=a.source.points / 10.0))
    reason = conclude(tenth.with_finding(degenerate), CONFIG).reason
    assert reason.startswith("another pose fits; look elsewhere; the cloud is 7.33 mm across")
    assert reason.endswith(": is the cloud in cm?")
    assert "is the cloud" not in conclude(tenth, CONFIG, CLUTTER).reason
    assert "is the cloud" not in conclude(a.with_finding(degenerate), CONFIG).reason


@pytest.mark.parametrize(("change", "share"), [
    ({}, 35), ({"off": 60}, None), ({"count": 99}, None), ({"seen": 0.49}, 49), ({"seen": 0.5}, None),
    ({"seen": 0.49, "apart": True}, None), ({"seen": 0.49, "log_odds": 1.0}, None),
])  # fmt: skip
def test_a_dense_cloud_that_is_mostly_not_this_bone_is_named_clutter(change, share):
    """100 points are dense here: 65 off the bone, or less than half of a scene explained; not of apart looks,
    nor of a scene whose pose is believed."""
    rng, count, off = np.random.default_rng(0), change.get("count", 100), change.get("off", 65)
    points = np.column_stack([rng.uniform(5.0, 18.0, count), rng.uniform(-18.0, 18.0, count), np.full(count, 9.0)])
    points[off:] *= [-1.0, 1.0, 0.0]
    a = tiny.assessed(points, tiny.plane(size_mm=60.0))
    if "seen" in change:
        judgement = replace(a.judgement, pose_log_odds=change.get("log_odds", -1.0))
        a = replace(a, seen=a.source, features={"inlier_ratio": change["seen"]}, judgement=judgement)
    if "apart" in change:
        a = a.with_finding(replace(REFUSED, check="looks apart"))
    found = mostly_clutter(a, CONFIG)
    assert (found is not None) is (share is not None)
    if found is not None:
        assert f"only {share} % of the cloud" in found.text and found.status is RegistrationStatus.CLUTTER
        assert ("say where the camera was" in found.advice) is ("seen" not in change)
