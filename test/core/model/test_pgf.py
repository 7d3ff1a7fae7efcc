from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gapr_core.model import pgf

RNG = np.random.default_rng(0)


def angle(a, b):
    return math.acos(max(-1.0, min(1.0, float(a @ b) / (np.linalg.norm(a) * np.linalg.norm(b)))))


def reference(p_i, p_j, c_h, c_k, radius):
    """The seven features one by one, the dihedral by turning c_h's half-plane until it holds p_j."""
    axis = (c_k - p_i) / np.linalg.norm(c_k - p_i)
    flat = [v - (v @ axis) * axis for v in (c_h - p_i, p_j - p_i)]
    theta = angle(*flat)
    turned = Rotation.from_rotvec(axis * theta).apply(flat[0])
    if angle(turned, flat[1]) > 1e-6:
        theta = -theta
    lengths = [np.linalg.norm(p_i - p_j), np.linalg.norm(c_h - p_j), np.linalg.norm(c_k - p_j)]
    return [
        *(d / radius for d in lengths),
        angle(p_i - p_j, c_k - p_j),
        angle(p_i - p_j, c_h - p_j),
        angle(c_h - p_j, c_k - p_j),
        theta,
    ]


def features(points, radius=2.0):
    return pgf.pgf(*(torch.from_numpy(np.asarray(p)) for p in points), radius).numpy()


def test_the_seven_features_equal_a_slow_reference_in_float64():
    points = RNG.normal(size=(4, 200, 3))
    expected = [reference(*(p[n] for p in points), 2.0) for n in range(200)]
    np.testing.assert_allclose(features(points), expected, atol=1e-6)


def test_every_degenerate_constellation_has_finite_features_and_bounded_gradients():
    o, x, y = [0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]
    line = [[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0]]
    cases = [[o, o, x, y], [o, x, y, o], [o, x, o, y], [o, o, o, o], line, [o, x, y, y], [o, x, x, x]]
    for dtype in (torch.float32, torch.float64):
        points = torch.tensor(cases, dtype=dtype).requires_grad_()
        embedded = pgf.embed(*points.unbind(1), 1.0)
        embedded.sum().backward()
        assert embedded.isfinite().all() and points.grad.isfinite().all()
        assert points.grad.abs().max() < 1e6


def test_an_undefined_angle_is_zero_and_its_embedding_fades():
    found = features([[0.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]], 1.0)
    assert found[3] == found[4] == found[6] == 0.0 and math.isclose(found[5], math.pi / 2, abs_tol=1e-6)
    embedded = pgf.embed(*(torch.tensor(p) for p in ([0.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0])), 1.0)
    assert embedded[3:7].abs().max() < 1e-3


def test_angles_of_a_small_cloud_are_those_of_a_large_one():
    points = torch.from_numpy(RNG.normal(size=(4, 200, 3))).float()
    large = pgf.embed(*points, 1.0)[..., 3:]
    torch.testing.assert_close(pgf.embed(*(0.05 * points), 1.0)[..., 3:], large, atol=1e-4, rtol=0.0)


def test_ball_centroids_equal_a_loop_and_fall_back_to_the_nearest_point():
    centres, support = torch.rand(2, 7, 3), torch.rand(2, 9, 3)
    centres[0, 0] = 40.0
    valid = torch.ones(2, 9, dtype=torch.bool)
    valid[1, 5:] = False
    found = pgf.ball_centroids(centres, support, valid, 0.4)
    for b in range(2):
        for n in range(7):
            points = support[b][valid[b]]
            distance = (points - centres[b, n]).norm(dim=1)
            near = points[distance <= 0.4] if (distance <= 0.4).any() else points[distance.argmin()][None]
            torch.testing.assert_close(found[b, n], near.mean(0))
