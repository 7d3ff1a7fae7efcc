"""What the features and limits of the confidence are, in words."""

from __future__ import annotations

from collections.abc import Mapping

MOST_NAMED = 2
WORTH_NAMING = -0.5  # log odds
WORDS = {
    "log_sigma": "size of the residuals",
    "log_excess": "residuals against the noise of the source",
    "smooth_misfit": "smooth misfit to the bone, long range",
    "short_misfit": "smooth misfit to the bone, short range",
    "inlier_ratio": "share of the points that fit",
    "residual": "residual of the best hypothesis before refinement",
    "margin": "lead over the next hypothesis",
    "support": "share of the attempts that ended here",
    "log_shift_sd": "uncertainty of the position",
    "log_turn_sd": "uncertainty of the rotation",
    "normal_agreement": "agreement of the normals",
    "log_points": "number of points",
    "extent": "size of the source against the bone",
    "scale_z": "evidence that another size fits better",
    "scale_off": "size with which the source fits best",
    "log_scale_sd": "uncertainty of that size",
    "size_margin": "fit of a source of another size",
    "mirror_margin": "fit of the mirrored source",
    "rough_misfit": "misfit that may change within centimetres",
    "shared_misfit": "the same, shared by the sources of a stream",
    "shared_smooth": "smooth misfit that they share",
    "free_space_score": "score against the camera's lines of sight",
    "log_explained_mm2": "measured surface that the bone explains",
    "explained_of_compared": "share of the compared surface that is explained",
    "violating_of_compared": "share of the compared surface that the camera looked through",
    "rival_margin": "lead over the next hypothesis of the scene",
    "sparse": "limit: few points, or points far apart, do not say whose bone it is",
    "beyond_noise": "limit: residuals far larger than the noise of the sensor",
    "beyond_bias": "limit: near points err alike by more than the smooth error of the sensor",
    "rough": "limit: near points of a camera's cloud err alike",
    "uncertain": "limit: the covariance leaves the pose loose",
    "loose": "limit: so loose over the bone, the pose may as well be of another subject's",
    "doubled": "limit: points that do not fit lie on the bone in another pose",
    "patch_off": "limit: one of the separate patches does not fit the others",
    "strained": "limit: the source is longer, wider or slanted against the bone",
    "layered": "limit: the distance from the bone changes along the source",
    "apart": "limit: two halves of the source lie in two poses",
    "far_out": "limit: a stand-off is stated that is larger than a pose may be off",
    "moving": "limit: collected sources hardly exclude that the bone moves",
    "doubted": "limit: one of the last scenes was hardly believed",
    "unconfirmed": "limit: the newest look alone gives no pose, or there is no other",
    "inferred": "limit: where the camera was is inferred from what it saw",
}  # features of the confidence, and its limits


def against(contributions: Mapping[str, float]) -> str:
    """What speaks most against a pose, by the log odds that each feature adds; "" where nothing does.

    Returns:
        Such as "fit of the mirrored source (-1.7), size of the residuals (-0.8)".
    """
    named = sorted((adds, name) for name, adds in contributions.items() if adds <= WORTH_NAMING)[:MOST_NAMED]
    return ", ".join(f"{WORDS.get(name, name)} ({adds:.1f})" for adds, name in named)
