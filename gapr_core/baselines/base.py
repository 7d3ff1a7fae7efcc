"""One interface for every registration method, and the common parts of baselines: centring, checks, refusals."""

from __future__ import annotations

import importlib
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from inspect import signature
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from gapr_core.clouds import finite_points, load
from gapr_core.errors import MethodUnavailableError
from gapr_core.geometry import extent, se3
from gapr_core.results import RegistrationResult, RegistrationStatus, ResultWarning
from gapr_core.surface import Surface

Array = NDArray[np.float64]
Source = str | Path | ArrayLike | Surface

TARGET_POINTS = 8192  # drawn from a mesh, as the protocols do
MIN_SOURCE_POINTS = 10
INLIER_MM = 5.0  # a source point this close to the target counts as explained
RIGID_TOLERANCE = 1e-3  # on R^T R - I and det R - 1; the libraries work in float32


@runtime_checkable
class RegistrationMethod(Protocol):
    """Interface for the benchmark, the node and compositions: `Registrar`, `Tracker` and every baseline."""

    name: str

    def prepare(self, target: Any, units: str = "mm") -> Any:
        """Make the target ready for `register`."""
        ...

    def register(self, source: ArrayLike, target: Any) -> RegistrationResult:
        """Pose of `source` (N, 3), mm, in the frame of the prepared target, or a refusal."""
        ...


def uncalibrated(name: str) -> ResultWarning:
    """Warn of the confidence of a baseline."""
    text = f"{name} is a baseline: its confidence is its share of inliers, not calibrated, and a wrong pose may be OK."
    return ResultWarning("uncalibrated", text, "Use --method gapr for a confidence to rely on.")


def takes(method: RegistrationMethod, hint: str) -> bool:
    """Check whether `register` of a method takes `initial` or `viewpoint`."""
    return hint in signature(method.register).parameters


@dataclass(frozen=True)
class BaselineTarget:
    """A target as one baseline wants it.

    Attributes:
        points: (M, 3) float64, mm, target frame.
        normals: (M, 3) float64 outward unit normals, or None when unknown.
        origin: (3,) mean of the points; the libraries see the points relative to it.
        tree: search tree over `points`.
        owner: the method that made `static`.
        static: features or trees that the library computes once, in coordinates relative to `origin`.
    """

    points: Array
    normals: Array | None
    origin: Array
    tree: cKDTree
    owner: Any = None
    static: Any = field(default=None, repr=False)

    @property
    def half_extent_mm(self) -> float:
        """Largest distance of a point to the mean, mm."""
        return extent.half_extent_mm(self.points)


class NoPose(Exception):
    """Raised inside a baseline when its library found nothing; becomes a refusal with this reason."""


