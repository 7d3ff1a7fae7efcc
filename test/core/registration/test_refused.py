"""Shapes of which no pose can be known: flat faces, straight edges, solids of revolution, smooth and rough."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core import Registrar, RegistrarConfig
from gapr_core.data import scans
from gapr_core.data.scenes.things import BOX_FACES
from gapr_core.results import RegistrationStatus
from gapr_core.surface import Surface

TURN = Rotation.from_euler("xyz", [20.0, 30.0, 40.0], degrees=True).as_matrix()
SIDES_MM = np.array([120.0, 80.0, 50.0])


def box():
    return Surface((np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * SIDES_MM @ TURN.T, BOX_FACES)


def rough_box():
    mesh = box().to_open3d().subdivide_midpoint(6)
    surface = Surface.from_open3d(mesh)
    noise = np.random.default_rng(0).normal(0.0, 0.1, surface.points.shape)
    return Surface(surface.points + noise, surface.faces)


def face(noise_mm, seed=0, count=2000):
    """From the middle of one side."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-30.0, 30.0, count), rng.uniform(-18.0, 18.0, count), np.full(count, 25.0)])
    return (points + rng.normal(0.0, noise_mm, points.shape)) @ TURN.T


def edge(noise_mm, seed=0, count=1000):
    """From the middle of the longest edge, both sides of it."""
    rng = np.random.default_rng(seed)
    along, across = rng.uniform(-30.0, 30.0, (2, count)), rng.uniform(0.0, 25.0, (2, count))
    above = np.column_stack([along[0], 40.0 - across[0], np.full(count, 25.0)])
    beside = np.column_stack([along[1], np.full(count, 40.0), 25.0 - across[1]])
    points = np.vstack([above, beside])
    return (points + rng.normal(0.0, noise_mm, points.shape)) @ TURN.T


@pytest.fixture(scope="module")
def search():
    return Registrar(RegistrarConfig(num_threads=1))


@pytest.fixture(scope="module", params=["flat", "rough", "voxels of 1 mm"])
def target(request, search):
    surface = {"flat": box, "rough": rough_box, "voxels of 1 mm": lambda: scans.of_voxels(1.0, 1.0, 1.0)(box())}
    return search.prepare(surface[request.param]())


@pytest.mark.parametrize("noise_mm", [0.05, 0.3])
@pytest.mark.parametrize("seen", [face, edge])
def test_no_pose_of_a_flat_face_or_a_straight_edge_is_believed(search, target, seen, noise_mm):
    result = search.register(seen(noise_mm), target)
    assert result.status in (RegistrationStatus.DEGENERATE, RegistrationStatus.AMBIGUOUS), result
    assert result.T_target_source is None
