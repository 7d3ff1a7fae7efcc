"""The part of a scene that a pose explains, and the assessment of the pose by it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.registration.checks.assess import assess_fit
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.fit import kernels
from gapr_core.registration.fit.refinement import Fit, refine_fully
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.scenes import clutter, look_agreement
from gapr_core.registration.scenes.free_space import Visible
from gapr_core.registration.scenes.scene import Scene
from gapr_core.results import Effect, Finding, RegistrationStatus

Array = NDArray[np.float64]

ROUNDS, FEWEST_POINTS = 2, 30  # rounds of choice and refinement; least points of a part, else the whole cloud
AGREEING_COS = 0.7  # least cosine of normals of a point on the bone
CROWD, MOST_ALONE = 12, 0.5  # compared neighbours, and the share of them that must lie on the bone, too
MOSTLY_CLUTTER, MOSTLY_OFF = 0.5, 0.4  # least share that counts for the pose; the same without a viewpoint
LARGEST_MARGIN = 3.0  # log of a ratio of scores
CHECK_WHERE = "; check the viewpoint, too: it is the camera's place in the frame of the cloud"
SAY_WHERE = ", or say where the camera was (viewpoint)"
RIVAL_IF_ALONE = 1.0  # score of the assumed rival of a pose alone, over its own: as good, the careful choice


# the part of a scene that a pose explains: as a source, its (N,) mask in the scene, and the pose refined on it alone
Explained = tuple[PreparedSource, NDArray[np.bool_], Fit]


def refine(T: Array, scene: Scene, target: PreparedTarget, config: RegistrarConfig) -> Explained:
    """Refine a pose (4, 4) on the part that it explains, or on the whole cloud if that is tiny."""
    for _ in range(ROUNDS):
        members = _on_surface(T, scene.source, target, config)
        if members.sum() < FEWEST_POINTS:
            members[:] = True
        part = scene.part(members, config)
        fit = refine_fully(T, part.points, target, config.refinement, part.neighbours)
        T = fit.T
    return part, members, fit


def _on_surface(T: Array, source: PreparedSource, target: PreparedTarget, config: RegistrarConfig) -> NDArray[np.bool_]:
    """Mark the points (N,) that lie on the surface with most of their neighbours, normals agreeing."""
    signed, gradients, aside, _ = kernels.residuals_at(T, source.points, *target.kernel_view, 0.0)
    near = np.hypot(np.nan_to_num(signed, nan=np.inf), aside) < config.clutter.part_mm
    same = np.einsum("ni,ni->n", source.normals @ T[:3, :3].T, gradients)
    near &= (same if source.oriented else np.abs(same)) > AGREEING_COS
    return near & (near[source.neighbours[:, :CROWD]].mean(axis=1) > MOST_ALONE)


def assess_part(
    explained: Explained,
    candidates: Candidates,
    scene: Scene,
    target: PreparedTarget,
    classifier: Classifier,
    config: RegistrarConfig,
) -> Assessment:
    """Assess a pose that explains a part of a scene; see `assess_fit`."""
    source, members, fit = explained
    seen = clutter.seen_of(fit.T[None], scene, target, config.clutter, config.num_threads)
    of_view = features_of_view(seen, candidates, target) | {"inlier_ratio": float(fit.counts.sum() / len(members))}
    look = scene.look[members] if len(scene.images) > 1 else None
    view = {"seen": scene.source, "members": members, "viewpoint": scene.viewpoints.mean(axis=0), "look": look}
    return assess_fit(fit, candidates, source, target, classifier, config, of_view, **view)


def mostly_clutter(assessment: Assessment, config: RegistrarConfig) -> Finding | None:
    """Name a refusal of a cloud that is mostly not this bone.

    With a viewpoint, by the share that the pose explains; of another dense cloud, by the share that lies on the bone.
    """
    source, in_scene = assessment.source, assessment.seen is not None
    is_believed = in_scene and assessment.confidence >= config.min_confidence  # and refused for another reason
    is_cloud = in_scene or len(source.points) >= config.source.dense_points
    if is_believed or not is_cloud or any(finding.check == look_agreement.CHECK for finding in assessment.findings):
        return None
    if in_scene:
        share, limit = assessment.features["inlier_ratio"], MOSTLY_CLUTTER
        more = CHECK_WHERE if assessment.inferred_viewpoint is None else SAY_WHERE
    else:
        share = float(_on_surface(assessment.fit.T, source, assessment.target, config).mean())
        limit, more = MOSTLY_OFF, SAY_WHERE
    if share >= limit:
        return None
    text = f"in the best pose only {100.0 * share:.0f} % of the cloud is this bone"
    advice = f"check that it is the right bone, then crop the cloud with a box, or expose more of the bone{more}"
    return Finding("clutter", Effect.REFUSE, share, limit, RegistrationStatus.CLUTTER, text, advice)


def features_of_view(seen: Visible, candidates: Candidates, target: PreparedTarget) -> dict[str, float]:
    """Measure the lines of sight: shares of the surface, and the margin to the best distinct rival."""
    explained, violating, compared = (float(x[0]) for x in (seen.explained, seen.violating, seen.compared))
    area_mm2 = explained * len(target.points) * target.spacing_mm**2
    rival = candidates.scores[1] / candidates.scores[0] if len(candidates.scores) > 1 else RIVAL_IF_ALONE
    return {
        "free_space_score": float(seen.score[0]),
        "log_explained_mm2": float(np.log(area_mm2 + 1.0)),
        "explained_of_compared": explained / max(compared, 1e-6),
        "violating_of_compared": min(violating / max(compared, 1e-6), 1.0),
        "rival_margin": float(np.clip(np.log(max(rival, 1e-3)), -LARGEST_MARGIN, LARGEST_MARGIN)),
    }
