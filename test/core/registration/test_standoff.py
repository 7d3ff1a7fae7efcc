"""A source that lies outside of the bone everywhere: its refusal asks for the stand-off."""

from dataclasses import replace

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig, RegistrationStatus
from gapr_core.config import SensorConfig
from gapr_core.registration import standoff

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
