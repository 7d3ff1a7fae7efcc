"""The part of a scene that a pose explains, and the assessment of the pose by it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.registration.checks.assess import checked_geometry
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.deformation import with_looks
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.confidence.features import FEATURES_OF, SCENE, of_the_fit
from gapr_core.registration.fit import kernels
from gapr_core.registration.fit.refinement import Fit, refine_fully
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.scenes import clutter, look_agreement
from gapr_core.registration.scenes.free_space import Visible
from gapr_core.registration.scenes.scene import Scene
from gapr_core.registration.uncertainty import covariance
from gapr_core.registration.uncertainty.covariance import PoseUncertainty
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


@dataclass(frozen=True, eq=False)
class Explained:
    """The part of a scene that a pose explains.

    Attributes:
        source: the part, as a source of its own.
        members: (N,) mask of the part's points in the scene.
        fit: the pose, refined on the part alone.
    """

    source: PreparedSource
    members: NDArray[np.bool_]
    fit: Fit

    @property
    def share(self) -> float:
        """Share of the scene's points that count for the pose, 0 to 1."""
        return float(self.fit.counts.sum() / len(self.members))


def refine(T: Array, scene: Scene, target: PreparedTarget, config: RegistrarConfig) -> Explained:
    """Refine a pose (4, 4) on the part that it explains, or on the whole cloud if that is tiny."""
    for _ in range(ROUNDS):
        members = _on_surface(T, scene.source, target, config)
        if members.sum() < FEWEST_POINTS:
            members[:] = True
        part = scene.part(members, config)
        fit = refine_fully(T, part.points, target, config.refinement, part.neighbours)
        T = fit.T
    return Explained(part, members, fit)


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
    """Assess a pose that explains a part of a scene, as `assess_fit` does a source of bone alone."""
    fit, part = explained.fit, explained.source
    eye = covariance.eye_of(fit.T, scene.viewpoint, config.sensor)
    uncertainty = covariance.estimate(fit, config.covariance, config.sensor, part.around, eye=eye)
    look = scene.look[explained.members] if len(scene.images) > 1 else None
    uncertainty = with_looks(uncertainty, fit, look)
    features = measure(explained, candidates, uncertainty, scene, target, config)
    assessment = Assessment(
        fit,
        candidates,
        uncertainty,
        features,
        classifier.judge(SCENE, features),
        config.other_bone_prior,
        part,
        target,
        seen=scene.source,
        members=explained.members,
        viewpoint=scene.viewpoint,
        look=look,
    )
    return checked_geometry(assessment, config)


def mostly_clutter(assessment: Assessment, config: RegistrarConfig) -> Finding | None:
    """Find that most of a cloud is not this bone: a reason for its refusal, if it is refused.

    With a viewpoint, by the share that the pose explains; of another dense cloud, by the share that lies on the bone.
    """
    source, in_scene = assessment.source, assessment.seen is not None
    is_believed = in_scene and assessment.confidence >= config.min_confidence  # and refused for another reason
    is_cloud = in_scene or len(source.points) >= config.source.dense_points
    if is_believed or not is_cloud or look_agreement.is_refused(assessment):
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


def measure(
    explained: Explained,
    candidates: Candidates,
    uncertainty: PoseUncertainty,
    scene: Scene,
    target: PreparedTarget,
    config: RegistrarConfig,
) -> dict[str, float]:
    """Measure the features of a scene (`features.FEATURES_OF`); every one is finite."""
    seen = clutter.seen_of(explained.fit.T[None], scene, target, config.clutter)
    visible = _visible_features(seen, candidates, target)
    flatness_mm = scene.source.flatness_mm[explained.members]  # of the whole: that of the part omits tissue
    shared = of_the_fit(explained.fit, candidates, uncertainty, explained.source, flatness_mm, target, config)
    values = visible | shared | {"inlier_ratio": explained.share}
    return {name: values[name] for name in FEATURES_OF[SCENE]}


def _visible_features(seen: Visible, candidates: Candidates, target: PreparedTarget) -> dict[str, float]:
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
