"""A source half way between the sizes that the confidence looks at is of another bone too."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig, RegistrationStatus
from gapr_core.config import RulesConfig, SensorConfig
from gapr_core.registration.checks import costly as checks
from gapr_core.registration.checks import rules
from gapr_core.registration.fit import other_size
from gapr_core.registration.problem import source as sources


@pytest.fixture(scope="module")
def seen(femur):
    """One side of the bone, 0.2 mm of noise."""
    points, normals = femur.sample(9000, np.random.default_rng(2))
    side = points[normals @ [0.6, 0.0, 0.8] > 0.2][:2500]
    return side + np.random.default_rng(3).normal(0.0, 0.2, side.shape)


def scaled(points, size):
    return points.mean(axis=0) + size * (points - points.mean(axis=0))


@pytest.mark.parametrize("size", [0.975, 1.028])
def test_growing_and_shrinking_refuses_a_source_of_another_size(registrar, target, seen, size):
    """Whatever the other rules and the probability say."""
    blind = RegistrarConfig(num_threads=1, rules=RulesConfig(largest_scale_z=100.0))
    answer = Registrar(blind, registrar.proposers).assess(scaled(seen, size), target)
    found = checks.unless_grown(replace(answer, refusal=None, probability=0.9), registrar.config)
    assert found.refusal.status is RegistrationStatus.LOW_CONFIDENCE and found.probability <= 0.4
    assert "grown or shrunk by 2.75 %" in found.refusal.reason
    assert registrar.register(seen, target).ok


def test_a_sensor_whose_scale_may_be_wrong_by_as_much_is_not_asked(registrar, target, seen):
    off = scaled(seen, 1.028)
    config = RegistrarConfig(
        num_threads=1, rules=RulesConfig(largest_scale_z=100.0), sensor=SensorConfig(kind="laser", scale=0.02)
    )
    assert "grown" not in Registrar(config, registrar.proposers).register(off, target).reason


def test_few_points_and_a_part_of_a_scene_are_not_asked(registrar, target, seen, monkeypatch):
    asked = []
    monkeypatch.setattr(other_size, "margin", lambda *words: asked.append(words[-1]) or -1.0)
    answer = registrar.assess(seen, target)
    few, enough = (replace(answer, refusal=None, source=SimpleNamespace(points=seen[:n])) for n in (249, 250))
    asked.clear()
    assert checks.unless_grown(few, registrar.config) is few
    assert checks.unless_grown(replace(enough, seen=answer.source), registrar.config).refusal is None and not asked
    assert checks.unless_grown(enough, registrar.config).refusal is not None and asked == [other_size.HALFWAY]
    nobody_called_it_a_scene = replace(enough, seen=answer.source, inferred_viewpoint=np.zeros(3))
    assert checks.unless_grown(nobody_called_it_a_scene, registrar.config).refusal is not None


def test_residuals_that_grow_with_the_source_speak_for_no_size(registrar, target, seen, monkeypatch):
    source = sources.prepare(seen)
    monkeypatch.setattr(other_size, "refine_many", lambda T, points, *_: (T, [points.var(axis=0).sum()]))
    found = other_size.margin(np.eye(4), source, target, registrar.config.verification)
    assert found == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("log_ratio", "refuses"), [(-0.49, False), (-0.51, True), (0.6, False), (np.nan, False)])
def test_another_size_has_to_fit_clearly_better(log_ratio, refuses):
    assert (rules.by_growth(log_ratio, RegistrarConfig().rules) is not None) == refuses
