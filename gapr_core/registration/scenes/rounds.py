"""A scene registered: more and more regions of it propose, its lines of sight decide, until an answer is sure.

Of what may be no scene also until two in a row are hopeless: the rounds after them hardly ever have a pose that is
accepted. In a stream the last pose and its rivals are compared first, and no region is asked where that is sure.
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
    """The best pose of what a camera saw, before the costly checks; None where no region proposes any.

    Args:
        seen: from one place or several, without regions.
        target: the bone.
        poses: (K, 4, 4) T_target_source, mm, to try as well.
        classifier: of the two numbers.
        config: every setting.
        clock: of the call.
        rounds: of regions at most, of what may be no scene; `ClutterConfig.rounds`, hopeless or not, when not given.
    """
    settings, threads = replace(config.clutter, rounds=rounds or config.clutter.rounds), config.num_threads
    assessment, hopeless = None, 0
    for number, scene in enumerate(clutter.in_rounds(seen, settings), 1):
        pool = clutter.propose(scene, target, poses, settings, threads)
        clock.lap("propose")
        if not clutter.has_proposed(pool):
            continue  # a pose that was given is not weighed against nothing
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
    """The best of the poses that the scene before had, its rivals among them; no region is asked.

    None where only one is left: nothing would compete with it.

    Args:
        poses: (K, 4, 4) T_target_source, mm.
        most_support: share of the hypotheses that came to the pose when regions were asked last. Of a few remembered
            ones, its own is a large share.
        seen, target, classifier, config, clock: as `register`.
    """
    pool = clutter.given(poses)
    found = clutter.verify(pool, seen, target, config.clutter, config.num_threads, poses)
    candidates = replace(found, support=np.minimum(found.support, most_support))
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
    """The first of the candidates, refined on what it explains, and how sure it is."""
    part = explained.refine(candidates.poses[0], scene, target, config)
    clock.lap("refine")
    assessment = explained.assess_part(part, candidates, scene, target, classifier, config)
    clock.lap("assess")
    return assessment


def of_unknown(source: ArrayLike, config: RegistrarConfig) -> PreparedSource | None:
    """A source of which nobody said where it was seen from, as what a camera may have seen.

    None where it cannot be that.
    """
    if not (config.clutter.infer_viewpoint and clutter.sees_from_afar(config)):
        return None
    try:
        scene = sources.prepare(source, config.source, config.num_threads, in_scene=True)
    except InvalidPointCloudError:
        return None  # of all points some are metres away; those that were looked at as bone are not
    return scene if isinstance(scene, PreparedSource) else None
