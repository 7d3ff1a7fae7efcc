"""Labels of the features of the confidence, in plain words."""

from __future__ import annotations

from collections.abc import Mapping

MOST_NAMED = 2
WORTH_NAMING = -0.5  # log odds
FEATURE_LABELS = {
    "log_sigma": "size of the residuals",
    "log_excess": "residuals against the noise of the source",
    "smooth_misfit": "smooth misfit to the bone, long range",
    "short_misfit": "smooth misfit to the bone, short range",
    "inlier_ratio": "share of the points that fit",
    "residual": "residual of the best hypothesis before refinement",
    "margin": "lead over the next hypothesis",
    "log_hypotheses": "number of hypotheses that competed",
    "support": "share of the attempts that ended here",
    "log_shift_sd": "uncertainty of the position",
    "log_turn_sd": "uncertainty of the rotation",
    "normal_agreement": "agreement of the normals",
    "log_points": "number of points",
    "extent": "size of the source against the bone",
    "scale_z": "evidence that another size fits better",
    "scale_off": "size with which the source fits best",
    "log_scale_sd": "uncertainty of the size that fits best",
    "size_margin": "fit of a source of another size",
    "near_size_margin": "fit of a source grown or shrunk a little",
    "mirror_margin": "fit of the mirrored source",
    "rough_misfit": "misfit that may change within centimetres",
    "free_space_score": "score against the camera's lines of sight",
    "log_explained_mm2": "measured surface that the bone explains",
    "explained_of_compared": "share of the compared surface that is explained",
    "violating_of_compared": "share of the compared surface that the camera looked through",
    "rival_margin": "lead over the next hypothesis of the scene",
}


def against(contributions: Mapping[str, float]) -> str:
    """Name the features with the most negative log odds; "" where none is below `WORTH_NAMING`."""
    named = sorted((adds, name) for name, adds in contributions.items() if adds <= WORTH_NAMING)[:MOST_NAMED]
    return ", ".join(FEATURE_LABELS.get(name, name) for _, name in named)
