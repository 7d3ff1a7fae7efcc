"""The cloud of every simulator, and the view of the bone from which it starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.data import views
from gapr_core.data.smooth_bias import SMOOTH_BIASES
from gapr_core.data.specimen import Specimen

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Acquired:
    """A simulated acquisition.

    Attributes:
        points: (N, 3) mm, in the frame of the bone.
        parameters: what was drawn: `family`, `noise_mm`, `bias_mm`, `outlier_share`, `standoff_mm` (mean offset out of
            the bone), `scale` (1 is true to size), and what the family has of its own.
        viewpoint: (3,) mm, in the frame of the bone: where a camera stands; None without a viewpoint.
    """

    points: Array
    parameters: dict[str, Any]
    viewpoint: Array | None = None


@dataclass(frozen=True, eq=False)
class View:
    """The side of a bone that a sensor looks at.

    Attributes:
        points: (N, 3) surface points, mm, in the frame of the bone.
        outward: (N, 3) unit normals on the sensor's side.
        towards: (3,) unit direction from the bone to the sensor.
        parameters: `share` of the surface, `overlap` and so on, as `views.best_view` reports them.
    """

    points: Array
    outward: Array
    towards: Array
    parameters: dict[str, Any]

    def only(self, chosen: NDArray[Any]) -> View:
        """Keep some points of the view, by mask or index."""
        return View(self.points[chosen], self.outward[chosen], self.towards, self.parameters)


def look(specimen: Specimen, share: tuple[float, float], share_of: str, draws: int, rng: np.random.Generator) -> View:
    """Draw a one-sided view of a `share` of the surface (see `views.best_view`), densely sampled."""
    points, normals, parameters = views.best_view(specimen, share, share_of, rng, draws)
    towards = np.asarray(parameters["view_direction"])
    side = np.where(normals @ towards < 0.0, -1.0, 1.0)
    return View(points, normals * side[:, None], towards, parameters)


def tangents(view: View) -> tuple[Array, Array]:
    """Two unit directions (3,) across the look: along the longer extent of the seen points, and across it."""
    flat = view.points - view.points.mean(axis=0)
    flat = flat - np.outer(flat @ view.towards, view.towards)
    along = np.linalg.eigh(flat.T @ flat)[1][:, 2]
    return along, np.cross(view.towards, along)


def smooth_offsets(points: Array, most_mm: float, rng: np.random.Generator) -> tuple[Array, dict[str, Any]]:
    """Draw (N,) offsets, mm, of a smooth bias up to `most_mm`, with its name and size."""
    name, size_mm = str(rng.choice(list(SMOOTH_BIASES))), float(rng.uniform(0.0, most_mm))
    return SMOOTH_BIASES[name](points, size_mm, rng), {"bias": name, "bias_mm": size_mm}


def some(share: float, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Indices of a random `share` of `count` points."""
    return rng.permutation(count)[: round(share * count)]


def towards_viewpoint(points: Array, viewpoint: Array) -> Array:
    """(N, 3) unit directions from points (N, 3) to a viewpoint (3,)."""
    rays = viewpoint - points
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
