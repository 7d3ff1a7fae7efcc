"""Features of a refined pose among its rivals, from which the two numbers are computed, and their labels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.geometry.extent import half_extent_mm
from gapr_core.geometry.planes import fit_planes
from gapr_core.registration.confidence.roughness import SURE_SIGMAS, rough_misfit_mm
from gapr_core.registration.fit import alternatives
from gapr_core.registration.fit.refinement import SD_OF_MEDIAN, Fit
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem import sensor
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.uncertainty.covariance import SIZES_MM, SMALLEST_SHARE, PoseUncertainty
from gapr_core.registration.uncertainty.linear_model import equations_of, fields, root_mean_square

Array = NDArray[np.float64]

BONE, SCENE = "bone", "scene"  # kinds of answers: a source that is bone alone, a part of a camera's cloud
# sign and plain words of each feature; +1: larger values can only raise the probability, -1: only lower it
SHARED = {
    "log_sigma": (0, "size of the residuals"),
    "log_excess": (-1, "residuals against the noise of the source"),
    "smooth_misfit": (-1, "smooth misfit to the bone, long range"),
    "short_misfit": (-1, "smooth misfit to the bone, short range"),
    "rough_misfit": (-1, "misfit that may change within centimetres"),
    "inlier_ratio": (1, "share of the points that fit"),
    "support": (1, "share of the attempts that ended here"),
    "log_shift_sd": (-1, "uncertainty of the position"),
    "log_turn_sd": (-1, "uncertainty of the rotation"),
    "normal_agreement": (1, "agreement of the normals"),
    "log_points": (0, "number of points"),
    "extent": (0, "size of the source against the bone"),
    "scale_z": (-1, "evidence that another size fits better"),
    "scale_off": (0, "size with which the source fits best"),
    "log_scale_sd": (0, "uncertainty of the size that fits best"),
    "size_margin": (1, "fit of a source of another size"),
    "near_size_margin": (1, "fit of a source grown or shrunk a little"),
    "mirror_margin": (1, "fit of the mirrored source"),
}
OF_BONE = {
    "residual": (0, "residual of the best hypothesis before refinement"),
    "margin": (1, "lead over the next hypothesis"),
    "log_hypotheses": (1, "number of hypotheses that competed"),
}
OF_VIEW = {
    "free_space_score": (1, "score against the camera's lines of sight"),
    "log_explained_mm2": (0, "measured surface that the bone explains"),
    "explained_of_compared": (1, "share of the compared surface that is explained"),
    "violating_of_compared": (-1, "share of the compared surface that the camera looked through"),
    "rival_margin": (1, "lead over the next hypothesis of the scene"),
}
FEATURES_OF = {BONE: (*SHARED, *OF_BONE), SCENE: (*SHARED, *OF_VIEW)}
SIGNS = {name: sign for name, (sign, _) in (SHARED | OF_BONE | OF_VIEW).items() if sign}
FEATURE_LABELS = {name: label for name, (_, label) in (SHARED | OF_BONE | OF_VIEW).items()}
MOST_NAMED, WORTH_NAMING = 2, -0.5  # features named against an answer, and the most log odds of one
NEAR_SIZES = (0.9725, 1.0275)  # halfway: a source of this size fits in size 1 as well as in `SIZES`
FEWEST_FOR_SIZE = 8  # least inliers for an estimate of the size
WIDEST, STANDOFF_MM = 0.3, 0.5  # prior standard deviations of the relative size, and of a stand-off
SURE_SIZE, USUAL_SIZE = 0.005, 0.05  # standard deviations of the model's size, and of other subjects' bones
ERROR_OF_MEDIAN = float(np.sqrt(np.pi / 2.0))  # standard error of a median over that of a mean
LEAST_NOISE_MM = 0.1  # lower bound on the noise of a source
LARGEST_SCALE_Z = 10.0  # clipped: larger values add no information
RIVAL_IF_ALONE = 2.0  # mean square of the assumed rival of a pose alone, over its own
LEAST_MARGIN = 1e-3  # added to the relative lead over the rival, so that its logarithm is finite


def measure(
    fit: Fit,
    candidates: Candidates,
    uncertainty: PoseUncertainty,
    source: PreparedSource,
    target: PreparedTarget,
    config: RegistrarConfig,
    of_view: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Measure the features of an answer; every one is finite.

    Args:
        fit, candidates, uncertainty: the refined pose, the distinct poses, best first, and the pose's covariance.
        source: the registered source.
        target: the bone.
        config: settings of the refinement of changed sources, and the sensor.
        of_view: features of a camera's view (`scene_fit.features_of_view`); None of a source that is bone alone.
    """
    inlier, kind = fit.counts, BONE if of_view is None else SCENE
    agreement = np.abs(np.einsum("ni,ni->n", source.normals @ fit.T[:3, :3].T, fit.gradients))
    noise_mm = max(noise_of(source, fit), LEAST_NOISE_MM)
    values = {
        "log_sigma": float(np.log(fit.sigma_mm)),
        "log_excess": float(np.log(fit.sigma_mm / noise_mm)),
        "smooth_misfit": uncertainty.smooth_mm,
        "short_misfit": uncertainty.short_mm,
        "support": float(candidates.support[0]),
        "log_shift_sd": float(np.log(uncertainty.largest_shift_mm)),
        "log_turn_sd": float(np.log(uncertainty.largest_turn_deg)),
        "normal_agreement": float(np.median(agreement[inlier])) if inlier.any() else 0.0,
        "log_points": float(np.log(len(source.points))),
        "extent": half_extent_mm(source.points) / target.half_extent_mm,
        **of_another_bone(fit, source, target, config),
        **(of_bone_alone(fit, candidates) if of_view is None else of_view),
    }
    return {name: values[name] for name in FEATURES_OF[kind]}


