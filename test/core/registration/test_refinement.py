import numpy as np
import pytest

from gapr_core.config import CovarianceConfig, RefinementConfig
from gapr_core.geometry import se3
from gapr_core.registration.fit import refinement
from gapr_core.registration.problem.target import prepare
from gapr_core.registration.uncertainty import covariance

CONFIG = RefinementConfig()


def seen_from_above(femur, count, noise_mm, seed):
    """Surface points of the upper half of the bone, with isotropic noise."""
    rng = np.random.default_rng(seed)
    points, normals = femur.sample(6 * count, rng)
    seen = points[normals @ [0.0, 1.0, 0.0] > 0.2][:count]
    return seen + rng.normal(0.0, noise_mm, seen.shape)


def test_every_pose_in_the_basin_comes_to_the_same_rest(femur, target):
    source = seen_from_above(femur, 1500, 0.5, seed=1)
    rests = []
    for seed in range(4):
        twist = np.random.default_rng(seed).normal(size=6) * [2, 2, 2, 0.03, 0.03, 0.03]
        fit = refinement.refine_fully(se3.exp(twist, source.mean(axis=0)), source, target, CONFIG)
        rests.append(se3.apply(fit.T, source))
    assert np.abs(np.array(rests) - rests[0]).max() < 0.02
    assert np.sqrt(((rests[0] - source) ** 2).sum(axis=1).mean()) < 0.3


def test_residuals_on_a_sphere_are_its_distances():
    from gapr_core import Registrar
    from gapr_core.geometry.sampling import fibonacci_directions

    ball = Registrar.from_pretrained().prepare(30.0 * fibonacci_directions(5000))
    probes = fibonacci_directions(777) * np.linspace(27.0, 33.0, 777)[:, None]
    fit = refinement.evaluate(np.eye(4), probes, ball, RefinementConfig(largest_sigma_mm=1e-3, smallest_sigma_mm=1e-3))
    assert fit.signed_mm == pytest.approx(np.linalg.norm(probes, axis=1) - 30.0, abs=0.02)


def test_elements_at_edges_weigh_less_than_those_on_faces():
    rng = np.random.default_rng(0)
    faces = rng.uniform(-30.0, 30.0, (9000, 3))
    sides = rng.integers(3, size=9000)
    faces[np.arange(9000), sides] = rng.choice([-30.0, 30.0], 9000)
    box = prepare(faces)
    to_edge = 30.0 - np.sort(np.abs(box.points), axis=1)[:, 1]
    fit = refinement.evaluate(np.eye(4), box.points, box, CONFIG)
    assert box.elements[to_edge < 0.5, 12].mean() > 20.0 * box.elements[to_edge > 6.0, 12].mean()
    assert fit.weights[to_edge < 0.5].mean() < 0.7 < 0.95 < fit.weights[to_edge > 6.0].mean()


def test_the_weakest_turn_of_a_shaft_is_about_its_axis():
    from gapr_core import Registrar

    rng = np.random.default_rng(0)
    angle, z = rng.uniform(0, 2 * np.pi, 8000), rng.uniform(-120, 120, 8000)
    shaft = np.stack([14 * np.cos(angle), 12 * np.sin(angle), z], axis=1)
    source = shaft[(angle < 3.0) & (np.abs(z) < 60)] + rng.normal(
        0, 0.3, ((((angle < 3.0) & (np.abs(z) < 60)).sum()), 3)
    )
    fit = refinement.refine_fully(np.eye(4), source, Registrar.from_pretrained().prepare(shaft), CONFIG)
    uncertainty = covariance.estimate(fit, CovarianceConfig())
    assert abs(uncertainty.weakest_shift[2]) > 0.99
    assert abs(uncertainty.weakest_turn[2]) > 0.99
