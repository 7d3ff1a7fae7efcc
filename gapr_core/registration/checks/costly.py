"""What an answer that may yet be accepted is asked last: does another size, does the mirror image fit better?

That costs time. The rules themselves stand in `rules`; here is when they are asked, and of what.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapr_core.config import RegistrarConfig
from gapr_core.registration.checks import rules
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.fit import mirror, other_size
from gapr_core.registration.fit.mirror import Misfit
from gapr_core.registration.fit.verification import mean_square_mm2
from gapr_core.registration.problem import sensor
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.results import Refusal

Register = Callable[[PreparedSource, PreparedTarget], Assessment | None]
RegisterScene = Callable[[], Assessment | None]


def unless_grown(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """The same; refused where the source fits better in another size.

    Few points fit in many sizes, the part that was found in a scene is what fitted, and a sensor whose scale is not
    known to better may be wrong by as much: they are not asked. A scene that nobody called one may be a bone of another
    size, of which a part fits: it is.
    """
    a, count = assessment, len(assessment.source.points)
    if count < config.limits.few_points or _is_known_scene(a):
        return a
    if sensor.errors(config.sensor, count).scale > config.scale.sure:
        return a
    settings = config.verification, config.num_threads
    found = other_size.margin(a.fit.T, a.source, a.target, *settings, other_size.HALFWAY)
    return a.with_refusal(rules.by_growth(found, config.rules), config.rules)


def unless_mirrored(
    assessment: Assessment, config: RegistrarConfig, believed: bool, register: Register, scene: RegisterScene
) -> Assessment:
    """The same; refused where the mirror image of the source fits better.

    Of a nonsensical pose on the bone of the other side the image is as nonsensical, so it takes more than that image.

    Args:
        assessment: the answer.
        config: when a mirror image is registered in full, and what it may not be better by.
        believed: the answer is sure. Where it is not, or of few points, much is left to chance, wherever on the bone:
            the mirror image of such a source is registered in full. Of a scene the part that is bone may be small.
        register: does that.
        scene: does that with all that a camera saw.
    """
    a = assessment
    if mirror.is_symmetric(a.target, config):
        return a
    found = mirror.image_margin(a.fit.T, a.source, a.target, config)
    in_scene = _is_known_scene(a)
    by_chance = not believed or (not in_scene and len(a.source.points) <= config.rules.mirrored_points)
    if by_chance and rules.by_mirror(found, config.rules) is None:
        found = scene_image_margin(a, scene()) if in_scene else full_image_margin(a, config, register)
    return a.with_refusal(rules.by_mirror(found, config.rules), config.rules)


def _is_known_scene(assessment: Assessment) -> bool:
    """True where somebody said, or pixels, that a camera saw this."""
    return assessment.seen is not None and assessment.inferred_viewpoint is None


def full_image_margin(assessment: Assessment, config: RegistrarConfig, register: Register) -> float:
    """As `mirror.image_margin`, with the mirror image of the source registered in full; infinite without a pose."""
    a = assessment
    flipped = sources.prepare(mirror.flipped(a.source.whole), config.source, config.num_threads)
    image = None if isinstance(flipped, Refusal) else register(flipped, a.target)
    if image is None:
        return np.inf
    return _misfit(image, config).log_ratio(_misfit(a, config))


def scene_image_margin(assessment: Assessment, image: Assessment | None) -> float:
    """Log of the score of lines of sight over that of the mirrored scene; infinite where that is no surer.

    A poor image may give its mirror image a slightly better score. On the bone of the other side that is sure (.999).
    """
    if image is None or not image.probability > assessment.probability:
        return np.inf
    return float(np.log(image.candidates.scores[0] / assessment.candidates.scores[0]))  # 1 / score each


def _misfit(assessment: Assessment, config: RegistrarConfig) -> Misfit:
    """How well a pose fits, mm^2 and mm; a scene's own scores are no mean squares."""
    a = assessment
    if a.seen is None:
        return Misfit(float(a.candidates.scores[0]), a.fit.sigma_mm)
    mean_square = mean_square_mm2(a.fit.T, a.source, a.target, config.verification, config.num_threads)
    return Misfit(mean_square, a.fit.sigma_mm)
