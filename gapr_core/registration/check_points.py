"""Check points: a test of an accepted pose with points of the bone that took no part in it.

Under a right pose with covariance C, the signed distances d of n points from the bone's surface are normal with
covariance S = J C J^T + R. J is their derivative by the error of the pose; R is the covariance of sensor and model.
Then d^T S^-1 d is chi-square with n degrees of freedom. Small distances confirm a pose only if an error would have
shown. So the answer has the error over the bone that the points alone leave open, and the point that would lower it
most: by C_alone = (P^-1 + J^T R^-1 J)^-1 with a loose prior P. Registration and points together put the error of the
pose at C' J^T R^-1 d with covariance C' = (C^-1 + J^T R^-1 J)^-1. The test takes its size over the bone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.special import chdtrc, ndtr

from gapr_core.clouds import finite_points
from gapr_core.config import RegistrarConfig
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.geometry.twists import bound_mm, distance_jacobian, mean_square
from gapr_core.registration.fit import kernels
from gapr_core.registration.problem import sensor
from gapr_core.registration.problem.sensor import Errors, offset_surface
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.registrar import as_config, check_call
from gapr_core.registration.uncertainty.linear_model import CORRELATION_MM, smooth_correlation
from gapr_core.results import PointCheck, RegistrationResult, Verdict

Array = NDArray[np.float64]

SURPRISING = 0.01  # rate at which right poses are contradicted
LOOSE = np.diag([20.0**2] * 3 + [np.radians(20.0) ** 2] * 3)  # covariance of a pose before any check point, mm, rad
MOST_POINTS = 1000  # every pair of points is compared
CANDIDATES = 500  # places of the bone compared for the next point
SAME_MM = 1e-3  # a check point this near to a source point is that point, not another contact


def check_points(
    points: ArrayLike,
    target: PreparedTarget,
    result: RegistrationResult,
    config: RegistrarConfig | None = None,
    within_mm: float = se3.RIGHT_MM,
) -> PointCheck:
    """Test whether points of the bone that took no part in a registration lie on it under the accepted pose.

    Args:
        points: (N, 3) mm, in the frame of the source, one or more; rows that are not finite are dropped. Points of the
            registration test nothing.
        target: the registered bone.
        result: the answer, `OK` and with a covariance.
        config: the sensor that measured the points (`sensor`), and the error of the bone's model
            (`covariance.model_mm`); the defaults when not given.
        within_mm: error over the bone that matters: a pose holds where the points alone would have shown it, and
            with the registration bound it to less.

    Raises:
        InvalidPointCloudError: no points, too many, a wrong shape or type, most of them points of the source. A target
            that is not prepared, or a result without a pose or its covariance.
        ConfigError: `within_mm` is not above 0, or something else than a `RegistrarConfig`.
    """
    check_call(target, None)
    if not 0.0 < within_mm < np.inf:
        raise ConfigError("an error that matters, mm, above 0", repr(within_mm), "pass within_mm=4.0")
    config = RegistrarConfig() if config is None else as_config(config)
    points = finite_points(points)
    if not len(points):
        raise InvalidPointCloudError("check points", "none that is finite", "touch the bone and pass (N, 3), mm")
    if len(points) > MOST_POINTS:
        how = "register a cloud of these; check with points that were touched"
        raise InvalidPointCloudError(f"at most {MOST_POINTS} check points", str(len(points)), how)
    T, covariance, centre = _accepted(result)
    _check_new(points, result)
    surface = offset_surface(target, config.sensor)
    distance_mm, normals = _distances(T, points, surface)
    moved, near = se3.apply(T, points), ~np.isnan(distance_mm)
    J = distance_jacobian(moved[near], normals[near], centre)
    R = _errors_of(moved[near], normals[near], sensor.errors(config.sensor, len(points)), config)
    S = J @ covariance @ J.T + R
    expected_mm = np.full(len(points), np.nan)
    expected_mm[near] = np.sqrt(np.diag(S))
    probability = _probability(distance_mm[near], S) if near.all() else 0.0
    weighted = np.linalg.solve(R, J)
    information = J.T @ weighted
    alone = np.linalg.inv(np.linalg.inv(LOOSE) + information)
    unseen_mm = bound_mm(alone, target.points, centre)
    together = np.linalg.inv(np.linalg.inv(covariance) + information)
    error = together @ weighted.T @ distance_mm[near]
    shown_mm = float(np.sqrt(error @ mean_square(target.points, centre) @ error))
    tre95_mm = shown_mm + bound_mm(together, target.points, centre)  # a mean square root is no larger
    best = _next(alone, target, centre, float(np.diag(R).mean()) if near.any() else 1.0)
    return PointCheck(
        _verdict(probability, shown_mm, max(unseen_mm, tre95_mm), within_mm), probability, points, distance_mm,
        expected_mm, unseen_mm, tre95_mm, target.points[best].copy(), target.normals[best].copy(), shown_mm,
    )  # fmt: skip


def _accepted(result: RegistrationResult) -> tuple[Array, Array, Array]:
    """Return the pose (4, 4), the covariance (6, 6), widened as the bound, and its centre (3,)."""
    if not isinstance(result, RegistrationResult):
        raise InvalidPointCloudError("a result", type(result).__name__, "pass what `register` returned")
    T, covariance, centre = result.T_target_source, result.covariance, result.centre_mm
    if T is None or covariance is None or centre is None:
        given = f"{result.status} by {result.method}"
        raise InvalidPointCloudError(
            "an accepted pose with its covariance", given, "register again, with more of the bone or method gapr"
        )
    if not np.linalg.eigvalsh(covariance).min() > 0.0:
        raise InvalidPointCloudError("a positive definite covariance", "one that is not", "pass it as it was answered")
    if not 0.0 < result.factor95 < np.inf:
        raise InvalidPointCloudError("a factor95 above 0", f"{result.factor95}", "pass the result as it was answered")
    return T, result.factor95**2 * covariance, centre


def _check_new(points: Array, result: RegistrationResult) -> None:
    """Raise for points (N, 3) most of which the registration used: it laid them on the bone itself."""
    if result.residuals is None:
        return
    known = cKDTree(result.residuals.points).query(points)[0] < SAME_MM
    if 2 * known.sum() > len(points):
        how = "touch places of the bone that the source did not show"
        raise InvalidPointCloudError("points that took no part in the registration", f"{known.sum()} that did", how)


def _distances(T: Array, points: Array, target: PreparedTarget) -> tuple[Array, Array]:
    """Measure signed distances (N,), mm, of points (N, 3) to the surface under a pose, and normals."""
    if exact := target.mesh_distances(se3.apply(T, points)):
        return exact
    signed, normals, aside, _ = kernels.residuals_at(T, points, *target.kernel_view, 0.0)
    return np.where(signed < 0.0, -1.0, 1.0) * np.hypot(signed, aside), normals


def _errors_of(moved: Array, normals: Array, errors: Errors, config: RegistrarConfig) -> Array:
    """Compute the (n, n) covariance of the distances of points under the true pose, mm^2.

    It sums noise, a smooth bias of near points, and a stand-off and an error of the model that all share. Another size
    moves a point along its normal by its place; an error of the tracker moves all as one body.
    """
    alike = smooth_correlation(moved, moved, CORRELATION_MM)
    grown = np.einsum("ni,ni->n", moved - moved.mean(axis=0), normals) if len(moved) else np.empty(0)
    own_mm2 = errors.noise_mm**2 + errors.local_mm**2
    shared_mm2 = errors.standoff_mm**2 + config.covariance.model_mm**2
    R = own_mm2 * np.eye(len(moved)) + errors.bias_mm**2 * alike + shared_mm2 + errors.scale**2 * np.outer(grown, grown)
    if len(moved):
        J = distance_jacobian(moved, normals, moved.mean(axis=0))
        R += J @ errors.place_covariance @ J.T
    return np.asarray(R)


def _probability(distance_mm: Array, S: Array) -> float:
    """Compute the probability that n normal distances with covariance S (n, n) are this large or larger.

    The smaller of two tests', times two: of all together (chi-square), and of the farthest alone (Bonferroni).
    """
    together = chdtrc(len(distance_mm), distance_mm @ np.linalg.solve(S, distance_mm))
    farthest = 2.0 * ndtr(-np.abs(distance_mm / np.sqrt(np.diag(S))).max()) * len(distance_mm)
    return float(min(2.0 * min(together, farthest), 1.0))


def _verdict(probability: float, shown_mm: float, open_mm: float, within_mm: float) -> Verdict:
    """Judge points that show one error over the bone, mm, and leave another one open, against one that matters."""
    if probability < SURPRISING or shown_mm > within_mm:
        return Verdict.CONTRADICTED
    return Verdict.HOLDS if open_mm <= within_mm else Verdict.SAYS_LITTLE


def _next(covariance: Array, target: PreparedTarget, centre: Array, variance_mm2: float) -> int:
    """Choose the target point where a measurement of this variance lowers the mean square error over the bone most.

    A distance with derivative j takes C j j^T C / (s^2 + j^T C j) off the covariance C of the pose (Kalman 1960).
    """
    chosen = np.arange(0, len(target.points), max(1, len(target.points) // CANDIDATES))
    J = distance_jacobian(target.points[chosen], target.normals[chosen], centre)
    CJ = J @ covariance
    moved = mean_square(target.points, centre)
    gain = np.einsum("ki,ij,kj->k", CJ, moved, CJ) / (variance_mm2 + np.einsum("ki,ki->k", CJ, J))
    return int(chosen[gain.argmax()])
