"""Shapes of which no pose can be known: flat faces, straight edges, solids of revolution, smooth and rough."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core import Registrar, RegistrarConfig
from gapr_core.config import CovarianceConfig, RefinementConfig
from gapr_core.data import scans
from gapr_core.data.parametric import make_bone
from gapr_core.data.protocols import make_pair
from gapr_core.data.scenes.things import BOX_FACES
from gapr_core.data.specimen import Specimen
from gapr_core.registration.checks import rules
from gapr_core.registration.fit.refinement import Fit, refine_fully
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem import target as targets
from gapr_core.registration.uncertainty.covariance import estimate
from gapr_core.results import RegistrationStatus
from gapr_core.surface import Surface

CONFIG = RegistrarConfig(num_threads=1)
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
    assert result.T_target_source is None and result.confidence <= 0.4


def fit_of_plane(**kwargs):
    points = np.column_stack([np.random.default_rng(1).uniform(-30.0, 30.0, (500, 2)), np.zeros(500)])
    up = np.tile([0.0, 0.0, 1.0], (500, 1))
    signed = np.random.default_rng(2).normal(0.0, 0.2, 500)
    given = {"weights": np.ones(500), "signed_mm": signed} | kwargs
    return Fit(T=np.eye(4), sigma_mm=0.2, gradients=up, elements=np.zeros(500, dtype=np.int64), moved=points, **given)


def test_what_was_not_observed_is_uncertain_and_not_exact():
    uncertainty = estimate(fit_of_plane(), CovarianceConfig())
    assert rules.has_unobserved_motion(uncertainty, CONFIG.rules)
    assert uncertainty.largest_shift_mm > 100.0 and uncertainty.largest_turn_deg > 100.0
    np.linalg.cholesky(uncertainty.covariance)
    assert np.sqrt(uncertainty.covariance[2, 2]) < 0.6  # across the plane it is known, but for a pointer's stand-off
    nothing = estimate(fit_of_plane(weights=np.zeros(500)), CovarianceConfig())
    assert rules.has_unobserved_motion(nothing, CONFIG.rules)


@pytest.mark.parametrize(("turn_deg", "shift_mm", "turn", "shift"), [
    (7.04, 3.0, "known to 7.0 deg only", "known to 3.0 mm only"),
    (1811.9, 3.0, "not known", "known to 3.0 mm only"),
    (7.04, 1e5, "known to 7.0 deg only", "not known"),
])  # fmt: skip
def test_a_deviation_that_no_turn_or_shift_can_have_is_not_said_in_numbers(turn_deg, shift_mm, turn, shift):
    x, _, z = np.eye(3)
    loose = SimpleNamespace(largest_turn_deg=turn_deg, largest_shift_mm=shift_mm, weakest_turn=x, weakest_shift=z)
    said = f"the rotation about (1.00, 0.00, 0.00) is {turn}, the shift along (0.00, 0.00, 1.00) is {shift}"
    assert rules._what_is_not_observed(loose) == said


@pytest.fixture(scope="module")
def femur_fit():
    pair = make_pair("L2", Specimen(make_bone("femur", 3), "femur", "3"), 5)
    target, source = targets.prepare(pair.target), sources.prepare(pair.source)
    return refine_fully(pair.T_target_source, source.points, target, RefinementConfig()), source, target


def test_a_pose_on_a_bone_comes_back_when_it_is_pushed(femur_fit):
    assert not rules.can_be_pushed(*femur_fit, CONFIG)


def test_a_pose_on_a_plane_stays_where_it_is_pushed(search):
    target, source = search.prepare(rough_box()), sources.prepare(edge(0.1))
    fit = refine_fully(np.eye(4), source.points, target, RefinementConfig())
    assert rules.can_be_pushed(fit, source, target, CONFIG)


def test_the_motions_that_are_pushed_are_those_that_the_residuals_say_least_about():
    points, motions = fit_of_plane().moved, rules._weakest_motions(fit_of_plane(), 3)
    moves = np.array([motion[:3] + np.cross(motion[3:], points - points.mean(axis=0)) for motion in motions])
    assert np.sqrt((moves**2).sum(axis=2).mean(axis=1)) == pytest.approx(1.0)
    assert np.abs(moves[:, :, 2]).max() < 1e-6  # along the plane, never across


def candidates(*scores):
    return Candidates(np.tile(np.eye(4), (len(scores), 1, 1)), np.array(scores), np.ones(len(scores)))


@pytest.mark.parametrize(("scores", "matched"), [((4.0, 4.05), True), ((4.0, 4.2), False), ((0.01, 0.07), True),
                                                 ((0.01, 0.08), False), ((1.0,), False), ((16.0, 16.2), True),
                                                 ((16.0, 16.3), False)])  # fmt: skip
def test_a_rival_is_as_good_within_a_share_or_within_the_roughness(scores, matched):
    assert rules.has_equal_rival(candidates(*scores), CONFIG.rules) is matched
