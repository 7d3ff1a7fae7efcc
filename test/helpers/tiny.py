"""Small targets whose surface elements are exact, for tests that run without Numba's compiler."""

import numpy as np
from scipy.spatial import cKDTree

from gapr_core.config import RefinementConfig, SourceConfig
from gapr_core.geometry import se3
from gapr_core.geometry.distance_field import DistanceField
from gapr_core.geometry.sampling import fibonacci_directions
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.confidence.classifier import Judgement
from gapr_core.registration.fit import refinement
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
from gapr_core.surface import Surface

CELL_MM, REACH_MM = 2.0, 8.0


def ellipsoid(axes_mm=(30.0, 20.0, 12.0), count=400, variance=0.0, symmetric=False) -> PreparedTarget:
    """x^T A x = 1 with A = diag(1 / axes^2): normals and second fundamental forms from the implicit function.

    The Hessian of (x^T A x - 1) / |2 A x| restricted to the tangent plane, with its sign turned, is the form of the
    height over the outward normal. `symmetric`: its points, too, are their own mirror images.
    """
    A = np.diag(1.0 / np.square(axes_mm))
    points = fibonacci_directions(count) * axes_mm
    if symmetric:
        flips = 1.0 - 2.0 * np.indices((2, 2, 2)).reshape(3, -1).T
        points = np.concatenate([points[(points > 0.5).all(axis=1)] * flip for flip in flips])
    gradient = points @ A
    length = np.linalg.norm(gradient, axis=1)
    normals = gradient / length[:, None]
    tangent = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    shapes = -tangent @ (A / length[:, None, None]) @ tangent
    return described(points, normals, shapes, np.full(len(points), variance))


def plane(size_mm=40.0, step_mm=2.0, variance=0.0) -> PreparedTarget:
    """z = 0 with the normal along +z."""
    x, y = np.meshgrid(*2 * [np.arange(-size_mm / 2.0, size_mm / 2.0 + 1e-9, step_mm)])
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return described(points, normals, np.zeros((len(points), 3, 3)), np.full(len(points), variance))


def described(points, normals, shapes, variance) -> PreparedTarget:
    tree = cKDTree(points)
    low = points.min(axis=0) - REACH_MM
    shape = np.ceil((points.max(axis=0) + REACH_MM - low) / CELL_MM).astype(int) + 1
    centres = np.indices(shape).reshape(3, -1).T * CELL_MM + low
    distance, nearest = tree.query(centres)
    nearest = np.where(distance <= REACH_MM, nearest, -1).astype(np.int32).reshape(shape)
    steps = np.where(distance <= REACH_MM, distance * 255.0 / REACH_MM, 255.0).astype(np.uint8).reshape(shape)
    spacing_mm = float(np.median(tree.query(points, k=2)[0][:, 1]))
    elements = np.hstack([points, normals, shapes.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]], variance[:, None]])
    return PreparedTarget(
        points=points,
        normals=normals,
        tree=tree,
        field=DistanceField(low, CELL_MM, nearest, steps, REACH_MM),
        anchors=np.arange(0, len(points), 4),
        spacing_mm=spacing_mm,
        surface=Surface(points),
        elements=elements,
    )


def on_ellipsoid(count, seed=0, axes_mm=(30.0, 20.0, 12.0)):
    """Random surface points."""
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True) * axes_mm


def uncertainty(shift_mm=0.1, turn_deg=0.1) -> PoseUncertainty:
    """Least certain along x and about z."""
    covariance = np.diag([shift_mm**2, 1e-4, 1e-4, 1e-8, 1e-8, np.radians(turn_deg) ** 2])
    return PoseUncertainty(covariance, 0.1, 0.2, 0.3)


def candidates(*scores, shift_mm=30.0) -> Candidates:
    """Poses along x."""
    poses = [se3.exp([shift_mm * k, 0.0, 0.0, 0.0, 0.0, 0.0]) for k in range(len(scores))]
    return Candidates(np.array(poses), np.array(scores), np.ones(len(scores)))


def assessed(
    points, target, T=None, pose=3.0, bone=3.0, scores=(1.0, 2.0), known=None, prior=0.0, **more
) -> Assessment:
    """A source (N, 3) where it lies, with these log odds of the pose and this evidence of the bone."""
    source = sources.prepare(points, SourceConfig(normal_neighbours=10))
    fit = refinement.evaluate(np.eye(4) if T is None else T, source.points, target, RefinementConfig())
    given = {"features": {"inlier_ratio": 0.75}} | more
    judgement = Judgement(pose, bone, {"margin": -2.0, "extent": 1.0})
    return Assessment(
        fit,
        candidates(*scores),
        known or uncertainty(),
        given.pop("features"),
        judgement,
        prior,
        source,
        target,
        **given,
    )
