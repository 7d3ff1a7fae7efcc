"""Landmarks as a start, and planned targets: the error to expect there, and how far they are from the bone."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import markups
from gapr_core.formats.markups import Markups
from gapr_core.geometry.landmarks import LandmarkPose, paired_pose
from gapr_core.geometry.twists import motion_jacobians
from gapr_core.results import RegistrationResult, ResultWarning, TargetError
from gapr_core.surface import Surface, as_points

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

DRAWS = 4096
FAR_MM = 30.0  # planned targets are in a bone, on it, or in the tissue around it
MUCH_NEARER = 0.3  # share of the distance that is left once a mistake is undone
FLIPPED = np.array([-1.0, -1.0, 1.0])
IN_METRES = "Times 1000 it is near: correct the unit of the plan, which is in m."
MISTAKES = {  # of a plan: what undoes it, and what to do
    "With x and y negated it is near: correct which of plan and bone is RAS and which LPS.": FLIPPED,
    IN_METRES: np.full(3, 1000.0),
}
AT_ORIGIN_MM = 1.0  # a plan in m, taken for mm, is as close to the origin as that


def start_of(source: Path, target: Path) -> LandmarkPose:
    """Lay landmarks of one file on those of the other: by equal names, else in order.

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


def with_targets(result: RegistrationResult, points: ArrayLike, labels: Sequence[str] = ()) -> RegistrationResult:
    """See `RegistrationResult.with_targets`; the error is J Sigma J^T of the point (Fitzpatrick 1998).

    The bound is taken times `RegistrationResult.factor95`, as `tre95_mm` is.
    """
    points = as_points(np.atleast_2d(np.asarray(points)))
    apart_mm = np.full(len(points), np.nan) if result.bone is None else distances_mm(points, result.bone)
    warnings = result.warnings + _far_targets(points, apart_mm, result)
    if not result.ok:
        return replace(result, warnings=warnings)
    if result.covariance is None or result.centre_mm is None:
        given = f"a result of {result.method} with status {result.status}"
        raise InvalidPointCloudError("a pose with a covariance", given, "use --method gapr")
    covariances = covariances_at(points, result.covariance, result.centre_mm)
    draws = np.random.default_rng(0).standard_normal((DRAWS, 3))
    names = [" ".join(label.split()) or f"target {number}" for number, label in enumerate(labels, 1)]
    names += [f"target {number}" for number in range(len(names) + 1, len(points) + 1)]
    targets = zip(names, points, covariances, apart_mm, strict=True)
    found = tuple(_error(*target, draws, result.factor95) for target in targets)
    return replace(result, targets=found, warnings=warnings)


def distances_mm(points: Array, bone: Surface) -> Array:
    """Distance of points (N, 3) to a bone, mm: negative inside a mesh; to the nearest point of a cloud.

    Inside, the winding number is above a half: the mesh need not be closed, and may be turned inside out.
    """
    if bone.faces is None or not len(bone.faces):
        return np.asarray(cKDTree(bone.points).query(points)[0])
    import igl

    distance_mm = np.sqrt(igl.point_mesh_squared_distance(points, bone.points, bone.triangles)[0])
    inside = np.abs(igl.winding_number(bone.points, bone.triangles, points)) > 0.5
    return np.where(inside, -distance_mm, distance_mm)


def _far_targets(points: Array, apart_mm: Array, result: RegistrationResult) -> tuple[ResultWarning, ...]:
    """Warn of planned targets (N, 3) far from the bone, or all at its frame's origin, with the likely mistake."""
    far = apart_mm > FAR_MM
    if result.bone is None or not len(points):
        return ()
    if not far.any():
        size_mm = float(np.abs(points).max())
        if not FAR_MM / 1000.0 < size_mm < AT_ORIGIN_MM or (distances_mm(1000.0 * points, result.bone) > FAR_MM).any():
            return ()
        text = f"The planned targets are within {AT_ORIGIN_MM:g} mm of the origin."
        return (ResultWarning("target_far", text, IN_METRES),)
    text = f"{far.sum()} of {len(points)} planned targets {'is' if far.sum() == 1 else 'are'} far from the bone"
    return (ResultWarning("target_far", f"{text}, up to {apart_mm.max():.0f} mm.", _mistake(points[far], result)),)


def _mistake(points: Array, result: RegistrationResult) -> str:
    """Suggest a remedy for targets (N, 3) far from the bone."""
    assert result.bone is not None
    median_mm = np.median(distances_mm(points, result.bone))
    for advice, factors in MISTAKES.items():
        if np.median(distances_mm(points * factors, result.bone)) < MUCH_NEARER * median_mm:
            return advice
    if result.source is not None and len(result.source):
        if np.median(cKDTree(result.source).query(points)[0]) < MUCH_NEARER * median_mm:
            return "The source is near: give the plan in the frame of the bone, not of the source."
    return "Check that the plan is of this bone; its errors hold for a tool that is rigid and exact."


def covariances_at(points: Array, covariance: Array, centre_mm: Array) -> Array:
    """(N, 3, 3) covariance of the position of each point (N, 3) of the target frame, mm^2."""
    jacobians = motion_jacobians(points, centre_mm)
    return np.asarray(jacobians @ covariance @ jacobians.transpose(0, 2, 1))


def _error(label: str, point: Array, covariance: Array, apart_mm: float, draws: Array, factor95: float) -> TargetError:
    variances = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    lengths = np.sqrt(draws**2 @ variances)
    x, y, z = (float(v) for v in point)
    bound95_mm = factor95 * float(np.percentile(lengths, 95.0))
    distance_mm = float(apart_mm) if np.isfinite(apart_mm) else None
    return TargetError(label, (x, y, z), float(np.sqrt(variances.sum())), bound95_mm, distance_mm)


def save_targets(path: Path, errors: Sequence[TargetError]) -> None:
    """Save targets as markups, each with its expected error as the description."""
    points = np.array([error.position_mm for error in errors]).reshape(-1, 3)
    words = [f"expected error {error.expected_mm:.2f} mm, 95 %: {error.bound95_mm:.2f} mm" for error in errors]
    markups.save(path, Markups(points, tuple(error.label for error in errors)), words)
