"""Bones whose model follows the cortical bone on both sides, as a segmentation by threshold gives them."""

import numpy as np
import pytest

from gapr_core.data.parametric import make_bone
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import quadrics, se3, visibility
from gapr_core.registration.checks.assess import with_both_cortices

WALL_MM = 4.0


@pytest.fixture(scope="module")
def hollow_cloud(femur):
    """8192 points of the outer and of the inner cortex, which are which, and those of the outer cortex's normals."""
    points, normals = femur.sample(8192, np.random.default_rng(1))
    inner = np.arange(8192) % 5 < 2
    return points - WALL_MM * normals * inner[:, None], inner, normals


@pytest.fixture(scope="module")
def hollow(registrar, hollow_cloud):
    return registrar.prepare(hollow_cloud[0])


def outer_layer(points):
    neighbours = quadrics.cKDTree(points).query(points, k=12)[1]
    normals = quadrics.local_frames(points, neighbours).normals
    return visibility.outer_layer(points, normals, quadrics.spacing(points))


def test_the_outer_cortex_is_separated_from_the_inner_one(hollow_cloud):
    points, inner, normals = hollow_cloud
    outer, outward = outer_layer(points)
    assert outer[~inner].mean() > 0.98
    assert outer[inner].mean() < 0.10
    assert (np.einsum("ni,ni->n", normals[outer], outward[outer]) > 0).mean() > 0.98


def test_a_bone_of_one_surface_has_no_inner_cortex(femur_cloud, target):
    assert outer_layer(femur_cloud) is None
    assert target.both_cortices is None


def test_one_sided_noise_does_not_slip_between_the_cortices(registrar, hollow, femur):
    """With the inner cortex in the target, points that noise takes inwards would count for it: the pose drifts."""
    rng = np.random.default_rng(2)
    points, normals = femur.sample(12_000, rng)
    seen = points[normals @ [0.0, -1.0, 0.0] > 0.3][:2000]
    source = seen + rng.normal(0.0, 1.5, seen.shape)
    T_true = se3.inverse(se3.exp(np.array([80.0, -40.0, 20.0, 1.0, 0.5, -0.7]), np.zeros(3)))
    results = [registrar.register(se3.apply(se3.inverse(T_true), source), t) for t in (hollow, hollow.both_cortices)]
    assert results[0].ok
    poses = [result.best @ se3.inverse(T_true) for result in results]
    errors_mm = [np.sqrt(((se3.apply(T, seen) - seen) ** 2).sum(axis=1).mean()) for T in poses]
    assert errors_mm[0] < 0.5 < errors_mm[1]


def test_a_source_that_follows_both_cortices_is_registered_to_both(registrar, hollow, hollow_cloud):
    points = hollow_cloud[0]
    end = points[points[:, 2] > np.quantile(points[:, 2], 0.5)]
    source = end + np.random.default_rng(3).normal(0.0, 1.0, end.shape)
    result = registrar.register(source, hollow)
    assert result.ok
    assert se3.pose_error(result.T_target_source, np.eye(4), source)[0] < 0.5


def test_the_bone_of_somebody_else_does_not_follow_both_cortices(registrar, hollow):
    """Two sheets shrink the residuals of any bad fit; that is no sign that the source lies on both."""
    for seed in (1, 2):
        other = Specimen(make_bone("femur", 5), "femur", "5")
        source = make_pair("L2", other, seed).source
        assessment = registrar.assess(source, hollow)
        assert with_both_cortices(assessment, registrar.config) is None
