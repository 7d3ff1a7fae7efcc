"""A hand-held laser scanner: stripes of accurate points, where both the emitter and the camera see the bone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.sensors.acquired import Acquired, View, look, smooth_offsets, some, tangents, towards_viewpoint
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import log_uniform

Array = NDArray[np.float64]

SHARE = (0.08, 0.4)
POINTS = (400, 6000)
DISTANCE_MM, BASELINE_MM = (150.0, 350.0), (50.0, 150.0)
STRIPE_MM, STRIPE_SHARE = (1.0, 4.0), 0.3  # from stripe to stripe, and how much of it is lit
STEEPEST = 0.3
NOISE_MM = (0.03, 0.25)  # along the ray
SCALE = 0.002  # standard deviation of the relative error of the size
BIAS_MM = 0.3
OUTLIERS, OUTLIER_MM = 0.02, (1.0, 8.0)  # wet bone throws reflections


def laser(specimen: Specimen, rng: np.random.Generator) -> Acquired:
    """400 to 6000 points in stripes, a few of them reflections, with a small error of the size."""
    view = look(specimen, SHARE, "seen", 60_000, rng)
    viewpoint = view.points.mean(axis=0) + rng.uniform(*DISTANCE_MM) * view.towards
    view = view.only(_lit(specimen, view, viewpoint, rng))
    rays = towards_viewpoint(view.points, viewpoint)
    noise_mm, scale = rng.uniform(*NOISE_MM), 1.0 + rng.normal(0.0, SCALE)
    bias_mm, bias = smooth_offsets(view.points, BIAS_MM, rng)
    off_mm = bias_mm + rng.normal(0.0, noise_mm, len(rays))
    off = some(rng.uniform(0.0, OUTLIERS), len(rays), rng)
    off_mm[off] += rng.choice([-1.0, 1.0], len(off)) * rng.uniform(*OUTLIER_MM, len(off))
    centre = view.points.mean(axis=0)
    points = centre + scale * (view.points - centre) + off_mm[:, None] * rays
    parameters = {
        **view.parameters, **bias, "family": "laser", "noise_mm": noise_mm, "scale": scale, "standoff_mm": 0.0,
        "outlier_share": len(off) / len(rays),
    }  # fmt: skip
    return Acquired(points, parameters, viewpoint)


def _lit(specimen: Specimen, view: View, viewpoint: Array, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of the points in stripes that emitter and camera, a baseline apart, both see."""
    along, across = tangents(view)
    emitter = viewpoint + rng.uniform(*BASELINE_MM) * across
    seen = np.ones(len(view.points), dtype=bool)
    for eye in (viewpoint, emitter):
        rays = towards_viewpoint(view.points, eye)
        seen &= (np.einsum("ni,ni->n", view.outward, rays) > STEEPEST) & specimen.visible_from(view.points, rays)
    in_stripe = np.mod(view.points @ along / rng.uniform(*STRIPE_MM), 1.0) < STRIPE_SHARE
    lit = np.flatnonzero(seen & in_stripe)
    lit = lit if len(lit) else np.arange(len(view.points))
    return rng.permutation(lit)[: round(log_uniform(POINTS, rng))]
