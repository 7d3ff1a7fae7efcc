"""What no pose can be sure of, whatever the probability that its features give: its limits.

The model of the confidence weighs what it measures. These limits stand for what it does not: evidence that is missing
looks like evidence that is good, and neither the noise of a sensor nor the covariance is compared with the answer. A
limit refuses nothing by itself; it keeps a pose below `LimitsConfig.most`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import logit

from gapr_core.config import RegistrarConfig
from gapr_core.geometry import sampling, se3
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.confidence.roughness import NEAR_MM
from gapr_core.registration.problem import sensor
from gapr_core.registration.uncertainty.linear_model import UNKNOWNS
from gapr_core.results import Refusal, RegistrationResult, RegistrationStatus

Array = NDArray[np.float64]

NEARLY_ALL = 0.9  # share of the points
MOST_COMPARED = 1000  # points whose feet are looked at
SAME_CONTACT_MM = 1.0
DRAWS = 4096
MOVING, UNCONFIRMED, DOUBTED = "moving", "unconfirmed", "doubted"  # what several sources leave open


class Limit(NamedTuple):
    """One limit: its name among the contributions to the log odds, whether it holds, and what helps against it."""

    name: str
    holds: Callable[[Assessment, RegistrarConfig], bool]
    why: str


def applied(assessment: Assessment, config: RegistrarConfig) -> Assessment:
    """The same, no surer than the first limit that holds allows; refused where more is asked for than that."""
    a, most = assessment, config.limits.most
    if not a.probability > most:
        return a
    limit = next((each for each in LIMITS if each.holds(a, config)), None)
    if limit is None:
        return a
    found = a.capped(most, limit.name)
    if a.refusal is not None or most >= config.min_confidence:
        return found
    return replace(found, refusal=Refusal(RegistrationStatus.LOW_CONFIDENCE, too_unsure(limit.why, config)))


def too_unsure(why: str, config: RegistrarConfig) -> str:
    """The reason of a refusal where more is asked for than a limit leaves."""
    most, asked = config.limits.most, config.min_confidence
    return f"the pose is right with a probability of {most:g} at most, {asked:g} is asked for: {why}"


def is_sparse(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True where few points have a neighbour: the others do not say whose bone it is.

    Bones of different subjects are alike to half a millimetre over a knee end. A dense source shows the difference as a
    misfit that near points share. Between sparse points it looks like noise, unless the noise is known
    (`SensorConfig.noise_mm`) and the residuals are as large. Far smaller ones show that it is not: more than the noise
    could hide in what was stated.
    """
    return with_neighbours(assessment) < config.limits.few_points and not is_noise(assessment, config)