def of_bone_alone(fit: Fit, candidates: Candidates) -> dict[str, float]:
    """Measure the features that only a source of bone alone has."""
    best = candidates.scores[0]
    second = candidates.scores[1] if len(candidates.scores) > 1 else RIVAL_IF_ALONE * best
    return {
        "inlier_ratio": float(fit.counts.mean()),
        "residual": float(np.sqrt(best)),
        "margin": float(np.log(max(second / best, 1.0) - 1.0 + LEAST_MARGIN)),
        "log_hypotheses": float(np.log(candidates.hypotheses)),
    }


def noise_of(source: PreparedSource, fit: Fit) -> float:
    """Estimate the noise of a point, mm, from its neighbours: the upper end of its likely range.

    Noise and the curvature of the bone take neighbours off their plane; their foot points show the curvature alone.
    """
    curved_mm = fit_planes(fit.full_fit.feet, source.patches)[1]
    left_mm2 = source.flatness_mm**2 - curved_mm**2
    middle_mm2 = float(np.median(left_mm2))
    spread_mm2 = SD_OF_MEDIAN * float(np.median(np.abs(left_mm2 - middle_mm2)))
    patches = max(len(fit.full_fit.feet) / source.patches.shape[1], 1.0)
    most_mm2 = middle_mm2 + SURE_SIGMAS * ERROR_OF_MEDIAN * spread_mm2 / np.sqrt(patches)
    return float(np.sqrt(max(most_mm2, 0.0)))


def of_another_bone(
    fit: Fit, source: PreparedSource, target: PreparedTarget, config: RegistrarConfig
) -> dict[str, float]:
    """Measure the fit of sources of another size, side of the body or subject."""
    trial = alternatives.trial_of(fit, source, target, config)
    scale, scale_sd = scale_of(fit)
    usual = max(SURE_SIZE, sensor.errors(config.sensor, len(source.points)).scale)
    return {
        "scale_z": min(abs(scale) / float(np.hypot(scale_sd, usual)), LARGEST_SCALE_Z),
        "scale_off": abs(scale) * USUAL_SIZE**2 / (USUAL_SIZE**2 + scale_sd**2),
        "log_scale_sd": float(np.log(scale_sd)),
        "size_margin": alternatives.other_size(trial),
        "near_size_margin": alternatives.other_size(trial, NEAR_SIZES),
        "mirror_margin": alternatives.mirrored(trial),
        "rough_misfit": rough_misfit_mm(fit),
    }


def scale_of(fit: Fit) -> tuple[float, float]:
    """Estimate the size less 1 with which the source fits best (0.05: it is 5 % too small), and its deviation.

    Generalised least squares with a smooth bias (see `linear_model`), of the pose's six motions, the size, by which a
    residual grows as n . (q - c) at its foot point q, and a shared stand-off, which looks much alike from one side.
    """
    fit = fit.full_fit
    if np.count_nonzero(fit.counts) < FEWEST_FOR_SIZE:
        return 0.0, 1.0
    growth = np.einsum("ni,ni->n", fit.gradients, fit.feet - fit.moved.mean(axis=0))  # feet: points carry noise
    more = np.column_stack([growth, np.ones_like(growth)])
    equations = equations_of(fit).extended(fit, fields(fit), more, (WIDEST, STANDOFF_MM))
    size_mm = root_mean_square(SIZES_MM, equations.log_likelihood(SIZES_MM, SMALLEST_SHARE))
    variance = equations.step_covariance(size_mm)[6, 6]
    scale = float(equations.step(size_mm)[6])
    return float(np.clip(scale, -1.0, 1.0)), float(np.clip(np.sqrt(max(variance, 0.0)), 1e-5, 1.0))


def against(contributions: Mapping[str, float]) -> str:
    """Name the features with the most negative log odds; "" where none is below `WORTH_NAMING`."""
    named = sorted((adds, name) for name, adds in contributions.items() if adds <= WORTH_NAMING)[:MOST_NAMED]
    return ", ".join(FEATURE_LABELS.get(name, name) for _, name in named)
