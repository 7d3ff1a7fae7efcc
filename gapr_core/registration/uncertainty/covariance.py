"""Covariance of a refined pose: noise, smooth bias, and the stand-off and scale that no residual shows.

A least-squares pose reacts to errors e of the residuals by a gain, G e. The noise is independent with variance s^2. A
smooth bias has variance b^2 and correlation exp(-d^2 / 2 l^2). All points share a stand-off of variance o^2, and a
relative error of the size of variance q^2. The covariance is G (s^2 I + b^2 K + o^2 1 1^T + q^2 r r^T) G^T (White 1980;
Censi 2007 for the noise alone); `sandwich` has all terms. A Hessian alone is over-confident. The size of the bias comes
from the residuals (`linear_model`), stand-off and scale from the sensor (`sensor`). Errors that vary more slowly than
the correlation are constant or linear in place: in proportion to the bias, all points share an offset and the source is
strained. Slices of a tracked probe share an error each: another K, of short reach. Tracking error adds directly. A weak
prior keeps the variance of an unobserved motion finite.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.config import CovarianceConfig, SensorConfig
from gapr_core.geometry import extent, se3
from gapr_core.geometry.twists import covariance_about
from gapr_core.registration.fit import kernels
from gapr_core.registration.fit.refinement import Fit
from gapr_core.registration.problem import sensor as sensors
from gapr_core.registration.problem.sensor import Errors
from gapr_core.registration.uncertainty.linear_model import (
    POSE_PRIOR,
    UNKNOWNS,
    NormalEquations,
    equations_of,
    fields,
    root_mean_square,
)

Array = NDArray[np.float64]

SIZES_MM = np.array(
    [0.005, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0]
)  # standard deviations of the bias to choose from
SMALLEST_SHARE = 0.03  # least information of a usable field, over the largest
BIAS_GAIN = 2.1  # bias over the part that the residuals of a robust fit show
NO_BIAS_MM = 0.035  # bias that residuals without any show on average
BIAS_SPREAD = 1.0  # log standard deviation of the bias before the residuals
LONG_SHARE, LINEAR_SHARE = 0.5, 0.6  # bias shared by all points, and bias that strains the source, over its size
LOCAL_CORRELATION_MM, LOCAL_CENTRES = 8.0, 160  # of an error that near points share, such as a slice's
ONE_SIDED = 0.3  # length of the mean normal from which on a view has a beam
NOISE_POINTS = 4.0  # weight of the sensor's usual noise, in points
NEIGHBOURS = 30, 12  # points of an average for the smooth misfit, and at short range


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """Covariance of a pose, and the misfits that the residuals show."""

    covariance: Array  # (6, 6), x y z (mm) rx ry rz (rad), fixed target axes, about the moved source's centroid
    bias_mm: float  # standard deviation of the smooth bias that the covariance allows for
    smooth_mm: float  # smooth misfit of the residuals (see `smooth_misfits_mm`)
    short_mm: float  # the same at a shorter range, which also holds rougher misfits: another bone's surface

    def with_more(self, covariance: Array) -> PoseUncertainty:
        """Add the covariance (6, 6) of a further independent error of the pose."""
        return replace(self, covariance=self.covariance + covariance)

    @property
    def weakest_turn(self) -> Array:
        """(3,) unit axis, target frame, about which the rotation is least certain."""
        return _largest_axis(self.covariance[3:, 3:])

    @property
    def weakest_shift(self) -> Array:
        """(3,) unit direction, target frame, along which the position is least certain."""
        return _largest_axis(self.covariance[:3, :3])

    @property
    def largest_shift_mm(self) -> float:
        """Standard deviation along the least certain direction, mm."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def largest_turn_deg(self) -> float:
        """Standard deviation about the least certain axis, deg."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1])))


def estimate(
    fit: Fit,
    config: CovarianceConfig,
    sensor: SensorConfig | None = None,
    around: NDArray[np.int64] | None = None,
    misfits_mm: tuple[float, ...] | None = None,
    eye: Array | None = None,
) -> PoseUncertainty:
    """Estimate the covariance of a fit from its residuals and its sensor; always symmetric and positive definite.

    Args:
        fit: the pose and its residuals; all points of its full fit count, its own alone for the smooth misfits.
        config: errors of the bone's model.
        sensor: errors known before the residuals.
        around: (N, k) neighbours of each point, if known (see `smooth_misfits_mm`).
        misfits_mm: the smooth and the short misfit, if known.
        eye: (3,) mm, target frame: place of a camera with wrong ranges (`eye_of`).
    """
    full = fit.full_fit
    count = int(np.count_nonzero(full.weights))
    known = sensors.errors(sensor or SensorConfig(), count)
    spanned, equations = fields(full), equations_of(full)
    bias_mm = BIAS_GAIN * expected_bias_mm(equations, known.bias_mm)
    sigma_mm = float(np.sqrt(equations.design_effect)) * full.sigma_mm
    noise_mm = expected_noise_mm(sigma_mm, count, known.noise_mm, NOISE_POINTS)
    expected = replace(known, noise_mm=noise_mm, bias_mm=bias_mm)
    covariance = _about_middle(fit, sandwich(full, spanned, expected, config, eye))
    covariance = 0.5 * (covariance + covariance.T) + np.diag([1e-6] * 3 + [1e-10] * 3)
    smooth_mm, short_mm = misfits_mm or smooth_misfits_mm(fit, NEIGHBOURS, around)
    return PoseUncertainty(covariance, bias_mm, smooth_mm, short_mm)


def eye_of(T: Array, viewpoint: Array | None, sensor: SensorConfig) -> Array | None:
    """Locate the camera of a source under a pose (4, 4), (3,) mm, target frame; None without a stated scale."""
    return None if viewpoint is None or sensor.scale is None else se3.apply(T, viewpoint[None])[0]


def covariance_added_by(fit: Fit, errors: Array) -> Array:
    """Compute the (6, 6) covariance that independent `errors` (n, k), mm, of the full fit's inliers add."""
    full = fit.full_fit
    moved = gain_of(full, fields(full), full.sigma_mm)[0] @ errors
    return _about_middle(fit, moved @ moved.T)