def with_neighbours(assessment: Assessment) -> int:
    """How many points that count for the pose have another one within 6 mm, foot point to foot point.

    Points within a millimetre are one: a pointer that is held still sends the same contact again and again. Of many
    points some `MOST_COMPARED` are looked at, evenly taken, and stand for all.
    """
    feet = assessment.fit.feet[assessment.fit.weights > 0.0]
    if not len(feet):
        return 0
    feet = feet[sampling.voxel_indices(feet, SAME_CONTACT_MM)]
    asked = feet[:: max(1, len(feet) // MOST_COMPARED)]
    share = (cKDTree(feet).query(asked, k=2)[0][:, 1] <= NEAR_MM[1]).mean()
    return round(share * len(feet))


def is_noise(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True where the noise is stated, nearly all points count for the pose, and their residuals are about as large."""
    noise_mm, counts = config.sensor.noise_mm, assessment.fit.weights > 0.0
    if noise_mm is None or counts.mean() < NEARLY_ALL:
        return False
    least, most = config.limits.noise_kept
    return least * noise_mm <= residual_mm(assessment) <= most * noise_mm


def is_beyond_noise(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True where the residuals are far larger than the noise of the sensor that is named, and of a bone's model."""
    limits, kind = config.limits, config.sensor
    if kind.kind == "unknown" and kind.noise_mm is None:
        return False
    noise_mm = sensor.errors(kind, len(assessment.source.points)).noise_mm
    return residual_mm(assessment) > limits.noise_exceeded * np.hypot(noise_mm, limits.model_mm)


def is_beyond_bias(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True where near points share more than the smooth errors of the sensor that is named, and of a bone's model.

    Noise averages out of it, but for what near points share of it, so that of a precise sensor another subject's bone
    shows here first. It takes more points than one average is of.
    """
    limits, kind = config.limits, config.sensor
    enough = np.count_nonzero(assessment.fit.weights) > config.covariance.smooth_neighbours
    if not enough or (kind.kind == "unknown" and kind.bias_mm is None):
        return False
    known = sensor.errors(kind, len(assessment.source.points))
    shared_mm = limits.shared_noise * known.noise_mm
    expected_mm = np.sqrt(known.bias_mm**2 + known.local_mm**2 + shared_mm**2 + limits.model_bias_mm**2)
    return bool(assessment.uncertainty.smooth_mm > limits.bias_exceeded * expected_mm)


def is_rough(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True where near points of a scene err alike, by much of what a point errs by.

    The confidence of scenes knows the misfit in mm. A precise camera's is small in mm on another subject's bone, too.
    """
    if assessment.seen is None:
        return False
    rough_mm, sigma_mm = assessment.features["rough_misfit"], np.exp(assessment.features["log_sigma"])
    return bool(rough_mm > config.limits.rough_exceeded * sigma_mm)


def shows_most(name: str) -> Callable[[Assessment, RegistrarConfig], bool]:
    """Whether this is the deformation that the residuals show most (see `rigidity`, `doubles`)."""
    return lambda assessment, _: next(iter(assessment.deformed), None) == name


def asked_of_several(assessment: Assessment, config: RegistrarConfig) -> bool:
    """False: what one source does not show; who knows several asks it, and calls `no_surer`."""
    return False


def residual_mm(assessment: Assessment) -> float:
    """Root mean square residual of the points that count for the pose, whose unknowns count; infinite without any."""
    signed = assessment.fit.signed_mm[assessment.fit.weights > 0.0]
    left = len(signed) - UNKNOWNS
    return float(np.sqrt((signed**2).sum() / left)) if left > 0 else np.inf


def is_uncertain(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True where the covariance itself gives less to a right pose, one within 4 mm and 5 deg."""
    return right_share(assessment.uncertainty.covariance) < config.limits.covered


def is_bound_large(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True where the bone may be so far off somewhere that as much of another subject's would fit as well."""
    return assessment.tre95_mm > config.limits.loose_mm


def is_far_out(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True where a stand-off is stated with which a source that lies on the bone would not have a right pose."""
    return abs(config.sensor.standoff_mm or 0.0) > config.limits.standoff_mm


def is_inferred(assessment: Assessment, config: RegistrarConfig) -> bool:
    """True where nobody said where the camera was: the cloud's surface says it to some 10 degrees only."""
    return assessment.inferred_viewpoint is not None


def right_share(covariance: Array) -> float:
    """Share of a normal distribution with this covariance (6, 6), mm and rad, within 4 mm and 5 deg of its mean."""
    values, vectors = np.linalg.eigh(covariance)
    off = draws() * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    shift_mm, turn_deg = np.linalg.norm(off[:, :3], axis=1), np.degrees(np.linalg.norm(off[:, 3:], axis=1))
    return float(((shift_mm <= se3.RIGHT_MM) & (turn_deg <= se3.RIGHT_DEG)).mean())


@lru_cache(maxsize=1)
def draws() -> Array:
    """(DRAWS, 6) standard normal, always the same."""
    return np.random.default_rng(0).normal(size=(DRAWS, 6))


LIMITS = (
    Limit(
        "sparse",
        is_sparse,
        "so few points, or points so far apart, may as well be of another subject's bone; measure more of them, "
        "denser, or state how precise they are (noise_mm of the sensor)",
    ),
    Limit(
        "beyond_noise",
        is_beyond_noise,
        "the residuals are far larger than the noise of the sensor; check that it is this subject's bone, and what is "
        "said of the sensor",
    ),
    Limit(
        "beyond_bias",
        is_beyond_bias,
        "near points err alike, by more than the smooth error of the sensor; check that it is this subject's bone, and "
        "what is said of the sensor (bias_mm)",
    ),
    Limit(
        "rough",
        is_rough,
        "near points err alike, by much of what each errs by; check that it is this subject's bone, or measure it from "
        "nearer",
    ),
    Limit(
        "doubled",
        shows_most("doubled"),
        "the points that do not fit lie on the bone in another pose; check that bone, reference and sensor did "
        "not move while it was measured, or measure it again",
    ),
    Limit(
        "patch_off",
        shows_most("patch_off"),
        "one of the separate patches does not fit the others: it may lie on other tissue, or something moved; measure "
        "that place again",
    ),
    Limit(
        "strained",
        shows_most("strained"),
        "the source is longer, wider or slanted against the bone; check that nothing moved while it was measured, and "
        "the spacing of the slices of both",
    ),
    Limit(
        "apart",
        shows_most("apart"),
        "two halves of the source lie in two poses; check that nothing moved while it was measured, that parts of it "
        "were put together rightly, and that the bone is whole",
    ),
    Limit(
        "layered",
        shows_most("layered"),
        "the distance from the bone changes along the source, as under tissue; bare the bone, or correct the sensor",
    ),
    Limit("uncertain", is_uncertain, "the points leave the pose too loose; measure a larger part of the bone"),
    Limit(
        "loose",
        is_bound_large,
        "so little of the bone, or so noisy, may as well be of another subject's; measure a larger part of it, or more "
        "precisely",
    ),
    Limit(
        "far_out",
        is_far_out,
        "a stand-off so large is taken out of the pose, and no residual shows that it is right; check standoff_mm, or "
        "measure on the bone",
    ),
    Limit(
        MOVING,
        asked_of_several,  # by an `Accumulator`
        "the collected sources hardly exclude that the bone moves against their frame; check what is fixed to it, or "
        "collect more",
    ),
    Limit(
        UNCONFIRMED,
        asked_of_several,  # by a `LookAccumulator`
        "the newest look alone gives no pose, or there is no other: nothing confirms where the bone is now; look from "
        "elsewhere, and from where more of the bone is seen",
    ),
    Limit(
        DOUBTED,
        asked_of_several,  # by a `Tracker`
        "one of the last scenes was hardly believed with the bone here: it may be another subject's; check that it is "
        "the right bone, or look from where more of it is seen",
    ),
    Limit("inferred", is_inferred, "where the camera was is inferred from what it saw; say where (viewpoint)"),
)


def no_surer(result: RegistrationResult, by: str, config: RegistrarConfig) -> RegistrationResult:
    """An answer with `limits.most` as its confidence at most, for the limit of this name; for who knows several.

    Refused where more is asked for than that.
    """
    most = config.limits.most
    if not result.ok or result.confidence <= most:
        return result
    takes = float(logit(most) - logit(result.confidence))
    found = replace(result, confidence=most, contributions={**result.contributions, by: takes})
    if most >= config.min_confidence:
        return found
    why = why_no_surer(found.contributions)
    return found.refused(RegistrationStatus.LOW_CONFIDENCE, too_unsure(why, config))


def why_no_surer(contributions: Mapping[str, float]) -> str:
    """What kept an answer with these contributions from being sure, and what helps; "" where no limit did."""
    return next((limit.why for limit in LIMITS if limit.name in contributions), "")