class Baseline(ABC):
    """Template of a baseline: subclasses prepare their library's target and align one centred cloud to another.

    `confidence` of a baseline is the share of source points within 5 mm of the target: a score, not calibrated.
    """

    name: str = "baseline"
    identity_is_failure = False  # libraries that answer failure with the identity

    def prepare(self, target: Any, units: str = "mm") -> BaselineTarget:
        """Make the target ready for `register`.

        Args:
            target: path, (M, 3) array, `Surface`, or anything with `.points` (and `.normals`) in mm, such as a
                target that another method prepared. Meshes are sampled with 8192 points, always the same ones.
            units: unit of a path or an array, "mm", "cm" or "m".

        Raises:
            InvalidPointCloudError: not a possible target.
            MethodUnavailableError: when the library is missing.
        """
        points, normals = target_points(target, units)
        origin = points.mean(axis=0)
        static = self._prepare(points - origin, normals)
        return BaselineTarget(points, normals, origin, cKDTree(points), self, static)

    def register(self, source: Source, target: Any, initial: ArrayLike | None = None) -> RegistrationResult:
        """Pose of the source in the target's frame.

        Args:
            source: (N, 3) points, mm, or a path or a `Surface`; rows that are not finite are dropped.
            target: from `prepare`; a target that another method prepared is prepared again, outside the times.
            initial: optional (4, 4) seed T_target_source; local methods start there instead of from the centroids,
                global ones ignore it.

        Raises:
            InvalidPointCloudError: source of a wrong shape or type.
        """
        points = finite_points(load(source).points if isinstance(source, str | Path | Surface) else source)
        if len(points) < MIN_SOURCE_POINTS:
            return self.refusal(f"{len(points)} usable points", RegistrationStatus.TOO_FEW_POINTS)
        own = self._own(target)
        start = time.perf_counter()
        try:
            T = self._pose(points, own, initial)
        except NoPose as error:
            return self.refusal(str(error), stage_ms={"align": _ms_since(start)})
        return self.answer(T, points, own, {"align": _ms_since(start)})

    def answer(self, T: Array, source: Array, target: BaselineTarget, stage_ms: dict[str, float]) -> RegistrationResult:
        """Give an accepted pose with its residual and its score."""
        distance, _ = target.tree.query(se3.apply(T, source))
        inliers = float(np.mean(distance < INLIER_MM))
        features = {"residual_mm": truncated_residual(distance)}
        return RegistrationResult(
            RegistrationStatus.OK, T, confidence=inliers, inlier_ratio=inliers, stage_ms=stage_ms, method=self.name,
            features=features, warnings=(uncalibrated(self.name),),
        )  # fmt: skip

    def refusal(
        self,
        reason: str,
        status: RegistrationStatus = RegistrationStatus.LOW_CONFIDENCE,
        stage_ms: dict[str, float] | None = None,
    ) -> RegistrationResult:
        """Give no pose, and the reason."""
        return RegistrationResult(status, method=self.name, reason=reason, stage_ms=stage_ms or {})

    def _own(self, target: Any) -> BaselineTarget:
        if isinstance(target, BaselineTarget) and target.owner is self:
            return target
        cached = getattr(self, "_foreign", None)
        if cached is None or cached[0] is not target:
            self._foreign = (target, self.prepare(target))
        return self._foreign[1]

    def _pose(self, source: Array, target: BaselineTarget, initial: ArrayLike | None) -> Array:
        mean = source.mean(axis=0)
        to_centred, to_target = translation(-mean), translation(target.origin)
        seed = np.eye(4) if initial is None else se3.inverse(to_target) @ np.asarray(initial) @ translation(mean)
        T = self._align(source - mean, target, seed)
        check_rigid(T, self.identity_is_failure)
        return to_target @ se3.nearest_rigid(T) @ to_centred

    @abstractmethod
    def _prepare(self, points: Array, normals: Array | None) -> Any:
        """Library objects of the centred target points (M, 3) and their normals (or None)."""

    @abstractmethod
    def _align(self, source: Array, target: BaselineTarget, seed: Array) -> Array:
        """T (4, 4) between the centred clouds; raises `NoPose` when the library found none."""


def target_points(target: Any, units: str = "mm") -> tuple[Array, Array | None]:
    """(M, 3) points, mm, and (M, 3) normals or None of whatever `prepare` may be given."""
    if not hasattr(target, "points"):
        target = load(target, units)
    if isinstance(target, Surface) and target.faces is not None:
        return target.sample(TARGET_POINTS, np.random.default_rng(0))
    normals = getattr(target, "normals", None)
    return np.array(target.points, dtype=np.float64), None if normals is None else np.array(normals, dtype=np.float64)


def truncated_residual(distance: ArrayLike) -> float:
    """Compute the mean nearest-neighbour distance, mm, each cut off at 5 mm; `Refined` compares poses by it."""
    return float(np.minimum(distance, INLIER_MM).mean())


def check_rigid(T: Array, identity_is_failure: bool) -> None:
    """Raise `NoPose` for the answer of a library that fails in silence: NaN, no rotation, or the identity."""
    if not np.isfinite(T).all():
        raise NoPose("the library returned a pose that is not finite")
    R = T[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > RIGID_TOLERANCE or abs(np.linalg.det(R) - 1.0) > RIGID_TOLERANCE:
        raise NoPose("the library returned a matrix that is not a rigid motion")
    if identity_is_failure and np.abs(T - np.eye(4)).max() < 1e-9:
        raise NoPose("the library returned the identity: it found nothing")


def require(module: str, package: str, method: str) -> ModuleType:
    """Import an optional library.

    Raises:
        MethodUnavailableError: when it is not installed, with the install line.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MethodUnavailableError(
            f"the library {package} for method {method}", str(error), f"run: pip install {package}"
        ) from error


def translation(shift: ArrayLike) -> Array:
    """(4, 4) motion by `shift` (3,), mm."""
    return se3.from_rotation_translation(np.eye(3), shift)


def _ms_since(start: float) -> float:
    return (time.perf_counter() - start) * 1000.0
