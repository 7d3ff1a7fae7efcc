"""A source that lies outside of the bone everywhere: its refusal asks for the stand-off."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig, RegistrationStatus
from gapr_core.config import SensorConfig
from gapr_core.data.parametric import make_bone
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3
from gapr_core.registration import registrar as registrars
from gapr_core.registration.checks import standoff
from gapr_core.registration.problem.sensor import offset_surface

REFUSING = RegistrarConfig(num_threads=1, min_confidence=1.0)


@pytest.fixture(scope="module")
def seen(femur):
    """The upper end of the bone from one side, 0.2 mm of noise, so far outside."""
    points, normals = femur.sample(9000, np.random.default_rng(2))
    upper = (points[:, 2] > np.quantile(points[:, 2], 0.75)) & (normals @ [1.0, 0.0, 0.0] > -0.2)

    def of(standoff_mm):
        noise = np.random.default_rng(3).normal(0.0, 0.2, (upper.sum(), 3))
        return (points + standoff_mm * normals)[upper] + noise

    return of


def registered(source, target, registrar, **sensor):
    config = replace(REFUSING, sensor=SensorConfig(**sensor))
    return Registrar(config, registrar.proposers).register(source, target)


@pytest.mark.parametrize(("standoff_mm", "says"), [(1.5, "1.5 mm outside"), (-1.5, "1.5 mm inside")])
def test_a_refusal_asks_for_the_standoff_that_explains_it(registrar, target, seen, standoff_mm, says):
    found = registered(seen(standoff_mm), target, registrar)
    assert found.status is RegistrationStatus.LOW_CONFIDENCE
    assert f"; it fits better {says} of the bone" in found.reason and "standoff_mm" in found.reason
    assert "it fits better" not in registered(seen(0.0), target, registrar).reason


def test_a_standoff_that_is_stated_is_not_asked_for_and_counts_with_what_is_found(registrar, target, seen):
    assert "it fits better" not in registered(seen(1.5), target, registrar, standoff_mm=1.5).reason
    assert "it fits better 2.5 mm outside" in registered(seen(2.5), target, registrar, standoff_mm=1.0).reason


def test_a_standoff_that_is_stated_wrong_is_asked_about(registrar, target, seen):
    reason = registered(seen(0.0), target, registrar, standoff_mm=1.5).reason
    assert "it fits better on the bone: is the standoff_mm of 1.5 right?" in reason


def test_it_has_to_fit_clearly_better(registrar, target, seen, monkeypatch):
    answer = registrar.assess(seen(1.5), target)
    best = {1.5: np.exp(-0.16)}
    monkeypatch.setattr(standoff, "offset_surface", lambda target, sensor: sensor.standoff_mm)
    monkeypatch.setattr(standoff, "refine_many", lambda T, points, at, *_: (T, [100.0 * best.get(at, 1.0)]))
    assert standoff.better_mm(answer, REFUSING) == 1.5
    best[1.5] = np.exp(-0.14)
    assert standoff.better_mm(answer, REFUSING) is None


def test_only_a_probability_that_is_too_low_asks(registrar, target, seen):
    answer = registrar.assess(seen(1.5), target)
    result = registered(seen(1.5), target, registrar)
    assert standoff.asking_the_standoff(replace(result, reason="low"), answer, REFUSING).reason != "low"
    for other in (replace(result, status=RegistrationStatus.DEGENERATE), registrar.register(seen(0.0), target)):
        assert standoff.asking_the_standoff(other, answer, REFUSING) is other
    in_a_scene = replace(answer, seen=answer.source)
    assert standoff.asking_the_standoff(result, in_a_scene, REFUSING) is result


@pytest.fixture(scope="module")
def pelvis(registrar):
    """A pelvis, and points of a view of a seventh of it with their normals, mm."""
    bone = make_bone("pelvis", 2)
    whole = Specimen(bone, "pelvis", "parametric-2")
    rng = np.random.default_rng(1)
    towards = rng.normal(size=3)
    towards /= np.linalg.norm(towards)
    points, normals = whole.sample(60_000, rng)
    facing = normals @ towards > 0.2
    points, normals = points[facing], normals[facing]
    visible = whole.visible_from(points, towards)
    points, normals = points[visible], normals[visible]
    away = points - points[rng.integers(len(points))]
    near = np.argsort(np.linalg.norm(away - np.outer(away @ towards, towards), axis=1))[:9000]
    drawn = rng.permutation(near)[:2500]
    return registrar.prepare(bone), points[drawn] + rng.normal(0.0, 0.3, (2500, 3)), normals[drawn]


def test_under_an_even_layer_a_pose_as_far_off_is_refused_by_this_rule_alone(registrar, pelvis, monkeypatch):
    target, points, normals = pelvis
    source = points + 6.0 * normals
    refused = registrar.register(source, target)
    assert refused.status is RegistrationStatus.LOW_CONFIDENCE
    assert "fits best on a surface about 6 mm outside of the bone" in refused.reason
    assert "standoff_mm to state" in refused.reason and "it fits better" not in refused.reason
    monkeypatch.setattr(registrars, "unless_off_the_bone", lambda assessment, config: assessment)
    believed = registrar.register(source, target)
    assert believed.ok and se3.pose_error(believed.T_target_source, np.eye(4), source).rte_mm > 5.0


@pytest.mark.parametrize("layer_mm", [-1.5, 0.0, 1.5])
def test_cartilage_a_tip_and_a_wrong_threshold_are_no_such_layer(registrar, pelvis, layer_mm):
    target, points, normals = pelvis
    assert registrar.register(points + layer_mm * normals, target).ok


def test_a_layer_that_is_stated_is_none(registrar, pelvis):
    target, points, normals = pelvis
    described = Registrar(RegistrarConfig(num_threads=1, sensor=SensorConfig(standoff_mm=6.0)), registrar.proposers)
    found = described.register(points + 6.0 * normals, target)
    assert found.ok and se3.pose_error(found.T_target_source, np.eye(4), points).rte_mm < 1.0
    on_bone = described.register(points, target)
    assert not on_bone.ok


@pytest.mark.parametrize(
    ("ratios", "is_refused"),
    [
        ({4.5: -0.31, 3.0: -0.2}, True),
        ({-4.5: -0.31, -3.0: -0.2}, True),
        ({-3.0: -0.31, -2.0: -0.2}, True),
        ({-2.0: -0.5, -3.0: -0.4}, False),
        ({4.5: -0.29, 3.0: -0.2}, False),
        ({4.5: -0.4, 3.0: -0.5}, False),
        ({4.5: -0.5, 3.0: 0.01}, False),
    ],
)
def test_it_has_to_fit_much_better_farther_than_4_mm_off(registrar, target, seen, monkeypatch, ratios, is_refused):
    answer = registrar.assess(seen(0.0), target)
    monkeypatch.setattr(standoff, "offset_surface", lambda target, sensor: sensor.standoff_mm)
    of = lambda at: np.exp(ratios.get(at, 0.1)) if isinstance(at, float) else 1.0  # noqa: E731
    monkeypatch.setattr(standoff, "refine_many", lambda T, points, at, *_: (T, [100.0 * of(at)]))
    found = standoff.unless_off_the_bone(answer, registrar.config)
    assert (found.refusal is not None) == is_refused
    assert found.probability <= registrar.config.rules.ruled_out or not is_refused


@pytest.mark.parametrize(
    ("stated_mm", "best_mm", "says"),
    [(2.0, 4.5, "6.5 mm outside"), (2.0, -4.5, "2.5 mm inside"), (6.0, -4.5, "1.5 mm outside")],
)
def test_where_a_standoff_is_stated_the_layer_that_refuses_is_named_from_the_bone(
    registrar, target, seen, monkeypatch, stated_mm, best_mm, says
):
    answer = registrar.assess(seen(0.0), target)
    answer = replace(answer, target=offset_surface(target, SensorConfig(standoff_mm=stated_mm)))
    misfits_mm2 = {best_mm: 50.0, np.copysign(3.0, best_mm): 80.0}
    monkeypatch.setattr(standoff, "offset_surface", lambda target, sensor: sensor.standoff_mm)
    monkeypatch.setattr(standoff, "refine_many", lambda T, points, at, *_: (T, [misfits_mm2.get(at, 100.0)]))
    found = standoff.unless_off_the_bone(answer, registrar.config)
    assert f"fits best on a surface about {says} of the bone" in found.refusal.reason