def _about_middle(fit: Fit, covariance: Array) -> Array:
    """Shift the covariance (6, 6) of a full fit to the middle of the fit's own points."""
    if fit.full_fit is fit:
        return covariance
    return covariance_about(fit.moved.mean(axis=0) - fit.full_fit.moved.mean(axis=0), covariance)


def expected_noise_mm(sigma_mm: float, count: int, known_mm: float, worth: float) -> float:
    """Estimate the noise of a point from the spread of residuals; the usual noise counts as `worth` points."""
    freedom = max(worth + count - UNKNOWNS, 1.0)
    return float(np.sqrt((worth * known_mm**2 + count * sigma_mm**2) / freedom))


def expected_bias_mm(equations: NormalEquations, typical_mm: float) -> float:
    """Estimate the root mean square of the bias's size, with a log-normal prior about the sensor's typical one."""
    log_prior = -0.5 * (np.log(SIZES_MM / max(typical_mm, SIZES_MM[0])) / BIAS_SPREAD) ** 2
    log_prior += np.log(np.gradient(np.log(SIZES_MM)))  # the sizes are not evenly spaced
    log_posterior = log_prior + equations.log_likelihood(SIZES_MM, SMALLEST_SHARE)
    return float(np.sqrt(max(root_mean_square(SIZES_MM, log_posterior) ** 2 - NO_BIAS_MM**2, 0.0)))


def sandwich(fit: Fit, bias_fields: Array, errors: Errors, config: CovarianceConfig, eye: Array | None = None) -> Array:
    """Compute the (6, 6) covariance of the fit by all errors.

    It is G (s^2 I + b^2 (F F^T + a^2 U + h^2 S S^T) + e^2 E E^T + o^2 d d^T + m^2 U + q^2 r r^T) G^T + T + P. G is the
    gain of the fit, U = 1 1^T a shared error, s the noise. b is the bias with fields F; all points share a
    (`long_share`) of it, and h strains the source (`linear_share`, `strains`). e is the local error with fields E, o
    the stand-off and q the scale (see `directions`). m is the error of the bone's model (`model_mm`), T that of the
    cloud's place, P the prior.
    """
    inlier = fit.counts
    gain, prior = gain_of(fit, bias_fields, errors.noise_mm)
    shift, growth = directions(fit, errors.along_beam, eye)
    local = np.zeros((len(inlier), 1)) if errors.local_mm == 0.0 else fields(fit, LOCAL_CORRELATION_MM, LOCAL_CENTRES)
    moved = np.column_stack(
        [
            errors.bias_mm * gain @ bias_fields[inlier],
            LONG_SHARE * errors.bias_mm * gain.sum(axis=1),
            LINEAR_SHARE * errors.bias_mm * gain @ strains(fit),
            errors.local_mm * gain @ local[inlier],
            errors.standoff_mm * gain @ shift,
            config.model_mm * gain.sum(axis=1),
            errors.scale * gain @ growth,
        ]
    )
    return np.asarray(errors.noise_mm**2 * gain @ gain.T + moved @ moved.T + errors.place_covariance + prior)


