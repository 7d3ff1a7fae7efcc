"""A pointer that is dragged over the bone and read all the time: dense strokes whose samples err alike.

Only the sampling differs from dots: the tracker is read at 20 to 60 Hz. So a second of one contact counts as dozens of
points, and the tip is lifted for a while, not point by point. An error of the tip's calibration shifts the whole cloud;
no residual shows it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gapr_core.data.sensors.acquired import Acquired, View, look, smooth_offsets
from gapr_core.data.sensors.pointer import stroke
from gapr_core.data.specimen import Specimen
from gapr_core.geometry.sampling import log_uniform

Array = NDArray[np.float64]

SHARE = (0.05, 0.35)  # of the surface that is exposed
POINTS = (300, 4000)
STROKE_MM, SPACING_MM = (15.0, 100.0), (0.15, 1.0)  # between samples: the speed of the hand over the tracker's rate
STANDOFF_MM = (0.0, 1.0)  # ball of the tip, drape, cartilage: constant, outward
LIFT_MM, LIFT_SAMPLES = (0.0, 0.4), (5.0, 40.0)  # scale of the half normal of the lift, and for how long it lasts
NOISE_MM = (0.05, 0.35)  # of the tracker, per axis and sample
TIP_MM, GRIP_DEG = (0.0, 0.3), (0.0, 20.0)  # standard deviations: of the tip's calibration per axis, of the attitude
BIAS_MM = 0.4  # largest smooth bias
IN_THE_AIR, AIR_MM = 0.06, (1.0, 15.0)  # largest share of samples on tissue or between strokes, and how high they lie
RUN = 20  # samples of such a run


def tracing(specimen: Specimen, rng: np.random.Generator) -> Acquired:
    """Drag strokes of 300 to 4000 samples over 5 to 35 % of the surface, shifted with the tip."""
    view = look(specimen, SHARE, "seen", 60_000, rng)
    count = round(log_uniform(POINTS, rng))
    chosen, of_stroke = _strokes(view, count, rng.uniform(*SPACING_MM), rng)
    touched = view.only(chosen)
    standoff_mm, lift_mm, noise_mm = rng.uniform(*STANDOFF_MM), rng.uniform(*LIFT_MM), rng.uniform(*NOISE_MM)
    bias_mm, bias = smooth_offsets(touched.points, BIAS_MM, rng)
    lifted_mm = lift_mm * np.abs(_slow(rng.normal(size=count), rng.uniform(*LIFT_SAMPLES)))
    in_the_air = _runs(rng.uniform(0.0, IN_THE_AIR), count, rng)
    height_mm = standoff_mm + lifted_mm + bias_mm
    height_mm[in_the_air] += rng.uniform(*AIR_MM, np.count_nonzero(in_the_air))
    tip_mm, grip_deg = rng.normal(0.0, rng.uniform(*TIP_MM), 3), rng.uniform(*GRIP_DEG)
    grips = Rotation.from_rotvec(np.radians(rng.normal(0.0, grip_deg, (of_stroke.max() + 1, 3))))
    shift = grips[of_stroke].apply(tip_mm)
    measured = touched.points + height_mm[:, None] * touched.outward + shift + rng.normal(0.0, noise_mm, (count, 3))
    parameters = {
        **view.parameters, **bias, "family": "tracing", "noise_mm": noise_mm, "lift_mm": lift_mm, "scale": 1.0,
        "standoff_mm": standoff_mm + lift_mm * float(np.sqrt(2.0 / np.pi)),
        "outlier_share": float(in_the_air.mean()),
        "tip_mm": float(np.linalg.norm(tip_mm)), "strokes": len(grips),
    }  # fmt: skip
    return Acquired(measured, parameters)


def _strokes(view: View, count: int, spacing_mm: float, rng: np.random.Generator) -> tuple[NDArray[np.intp], ...]:
    """(count,) indices of the points of the view that are touched, in order, and (count,) numbers of their strokes."""
    touched: list[int] = []
    of_stroke: list[int] = []
    for number in range(count):
        row = stroke(view, STROKE_MM, rng)
        samples = max(round(float(np.ptp(view.points[row], axis=0).max()) / spacing_mm), 1)
        touched += row[np.linspace(0, len(row) - 1, samples).astype(np.intp)].tolist()
        of_stroke += [number] * samples
        if len(touched) >= count:
            break
    return np.array(touched[:count], dtype=np.intp), np.array(of_stroke[:count], dtype=np.intp)


def _slow(white: Array, samples: float) -> Array:
    """White noise (N,) averaged over about so many samples, of variance 1."""
    slow = gaussian_filter1d(white, samples)
    return np.asarray(slow / max(float(np.sqrt((slow**2).mean())), 1e-9))


def _runs(share: float, count: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Mask (count,) of about that share, in runs of `RUN` samples."""
    starts = rng.random(count) < share / RUN
    return np.asarray(np.convolve(starts, np.ones(RUN))[:count] > 0.0)
