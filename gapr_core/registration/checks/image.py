"""Mirror images: the other side of the body, or a flipped scan, fits the bone better mirrored.

Near the pose the test is cheap. A nonsensical pose on the bone of the other side has a nonsensical image. So an answer
that is not sure, or of few points, takes the best pose that the first proposer finds for the mirror image.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapr_core.config import RegistrarConfig
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.checks.table import MIRRORED_BETTER
from gapr_core.registration.fit import alternatives
from gapr_core.registration.fit.alternatives import flipped
from gapr_core.registration.fit.refinement import evaluate, refine_many
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.results import Refusal
from gapr_core.runtime.clock import Clock

Propose = Callable[[PreparedSource, PreparedTarget, Clock], Candidates | None]
RegisterScene = Callable[[], Assessment | None]

FEW_POINTS = 400  # points up to which the image may fit somewhere on the bone by chance


def log_ratio(
    assessment: Assessment,
    config: RegistrarConfig,
    believed: bool,
    propose: Propose,
    scene: RegisterScene | None,
    clock: Clock,
) -> float:
    """Measure the log ratio of the misfit of the mirror image over the own one; infinite where nothing compares.

    Args:
        assessment: the answer.
        config: settings of the registration.
        believed: the answer is sure.
        propose: finds poses of the mirror image.
        scene: registers the mirror image of a camera's whole view; None without a given place of a camera.
        clock: stage times.
    """
    trial = alternatives.trial_of(assessment.fit, assessment.source, assessment.target, config)
    count = len(assessment.source.points)
    if alternatives.is_symmetric(trial):
        return np.inf
    found = alternatives.on_own_image(trial)
    by_chance = not believed or (scene is None and count <= FEW_POINTS)
    if not by_chance or found < -MIRRORED_BETTER:
        return found
    if scene is not None:
        image = scene()
        if image is None or not image.confidence > assessment.confidence:  # a poor one may score slightly better
            return np.inf
        return float(np.log(image.candidates.scores[0] / assessment.candidates.scores[0]))
    mirrored = sources.prepare(flipped(assessment.source.whole), config.source, config.num_threads)
    found_poses = None if isinstance(mirrored, Refusal) else propose(mirrored, assessment.target, clock)
    if found_poses is None or isinstance(mirrored, Refusal):
        return np.inf
    return _of_bone(assessment, mirrored, found_poses, config)


def _of_bone(a: Assessment, mirrored: PreparedSource, image: Candidates, config: RegistrarConfig) -> float:
    """Take the larger log ratio, of mean squares or robust variances: gross points may lie on an image by chance."""
    own = float(a.candidates.scores[0])
    if a.seen is not None:  # a scene's own scores are no mean squares
        limits_mm = np.linspace(*config.verification.final_limits_mm)
        own = float(refine_many(a.fit.T[None], a.source.points, a.target, limits_mm, config.num_threads)[1][0])
    sigma_mm = evaluate(image.poses[0], mirrored.points, a.target, config.refinement).sigma_mm
    return max(
        alternatives.log_ratio(float(image.scores[0]), own),
        alternatives.log_ratio(sigma_mm**2, a.fit.sigma_mm**2),
    )