def directions(fit: Fit, along_beam: bool, eye: Array | None = None) -> tuple[Array, Array]:
    """Compute the changes of the inliers' residuals (n,) by a stand-off of 1 mm and by an error of size.

    A stand-off moves every point along its normal. An error of the size of 1 moves it by its distance from the
    centroid, or from a camera with wrong ranges at `eye` (3,), mm, target frame. Where only depths are wrong, both move
    a point along the beam d: by n . d, and by (n . d) times its depth. The beam is the mean normal; where that is
    shorter than `ONE_SIDED`, no beam is common.
    """
    inlier = fit.counts
    moved, normals = fit.moved[inlier], fit.gradients[inlier]
    if not inlier.any():
        return np.zeros(0), np.zeros(0)
    away, mean = moved - (moved.mean(axis=0) if eye is None else eye), normals.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if not along_beam or length < ONE_SIDED:
        return np.ones(len(normals)), np.einsum("ni,ni->n", away, normals)
    beam = mean / length
    return normals @ beam, (normals @ beam) * (away @ beam)


def strains(fit: Fit) -> Array:
    """Compute (n, 6) changes of the inliers' residuals by independent strains about their centroid.

    A symmetric matrix E moves a point p by E (p - c), and its residual by n . E (p - c). The six are orthogonal, and
    the norm (Frobenius) of each is 1 over the root mean square distance from the centroid. The foot stands for p, whose
    own distance goes with the residual.
    """
    inlier = fit.counts
    if not inlier.any():
        return np.zeros((0, 6))
    feet, normals = fit.feet[inlier], fit.gradients[inlier]
    products = np.einsum("ni,nj->nij", normals, (feet - feet.mean(axis=0)) / extent.radius_mm(feet))
    i, j = np.triu_indices(3)
    return np.asarray((products[:, i, j] + products[:, j, i]) / np.where(i == j, 2.0, np.sqrt(2.0)))


def gain_of(fit: Fit, bias_fields: Array, noise_mm: float) -> tuple[Array, Array]:
    """Compute the reaction of the pose to errors of the inliers, (6, n) twist per mm, and the prior's covariance.

    G = (J^T V^-1 J + P)^-1 J^T V^-1 up to its sign, with V = s^2 W^-1 + c^2 F F^T (Aitken 1935). c is the bias that the
    pose is corrected for, 0 for plain least squares. V^-1 by Woodbury's identity. P keeps unobserved motions finite.
    """
    inlier = fit.counts
    J, precision = fit.jacobian[inlier], fit.weights[inlier, None] / noise_mm**2
    VJ = precision * J
    if fit.bias_mm > 0.0:
        F = bias_fields[inlier]
        R = np.sqrt(precision) * F
        VJ -= precision * (F @ np.linalg.solve(R.T @ R + np.eye(F.shape[1]) / fit.bias_mm**2, F.T @ VJ))
    P = POSE_PRIOR / noise_mm**2
    H_inverse = np.linalg.inv(J.T @ VJ + P)
    return H_inverse @ VJ.T, H_inverse @ P @ H_inverse


def smooth_misfits_mm(
    fit: Fit, neighbours: tuple[int, ...], around: NDArray[np.int64] | None = None
) -> tuple[float, ...]:
    """Compute the root mean square of the inliers' locally averaged residuals, less the noise left in an average.

    Args:
        fit: the residuals.
        neighbours: numbers of points of an average, one result for each; with as few inliers, `fit.sigma_mm`.
        around: (N, k) indices of each point's nearest ones, itself first, inliers or not, if known; a point
            with too few inliers among them is looked up.
    """
    inlier = fit.counts
    points, signed = fit.moved[inlier], fit.signed_mm[inlier]
    known = np.empty((len(inlier), 0), dtype=np.int64) if around is None else around

    def misfit_mm(count: int) -> float:
        averages = kernels.leading_means(fit.signed_mm, inlier, known, count)[inlier]
        left = np.flatnonzero(np.isnan(averages))
        if len(left):
            averages[left] = signed[cKDTree(points).query(points[left], k=count)[1]].mean(axis=1)
        return float(np.sqrt(max((averages**2).mean() - signed.var() / count, 0.0)))

    return tuple(misfit_mm(count) if len(points) > count else fit.sigma_mm for count in neighbours)


def _largest_axis(block: Array) -> Array:
    return np.asarray(np.linalg.eigh(block)[1][:, -1])
