"""Wounds as a stereo camera sees them, and bones under layers: errors beyond `camera.measured`.

A stereo camera matches depth over windows, so ridges are round, and near pixels err alike. Along edges pixels fly
between front and back. Wet spots give nothing. Depth comes in steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.data.scenes.camera import NOTHING, View, noise_mm, seen_in_depth
from gapr_core.data.sensors import acquired, depth_maps
from gapr_core.data.sensors.covered import layers
from gapr_core.geometry.sampling import log_uniform

Array = NDArray[np.float64]
WINDOW_MM = (1.0, 3.0)  # standard deviation of the window over which depth is matched
PATCHY = (0.3, 0.9)  # share of the noise's variance that is alike in a window
STEP_MM = (0.05, 0.5)  # of depth
EDGE_MM, NEIGHBOURS = 8.0, 7  # a step between a pixel's neighbours that is an edge, and how many neighbours there are
FLYING = (0.0, 0.6)  # share of the pixels at an edge that fly
SMOOTH_MM = 0.6  # largest smooth error
NOISIER, WIDER_MM = (1.0, 2.5), (1.0, 5.0)  # of a poor camera: times the noise, and windows
WET, WET_MM = (0, 6), (2.0, 8.0)  # spots that give nothing: how many, and their radius


def seen_in_stereo(view: View, rng: np.random.Generator) -> View:
    """Turn a view into that of a stereo camera: fewer points, with errors; flying ones are on no surface."""
    return _in_stereo(view, rng, 1.0, WINDOW_MM)


def seen_by_a_poor_camera(view: View, rng: np.random.Generator) -> View:
    """As in stereo, with .6 to 1.6 mm of noise that is alike over up to 5 mm: of small, moving or wet scenes."""
    times = log_uniform(NOISIER, rng)
    return _in_stereo(view, rng, times, WIDER_MM)


def _in_stereo(view: View, rng: np.random.Generator, times: float, windows_mm: tuple[float, float]) -> View:
    """With `times` the noise of `camera.noise_mm`, alike within a window of a size between `windows_mm`."""
    view = view.of(_dry(view, rng))
    sight = view.points - view.camera
    depth_mm = np.linalg.norm(sight, axis=1)
    sight /= depth_mm[:, None]
    towards = -sight.mean(axis=0) / np.linalg.norm(sight.mean(axis=0))
    over = depth_maps.windows(acquired.View(view.points, -sight, towards, {}), rng.uniform(*windows_mm))
    patchy = rng.uniform(*PATCHY)
    noise = over.patchy(np.sqrt(patchy), rng) + np.sqrt(1.0 - patchy) * rng.normal(size=len(depth_mm))
    smooth_mm, _ = acquired.smooth_offsets(view.points, SMOOTH_MM, rng)
    flies, between_mm = _flying(depth_mm, sight, rng)
    measured = np.where(flies, between_mm, over.mean(depth_mm) + smooth_mm + times * noise * noise_mm(depth_mm))
    step = rng.uniform(*STEP_MM)
    points = view.camera + (np.round(measured / step) * step)[:, None] * sight
    return replace(view, points=points, part=np.where(flies, NOTHING, view.part))


def seen_on_layers(view: View, rng: np.random.Generator) -> View:
    """Put the bone under layers, with the errors of `camera.measured`."""
    return seen_in_depth(under_layers([view], rng)[0], rng)


def seen_in_theatre(view: View, rng: np.random.Generator) -> View:
    """Put the bone under layers before a stereo camera whose range is about 1 % wrong."""
    view = seen_in_stereo(under_layers([view], rng)[0], rng)
    seen = depth_maps.wrong_range(view.points, rng)
    return replace(view, points=seen.of(view.points), camera=seen.of(view.camera))


def under_layers(views: Sequence[View], rng: np.random.Generator) -> list[View]:
    """Put the same layers on the bone in all views of it: one to three of up to 4 mm, towards the camera."""
    bone = [np.flatnonzero(view.part == 0) for view in views]
    above_mm = layers(np.concatenate([view.points[of] for view, of in zip(views, bone, strict=True)]), rng)
    of_each = np.split(above_mm, np.cumsum([len(of) for of in bone])[:-1])
    return [_raised(view, of, mm) for view, of, mm in zip(views, bone, of_each, strict=True)]


def _raised(view: View, some: NDArray[np.intp], above_mm: Array) -> View:
    points = view.points.copy()
    sight = points[some] - view.camera
    points[some] -= above_mm[:, None] * sight / np.linalg.norm(sight, axis=1, keepdims=True)
    return replace(view, points=points)


def _dry(view: View, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(N,) which points are not in a wet spot."""
    dry = np.ones(len(view.points), dtype=bool)
    for middle in rng.integers(len(dry), size=int(rng.integers(WET[0], WET[1] + 1))):
        dry &= np.linalg.norm(view.points - view.points[middle], axis=1) > rng.uniform(*WET_MM)
    return dry


def _flying(depth_mm: Array, sight: Array, rng: np.random.Generator) -> tuple[NDArray[np.bool_], Array]:
    """(N,) which pixels fly, and (N,) a depth between the nearest and the farthest one around each."""
    around = depth_mm[cKDTree(sight).query(sight, k=min(NEIGHBOURS, len(sight)))[1]].reshape(len(sight), -1)
    near, far = around.min(axis=1), around.max(axis=1)
    flies = (far - near > EDGE_MM) & (rng.random(len(sight)) < rng.uniform(*FLYING))
    return flies, near + rng.random(len(sight)) * (far - near)
