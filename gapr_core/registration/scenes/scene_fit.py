"""What a pose explains of a scene: the part of the cloud that is bone, and how well it is separated from the rest."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.registration.checks import rigidity
from gapr_core.registration.checks import second_copy as doubles
from gapr_core.registration.checks.assessment import Assessment, judge
from gapr_core.registration.confidence.classifier import Calibration
from gapr_core.registration.confidence.features import SCENE_FEATURES, of_the_fit
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
from gapr_core.results import Refusal, RegistrationStatus

Array = NDArray[np.float64]

LARGEST_MARGIN = 3.0  # log of a ratio of scores
VIEWPOINT = (
    ". It also looks so where bone was cut away since the scan, and where the viewpoint, given or read off the pixels, "
    "is not the camera's place in the frame of the cloud (none: no camera saw it)"
)
SAY_WHERE = ", or say where the camera was"
RIVAL_IF_ALONE = 1.0  # a pose alone counts as having a rival that is as good: the careful choice


@dataclass(frozen=True, eq=False)
class Explained:
    """The part of a scene that a pose explains.

    Attributes:
        source: the part, as a source of its own.
        members: (N,) mask of the scene's points that are in it.
        fit: the pose, refined on the part alone.
    """

    source: PreparedSource
    members: NDArray[np.bool_]
    fit: Fit

    @property
    def share(self) -> float:
        """Share of the scene's points that count for the pose, 0 to 1."""
        return float((self.fit.weights > 0.0).sum() / len(self.members))


def refine(T: Array, scene: Scene, target: PreparedTarget, config: RegistrarConfig) -> Explained:
    """Refine a pose (4, 4) on what it explains; on the whole cloud where that is next to nothing."""
    for _ in range(config.part.rounds):
        members = _on_surface(T, scene.source, target, config)
        if members.sum() < config.part.fewest_points:
            members[:] = True
        part = scene.part(members, config)
        fit = refine_fully(T, part.points, target, config.refinement, part.neighbours)
        T = fit.T
    return Explained(part, members, fit)


def _on_surface(T: Array, source: PreparedSource, target: PreparedTarget, config: RegistrarConfig) -> NDArray[np.bool_]:
    """(N,) mask of the points that lie on the surface with most of their neighbours, normals agreeing."""
    signed, gradients, aside, _ = kernels.residuals_at(T, source.points, *target.kernel_view, 0.0)
    near = np.hypot(np.nan_to_num(signed, nan=np.inf), aside) < config.clutter.part_mm
    same = np.einsum("ni,ni->n", source.normals @ T[:3, :3].T, gradients)
    near &= (same if source.oriented else np.abs(same)) > config.part.agreeing_cos
    return near & (near[source.neighbours[:, : config.part.crowd]].mean(axis=1) > config.part.most_alone)


def assess_part(
    explained: Explained,
    candidates: Candidates,
    scene: Scene,
    target: PreparedTarget,
    calibration: Calibration,
    config: RegistrarConfig,
) -> Assessment:
    """As `assess_fit`, for a pose that explains a part of a scene."""
    fit, part = explained.fit, explained.source
    eye = covariance.eye_of(fit.T, scene.viewpoint, config.sensor)
    uncertainty = covariance.estimate(fit, config.covariance, config.sensor, part.around, eye=eye)
    look = scene.look[explained.members] if len(scene.images) > 1 else None
    uncertainty = rigidity.allowing_for_looks(uncertainty, fit, look, config)
    features = measure(explained, candidates, uncertainty, scene, target, config)
    judged = judge(fit, candidates, uncertainty, features, part, target, calibration, config)
    return replace(judged, seen=scene.source, members=explained.members, viewpoint=scene.viewpoint, look=look)


def named_clutter(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """The same; a refusal says so where most of the cloud is not this bone.

    With a viewpoint, by what the pose explains; of another dense cloud, by what lies on the bone. This is no safety
    rule: it names why a confidence is low, and so comes after the frames of a stream have been weighed. What lies on
    the bone in another pose is no clutter; where looks show it in several places, that is said.
    """
    source, least, in_scene = assessment.source, config.min_confidence, assessment.seen is not None
    believed = assessment.probability >= least if in_scene else assessment.reaches(least)
    if (
        believed
        or doubles.is_in_two_poses(assessment)
        or look_agreement.is_refused(assessment)
        or not (in_scene or len(source.points) >= config.source.dense_points)
    ):
        return assessment
    if in_scene:
        share, limit = assessment.features["inlier_ratio"], config.part.mostly_clutter
        more = VIEWPOINT if assessment.inferred_viewpoint is None else SAY_WHERE
    else:
        share = float(_on_surface(assessment.fit.T, source, assessment.target, config).mean())
        limit, more = config.part.mostly_off, SAY_WHERE
    return assessment if share >= limit else replace(assessment, refusal=_clutter(share, assessment.refusal, more))


def _clutter(share: float, other: Refusal | None, more: str) -> Refusal:
    why = "no pose of it is certain" if other is None else other.reason
    return Refusal(
        RegistrationStatus.CLUTTER,
        f"in the best pose {100.0 * share:.0f} % of the cloud is this bone, and {why}: is it the right bone? "
        f"If so, crop the cloud with a box around the wound or around the last pose (crop_to_track of the node), or "
        f"expose more of the bone{more}",
    )


def measure(
    explained: Explained,
    candidates: Candidates,
    uncertainty: PoseUncertainty,
    scene: Scene,
    target: PreparedTarget,
    config: RegistrarConfig,
) -> dict[str, float]:
    """The features behind the confidence in a scene (`features.SCENE_FEATURES`); every one is finite."""
    seen = clutter.seen_of(explained.fit.T[None], scene, target, config.clutter)
    visible = _visible_features(seen, candidates, target)
    flatness_mm = scene.source.flatness_mm[explained.members]  # of the part alone it is that of what lies on the bone
    shared = of_the_fit(explained.fit, candidates, uncertainty, explained.source, flatness_mm, target, config)
    values = visible | shared | {"inlier_ratio": explained.share}
    return {name: values[name] for name in SCENE_FEATURES}


def _visible_features(seen: Visible, candidates: Candidates, target: PreparedTarget) -> dict[str, float]:
    """What lines of sight say: shares of the surface, and the margin to the best distinct rival."""
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
