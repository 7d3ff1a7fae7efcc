"""The steps of the bias correction, with the linear algebra replaced: `test_bias_field` holds that."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gapr_core.config import RegistrarConfig, SensorConfig, SmoothBiasConfig
from gapr_core.geometry import se3
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.uncertainty import smooth_bias

COUNT = 12
CONFIG = SmoothBiasConfig(fewest_points=10, iterations=3, sizes_mm=(0.5, 1.0), largest_move=22.5)
STEP = np.array([0.1, -0.2, 0.3, 0.01, 0.02, -0.015])
POINTS = np.random.default_rng(0).uniform(-20.0, 20.0, (COUNT, 3)) + [30.0, 0.0, 10.0]
SOURCE = SimpleNamespace(points=POINTS, neighbours=np.arange(COUNT)[:, None])
EXACT = np.diag([1.0] * 3 + [1e-2] * 3)


def fit_of(T, weights=None):
    moved = se3.apply(T, POINTS)
    weights = np.ones(COUNT) if weights is None else weights
    nothing = np.zeros(COUNT)
    return Fit(T, 0.5, nothing, weights, np.ones((COUNT, 3)), nothing.astype(int), moved)


class Equations:
    """Evidence for a bias in the first rounds, the same step in each."""

    def __init__(self, believed):
        self.believed, self.seen, self.effects, self.design_effect = list(believed), [], [], 3.0

    def of(self, fit, spanned):
        self.seen.append(fit.T)
        return self

    def with_design_effect(self, effect):
        self.effects.append(effect)
        return self

    def log_likelihood(self, sizes_mm, share):
        assert share == CONFIG.smallest_share and tuple(sizes_mm) == CONFIG.sizes_mm
        return np.array([self.believed.pop(0), -50.0])  # all on the first size

    def step(self, size_mm):
        assert size_mm == pytest.approx(0.5)
        return STEP


@pytest.fixture
def steps(monkeypatch):
    """Replaces fields, equations and refinement; says what evidence each round has."""

    def use(*believed):
        equations = Equations(believed)
        monkeypatch.setattr(smooth_bias, "fields", lambda fit, length_mm, centres: (length_mm, centres))
        monkeypatch.setattr(smooth_bias, "equations_of", lambda fit, *of_bias: equations.of(fit, of_bias))
        monkeypatch.setattr(smooth_bias, "NormalEquations", equations)
        monkeypatch.setattr(smooth_bias, "evaluate_with_patches", lambda T, points, *_: fit_of(T))
        return equations

    return use


def corrected(fit, config=CONFIG, covariance=EXACT):
    return smooth_bias.corrected_fit(fit, covariance, SOURCE, None, RegistrarConfig(smooth_bias=config))


def moved_by(count, T):
    for _ in range(count):
        T = se3.exp(STEP, se3.apply(T, POINTS).mean(axis=0)) @ T
    return T


@pytest.mark.parametrize("rounds", [1, 2, 3])
def test_each_round_steps_about_the_centroid_of_where_the_source_lies(steps, rounds):
    equations = steps(9.0, 9.0, 9.0)
    found = corrected(fit_of(np.eye(4)), replace(CONFIG, iterations=rounds))
    assert found.T == pytest.approx(moved_by(rounds, np.eye(4)), abs=1e-12) and len(equations.seen) == rounds
    assert found.bias_mm == pytest.approx(0.5)
    assert equations.effects == [3.0] * (rounds - 1)  # that of the first round stays


def test_a_round_without_evidence_is_the_last(steps):
    steps(9.0, 1.99, 9.0)
    assert corrected(fit_of(np.eye(4))).T == pytest.approx(moved_by(1, np.eye(4)), abs=1e-12)


def test_without_evidence_the_same_fit_comes_back(steps):
    steps(1.99)
    fit = fit_of(np.eye(4))
    assert corrected(fit) is fit


def test_evidence_of_exactly_the_limit_is_believed(steps):
    steps(2.0, 0.0)
    assert corrected(fit_of(np.eye(4))).bias_mm > 0.0


@pytest.mark.parametrize(("inliers", "is_moved"), [(9, False), (10, True)])
def test_too_few_inliers_show_no_bias(steps, inliers, is_moved):
    steps(9.0, 0.0)
    fit = fit_of(np.eye(4), np.arange(COUNT) < inliers)
    assert (corrected(fit) is not fit) is is_moved


@pytest.mark.parametrize(("factor", "is_moved"), [(1.01, True), (0.99, False)])
def test_a_move_beyond_the_limit_in_its_covariance_is_not_made(steps, factor, is_moved):
    """The limit is a squared Mahalanobis distance of the move; the covariance is scaled to lie on either side."""
    steps(9.0, 0.0)
    fit = fit_of(np.eye(4))
    move = np.array([*(se3.apply(moved_by(1, np.eye(4)), POINTS) - POINTS).mean(axis=0), *STEP[3:]])
    distance = move @ np.linalg.solve(EXACT, move)
    found = corrected(fit, covariance=EXACT * distance / CONFIG.largest_move * factor)
    assert (found is not fit) is is_moved


def test_all_points_of_the_source_decide_where_only_some_are_fitted(steps, monkeypatch):
    """Six of the twelve are fitted: the steps are about the centroid of all, whose trust is in the weights."""
    equations, some, trusts = steps(9.0, 9.0, 9.0), np.arange(6), []
    source = SimpleNamespace(points=POINTS[some], neighbours=some[:, None], whole=POINTS)
    monkeypatch.setattr(smooth_bias, "trust_of_whole", lambda *_: np.linspace(0.0, 1.0, COUNT))
    monkeypatch.setattr(smooth_bias, "evaluate_trusted", lambda T, *of: trusts.append(of[-1]) or fit_of(T, of[-1]))
    monkeypatch.setattr(smooth_bias, "evaluate_with_patches", lambda T, points, *_: replace(fit_of(T), moved=points))
    fit = replace(fit_of(np.eye(4)), moved=POINTS[some], whole=fit_of(np.eye(4)))
    found = smooth_bias.corrected_fit(fit, EXACT, source, None, RegistrarConfig(smooth_bias=CONFIG))
    assert found.T == pytest.approx(moved_by(3, np.eye(4)), abs=1e-12) and found.bias_mm == pytest.approx(0.5)
    assert len(found.moved) == 6 and len(found.whole.moved) == COUNT and found.whole.bias_mm == found.bias_mm
    assert np.array_equal(found.whole.weights, trusts[-1]) and len(equations.seen) == 3


def test_an_assessment_gets_the_pose_and_its_covariance_or_stays_the_same(steps, monkeypatch):
    monkeypatch.setattr(smooth_bias, "estimate", lambda fit, *given: ("estimated", fit.bias_mm, *given[-2:]))
    config = RegistrarConfig(smooth_bias=CONFIG)
    known = SimpleNamespace(covariance=EXACT, smooth_mm=0.3, short_mm=0.4)
    assessment = Assessment(fit_of(np.eye(4)), None, known, {}, 0.9, None, SOURCE, None)
    steps(0.0)
    assert smooth_bias.bias_corrected(assessment, config) is assessment
    steps(9.0, 0.0)
    found = smooth_bias.bias_corrected(assessment, config)
    assert found.fit.T == pytest.approx(moved_by(1, np.eye(4)), abs=1e-12)
    assert found.uncertainty == ("estimated", pytest.approx(0.5), (0.3, 0.4), None) and found.probability == 0.9
    steps(9.0, 0.0)
    stated, eye = replace(config, sensor=SensorConfig(scale=0.01)), np.array([0.0, 0.0, -400.0])
    seen = smooth_bias.bias_corrected(replace(assessment, viewpoint=eye), stated)
    np.testing.assert_allclose(seen.uncertainty[-1], se3.apply(seen.fit.T, eye[None])[0])


def test_a_corrected_pose_keeps_what_its_looks_err_by(steps, monkeypatch):
    look, asked = np.arange(COUNT) % 2, []
    monkeypatch.setattr(smooth_bias, "estimate", lambda *_: "estimated")
    monkeypatch.setattr(smooth_bias, "allowing_for_looks", lambda *given: asked.append(given) or "wider")
    config = RegistrarConfig(smooth_bias=CONFIG)
    known = SimpleNamespace(covariance=EXACT, smooth_mm=0.3, short_mm=0.4)
    steps(9.0, 0.0)
    found = smooth_bias.bias_corrected(
        Assessment(fit_of(np.eye(4)), None, known, {}, 0.9, None, SOURCE, None, look=look), config
    )
    ((estimated, fit, of_points, settings),) = asked
    assert found.uncertainty == "wider" and estimated == "estimated" and settings is config
    assert fit is found.fit and of_points is look
