"""Planes through neighbourhoods, against numpy."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gapr_core.geometry import quadrics
from gapr_core.geometry.planes import fit_planes


@pytest.mark.parametrize("offset_mm", [0.0, 500.0])
def test_planes_are_those_of_the_principal_axes(offset_mm):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) * [40.0, 20.0, 1.0] @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + offset_mm
    neighbours = cKDTree(points).query(points, k=20)[1]
    normals, flatness_mm, means = fit_planes(points, neighbours)
    frames = quadrics.local_frames(points, neighbours)
    assert np.abs(np.einsum("ni,ni->n", normals, frames.normals)) == pytest.approx(np.ones(500), abs=1e-12)
    assert flatness_mm == pytest.approx(frames.flatness_mm, abs=1e-9)
    assert means == pytest.approx(points[neighbours].mean(axis=1), abs=1e-9)


@pytest.mark.parametrize("normal", np.eye(3))
def test_of_an_exact_plane_nothing_is_left(normal):
    points = np.random.default_rng(1).uniform(-5.0, 5.0, (40, 3)) * (1.0 - normal)
    normals, flatness_mm, _ = fit_planes(points, cKDTree(points).query(points, k=8)[1])
    assert np.abs(normals @ normal) == pytest.approx(np.ones(40)) and flatness_mm == pytest.approx(np.zeros(40))


def test_a_single_point_has_a_unit_normal():
    normals, flatness_mm, means = fit_planes(np.ones((3, 3)), np.array([[0], [1], [2]]))
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(3))
    assert np.array_equal(flatness_mm, np.zeros(3)) and np.array_equal(means, np.ones((3, 3)))
