"""Registration of a scene: regions propose round after round, lines of sight decide, until an answer is sure.

A cloud that may be no scene stops after two hopeless rounds in a row: later rounds hardly ever have an accepted pose.
In a stream the last pose and its rivals are compared first; regions propose only where that is not sure.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.config import RegistrarConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.fit.verification import Candidates
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.scenes import clutter
from gapr_core.registration.scenes import scene_fit as explained
from gapr_core.registration.scenes.scene import Scene
from gapr_core.runtime.clock import Clock

Array = NDArray[np.float64]

MOST_HOPELESS = 2  # rounds in a row


def register(
    seen: Scene,
    target: PreparedTarget,
    poses: Array,
    classifier: Classifier,
    config: RegistrarConfig,
    clock: Clock,
    rounds: int | None = None,
) -> Assessment | None:
    """Register a camera's view before the costly checks; None where no region proposes a pose.

    Args:
        seen: view from one place or several, without regions.
        target: the bone.
        poses: (K, 4, 4) T_target_source, mm, to try as well.
        classifier: model of the two numbers.
        config: settings of the registration.
        clock: stage times of the call.
        rounds: most rounds for a cloud that may be no scene; else `ClutterConfig.rounds`, hopeless or not.
    """
    settings, threads = replace(config.clutter, rounds=rounds or config.clutter.rounds), config.num_threads
    assessment, hopeless = None, 0
    for number, scene in enumerate(clutter.in_rounds(seen, settings), 1):
        pool = clutter.propose(scene, target, poses, settings, threads)
        clock.lap("propose")
        if not clutter.has_proposed(pool):
            continue  # a given pose needs a rival
        start = poses if assessment is None else None
        candidates = clutter.verify(pool, scene, target, settings, threads, start)
        poses = candidates.poses
        clock.lap("verify")
        found = _assessed(candidates, scene, target, classifier, config, clock)
        assessment = replace(found, proposer=clutter.NAME, rounds=number)
        hopeless = hopeless + 1 if assessment.confidence < settings.hopeless else 0
        if assessment.reaches(config.sure_from) or (rounds is not None and hopeless == MOST_HOPELESS):
            break
    return assessment


def of_remembered(
    seen: Scene,
    target: PreparedTarget,
    poses: Array,
    most_support: float,
    classifier: Classifier,
    config: RegistrarConfig,
    clock: Clock,
) -> Assessment | None:
    """Compare the poses of the scene before, its rivals among them, without regions.

    None where only one is left: nothing would compete with it.

    Args:
        poses: (K, 4, 4) T_target_source, mm.
        most_support: share of the hypotheses that came to the pose in the last round of regions. Of a few remembered
            ones, its own is a large share.
        seen, target, classifier, config, clock: as `register`.
    """
    pool = clutter.given(poses)
    verified = clutter.verify(pool, seen, target, config.clutter, config.num_threads, poses)
    candidates = replace(verified, support=np.minimum(verified.support, most_support))
    clock.lap("verify")
    return None if len(candidates.poses) < 2 else _assessed(candidates, seen, target, classifier, config, clock)


def _assessed(
    candidates: Candidates,
    scene: Scene,
    target: PreparedTarget,
    classifier: Classifier,
    config: RegistrarConfig,
    clock: Clock,
) -> Assessment:
    """Refine the first of the candidates on its part of the scene, and assess it."""
    part = explained.refine(candidates.poses[0], scene, target, config)
    clock.lap("refine")
    assessment = explained.assess_part(part, candidates, scene, target, classifier, config)
    clock.lap("assess")
    return assessment


def of_unknown(source: ArrayLike, config: RegistrarConfig) -> PreparedSource | None:
    """Prepare a source without a viewpoint as a possible view of a camera.

    None where it cannot be one.
    """
    if not (config.clutter.infer_viewpoint and clutter.sees_from_afar(config)):
        return None
    try:
        scene = sources.prepare(source, config.source, config.num_threads, in_scene=True)
    except InvalidPointCloudError:
        return None  # some of all points are metres away; the fitted ones are not
    return scene if isinstance(scene, PreparedSource) else None
