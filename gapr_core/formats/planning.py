"""Landmarks as a start, and the error to expect at planned targets."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import markups
from gapr_core.formats.markups import Markups
from gapr_core.geometry.landmarks import LandmarkPose, paired_pose
from gapr_core.geometry.twists import motion_jacobians
from gapr_core.results import RegistrationResult

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

DRAWS = 4096


@dataclass(frozen=True)
class TargetError:
    """The error to expect at one planned target.

    Attributes:
        label: its name in the plan.
        position_mm: x y z, target frame.
        expected_mm: root-mean-square error of the pose there.
        bound95_mm: the error is below it in 95 of 100 cases.
    """

    label: str
    position_mm: tuple[float, float, float]
    expected_mm: float
    bound95_mm: float


def start_of(source: Path, target: Path) -> LandmarkPose:
    """The pose that lays the landmarks of one file on those of the other: by name if both have the same, else in order.

    Small and capital letters are not distinguished. Names that are the same only in part are warned of.

    Raises:
        InvalidPointCloudError: files that cannot be read, or landmarks that determine no pose.
    """
    moving, fixed = markups.load(source), markups.load(target)
    if len(moving.labels) != len(fixed.labels):
        given = f"{len(moving.labels)} in {source.name} and {len(fixed.labels)} in {target.name}"
        raise InvalidPointCloudError("as many source as target landmarks", given, "place the same points in both")
    first, second = ([label.strip().casefold() for label in found.labels] for found in (moving, fixed))
    shared = set(first) & set(second) - {""}
    if len(shared) == len(first):
        return paired_pose(moving.points, fixed.points[[second.index(name) for name in first]])
    if shared:
        log.warning(
            "%s and %s have %d of %d names in common: the landmarks are paired in their order. "
            "Give both the same names, each once, to pair them by name",
            source.name, target.name, len(shared), len(first),
        )  # fmt: skip
    return paired_pose(moving.points, fixed.points)


def errors_at(plan: Markups, result: RegistrationResult) -> list[TargetError]:
    """What the covariance of an accepted pose means at each target: J Sigma J^T of the point (Fitzpatrick 1998).

    The bound is taken times `RegistrationResult.factor95`, as `tre95_mm` is.

    Raises:
        InvalidPointCloudError: a result without a covariance.
    """
    if result.covariance is None or result.centre_mm is None:
        given = f"a result of {result.method} with status {result.status}"
        raise InvalidPointCloudError("a pose with a covariance", given, "use --method gapr")
    covariances = covariances_at(plan.points, result.covariance, result.centre_mm)
    draws = np.random.default_rng(0).standard_normal((DRAWS, 3))
    targets = zip(plan.labels, plan.points, covariances, strict=True)
    return [_error(*target, draws, result.factor95) for target in targets]


def covariances_at(points: Array, covariance: Array, centre_mm: Array) -> Array:
    """(N, 3, 3) covariance of the position of each point (N, 3) of the target frame, mm^2."""
    jacobians = motion_jacobians(points, centre_mm)
    return np.asarray(jacobians @ covariance @ jacobians.transpose(0, 2, 1))


def _error(label: str, point: Array, covariance: Array, draws: Array, factor95: float) -> TargetError:
    variances = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    lengths = np.sqrt(draws**2 @ variances)
    x, y, z = (float(v) for v in point)
    bound95_mm = factor95 * float(np.percentile(lengths, 95.0))
    return TargetError(label, (x, y, z), float(np.sqrt(variances.sum())), bound95_mm)


def save_targets(path: Path, errors: Sequence[TargetError]) -> None:
    """The targets as markups, each with its expected error as the description."""
    points = np.array([error.position_mm for error in errors]).reshape(-1, 3)
    words = [f"expected error {error.expected_mm:.2f} mm, 95 %: {error.bound95_mm:.2f} mm" for error in errors]
    markups.save(path, Markups(points, tuple(error.label for error in errors)), words)
