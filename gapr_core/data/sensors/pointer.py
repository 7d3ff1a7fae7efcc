"""A tracked pointer: dots and strokes by hand, always a little outside of the bone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.sensors.acquired import Acquired, View, look, smooth_offsets, some
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import log_uniform

Array = NDArray[np.float64]

SHARE = (0.05, 0.35)  # of the surface that is exposed
POINTS = (12, 200)
STROKE_POINTS, STROKE_MM = (8, 40), (15.0, 60.0)
STROKE_WIDTH_MM = 0.8
STANDOFF_MM = (0.0, 1.0)  # ball of the tip, drape, cartilage: constant, outward
CONTACT_MM = (0.0, 0.3)  # scale of the half normal by which the tip is lifted point by point
NOISE_MM = (0.1, 0.5)  # of the tracker, per axis
BIAS_MM = 0.4  # largest smooth bias
ON_TISSUE, TISSUE_MM = 0.06, (1.0, 4.0)  # largest share of points on soft tissue, and how high they lie


def pointer(
    specimen: Specimen, rng: np.random.Generator, points: tuple[int, int] = POINTS, only_dots: bool = False
) -> Acquired:
    """Touch 12 to 200 points in dots and strokes, with a stand-off and a few points on tissue.

    Real digitisers lie .34 to .62 mm outside of the bone on average.

    Args:
        specimen: the bone.
        rng: decides everything.
        points: limits of their number.
        only_dots: no strokes.
    """
    view = look(specimen, SHARE, "seen", 20_000, rng)
    count = round(log_uniform(points, rng))
    in_dots = count if rng.random() < 0.4 or only_dots else round(count * rng.uniform(0.0, 0.8))
    touched = view.only(_touched(view, count, in_dots, rng))
    standoff_mm, contact_mm, noise_mm = rng.uniform(*STANDOFF_MM), rng.uniform(*CONTACT_MM), rng.uniform(*NOISE_MM)
    bias_mm, bias = smooth_offsets(touched.points, BIAS_MM, rng)
    height_mm = standoff_mm + contact_mm * np.abs(rng.normal(size=count)) + bias_mm
    on_tissue = some(rng.uniform(0.0, ON_TISSUE), count, rng)
    height_mm[on_tissue] += rng.uniform(*TISSUE_MM, len(on_tissue))
    measured = touched.points + height_mm[:, None] * touched.outward + rng.normal(0.0, noise_mm, (count, 3))
    parameters = {
        **view.parameters, **bias, "family": "pointer", "noise_mm": noise_mm, "contact_mm": contact_mm, "scale": 1.0,
        "standoff_mm": standoff_mm + contact_mm * np.sqrt(2.0 / np.pi), "outlier_share": len(on_tissue) / count,
    }  # fmt: skip
    return Acquired(measured, parameters)


def _touched(view: View, count: int, in_dots: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of `count` points of the view: dots anywhere, then strokes."""
    touched = list(rng.choice(len(view.points), in_dots))
    while len(touched) < count:
        wanted = min(int(rng.integers(*STROKE_POINTS)), count - len(touched))
        row = stroke(view, STROKE_MM, rng)
        touched.extend(row[np.unique(np.linspace(0, len(row) - 1, wanted).astype(np.intp))])
    return np.array(touched[:count], dtype=np.intp)


def stroke(view: View, length_mm: tuple[float, float], rng: np.random.Generator) -> NDArray[np.intp]:
    """Choose points in a row over the surface, from a random one in a random direction."""
    start, tilt = int(rng.integers(len(view.points))), rng.normal(size=3)
    ahead = tilt - view.outward[start] * (tilt @ view.outward[start])
    ahead /= np.linalg.norm(ahead)
    offsets = view.points - view.points[start]
    across = np.abs(offsets @ np.cross(view.outward[start], ahead))
    along = offsets @ ahead
    near = np.flatnonzero((across < STROKE_WIDTH_MM) & (along >= 0.0) & (along <= rng.uniform(*length_mm)))
    return near[np.argsort(along[near], kind="stable")]
