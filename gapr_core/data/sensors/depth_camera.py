"""A depth camera: one viewpoint, noise along the ray that grows with distance and slant, flying pixels at the rim."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.sensors.acquired import Acquired, View, look, smooth_offsets, towards_viewpoint
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import log_uniform

Array = NDArray[np.float64]

SHARE = (0.08, 0.35)
POINTS = (500, 6000)
DISTANCE_MM = (250.0, 700.0)
NOISE_MM = (0.2, 1.2)  # along the ray, at 500 mm and a right angle
REFERENCE_MM = 500.0
BIAS_MM = 1.0
STEEPEST = 0.15  # cosine of the slant beyond which nothing comes back
FLYING, FLYING_MM, RIM = 0.06, (1.0, 20.0), 0.45  # largest share, distance behind the rim, cosine that is rim


def depth_camera(specimen: Specimen, rng: np.random.Generator) -> Acquired:
    """Draw 500 to 6000 points of one camera's view, as dense as its pixels fall."""
    view = look(specimen, SHARE, "seen", 30_000, rng)
    viewpoint = view.points.mean(axis=0) + rng.uniform(*DISTANCE_MM) * view.towards
    view = view.only(_pixels(specimen, view, viewpoint, rng))
    rays, distance_mm = _rays(view, viewpoint)
    slant = np.einsum("ni,ni->n", view.outward, rays)
    noise_mm = rng.uniform(*NOISE_MM)
    sigma_mm = noise_mm * (distance_mm / REFERENCE_MM) ** 2 / np.sqrt(np.clip(slant, STEEPEST, 1.0))  # Nguyen 2012
    bias_mm, bias = smooth_offsets(view.points, BIAS_MM, rng)
    off_mm = bias_mm + rng.normal(0.0, sigma_mm)  # towards the camera
    flying = rng.random(len(off_mm)) < rng.uniform(0.0, FLYING) * np.where(slant < RIM, 3.0, 0.3)
    off_mm[flying] -= rng.uniform(*FLYING_MM, flying.sum())
    parameters = {
        **view.parameters, **bias, "family": "depth_camera", "noise_mm": float(np.median(sigma_mm)), "scale": 1.0,
        "standoff_mm": 0.0, "outlier_share": float(flying.mean()), "distance_mm": float(distance_mm.mean()),
    }  # fmt: skip
    return Acquired(view.points + off_mm[:, None] * rays, parameters, viewpoint)


def _pixels(specimen: Specimen, view: View, viewpoint: Array, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of visible points, as many in a solid angle wherever it is."""
    rays, distance_mm = _rays(view, viewpoint)
    slant = np.einsum("ni,ni->n", view.outward, rays)
    density = np.clip(slant, 0.0, 1.0) / distance_mm**2
    seen = (slant > STEEPEST) & specimen.visible_from(view.points, rays)
    kept = np.flatnonzero(seen & (rng.random(len(density)) < density / density.max()))
    kept = kept if len(kept) else np.arange(len(view.points))
    return rng.permutation(kept)[: round(log_uniform(POINTS, rng))]


def _rays(view: View, viewpoint: Array) -> tuple[Array, Array]:
    """(N, 3) unit directions to the camera, and (N,) distances."""
    return towards_viewpoint(view.points, viewpoint), np.linalg.norm(view.points - viewpoint, axis=1)
