"""Structured light: a few accurate views, each in rows and in steps of depth, not quite laid on each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gapr_core.data.sensors.acquired import Acquired, View, look, smooth_offsets
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import log_uniform, random_directions

Array = NDArray[np.float64]

SHARE = (0.06, 0.35)
POINTS = (400, 6000)
VIEWS, SPREAD = (1, 4), 0.5  # how many, and how far their directions lie apart (tangent of the angle)
STEEPEST = 0.25  # cosine of the slant beyond which nothing comes back
NOISE_MM = (0.03, 0.25)  # along the view
ROW_MM, ROW_HEIGHT_MM = (0.05, 0.3), (0.4, 1.5)  # error that all points of a row share, and how high a row is
STEP_MM = (0.05, 0.5)  # of depth
VIEW_MM, VIEW_DEG = (0.0, 0.5), (0.0, 0.4)  # standard deviations of how a view lies to the others
BIAS_MM = 0.4


def structured_light(specimen: Specimen, rng: np.random.Generator) -> Acquired:
    """400 to 6000 points of one to four views of the same side."""
    view = look(specimen, SHARE, "seen", 60_000, rng)
    bias_mm, bias = smooth_offsets(view.points, BIAS_MM, rng)
    drawn = {
        "noise_mm": rng.uniform(*NOISE_MM), "row_mm": rng.uniform(*ROW_MM), "step_mm": rng.uniform(*STEP_MM),
        "row_height_mm": rng.uniform(*ROW_HEIGHT_MM), "view_mm": rng.uniform(*VIEW_MM),
        "view_deg": rng.uniform(*VIEW_DEG),
    }  # fmt: skip
    count = int(rng.integers(VIEWS[0], VIEWS[1] + 1))
    each = round(log_uniform(POINTS, rng)) // count
    parts = [_one_view(specimen, view, bias_mm, drawn, each, rng) for _ in range(count)]
    parameters = {**view.parameters, **bias, **drawn, "family": "structured_light", "views": count, "scale": 1.0,
                  "standoff_mm": 0.0, "outlier_share": 0.0}  # fmt: skip
    return Acquired(np.concatenate(parts), parameters)


def _one_view(
    specimen: Specimen, view: View, bias_mm: Array, drawn: dict[str, float], most: int, rng: np.random.Generator
) -> Array:
    towards = view.towards + SPREAD * rng.random() * random_directions(1, rng)[0]
    towards /= np.linalg.norm(towards)
    seen = (view.outward @ towards > STEEPEST) & specimen.visible_from(view.points, towards)
    seen = rng.permutation(np.flatnonzero(seen) if seen.any() else np.arange(len(view.points)))[:most]
    points = view.points[seen]
    up = np.cross(towards, random_directions(1, rng)[0])
    row = np.floor(points @ (up / np.linalg.norm(up)) / drawn["row_height_mm"]).astype(int)
    of_row = rng.normal(0.0, drawn["row_mm"], np.ptp(row) + 1)[row - row.min()]
    depth_mm = points @ towards
    measured = depth_mm + bias_mm[seen] + of_row + rng.normal(0.0, drawn["noise_mm"], len(points))
    measured = np.round(measured / drawn["step_mm"]) * drawn["step_mm"]
    points = points + np.outer(measured - depth_mm, towards)
    centre = points.mean(axis=0)
    turn = Rotation.from_rotvec(np.radians(rng.normal(0.0, drawn["view_deg"], 3)))
    return np.asarray(turn.apply(points - centre) + centre + rng.normal(0.0, drawn["view_mm"], 3))
