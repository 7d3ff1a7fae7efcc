"""Pictures of a camera's view, and of points taken for bone: for a page, and as one poster."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.scenes.figure import BONE, OTHER, paint
from gapr_core.pages.poster import draw_bone, draw_chart
from gapr_core.pages.views import as_png
from gapr_core.surface import Surface

Array = NDArray[np.float64]
NOT_LOOKED_AT = np.array([0.72, 0.75, 0.78])
KEY = "light: taken for bone, red: looked at and not taken, grey: not looked at"
POSTER_VIEWS = 5


@dataclass(frozen=True, eq=False)
class CameraView:
    """One image.

    Attributes:
        title: the line above.
        cloud: (N, 3) mm, in the camera's own frame.
        looked_at: (N,) which points the registration looked at; the others lay outside of its region of interest.
        is_taken: (N,) which of these it took for bone.
    """

    title: str
    cloud: Array
    looked_at: NDArray[np.bool_]
    is_taken: NDArray[np.bool_]


def views_as_png(views: Sequence[CameraView], columns: int = 4) -> bytes:
    """Draw all images in rows, as a PNG."""
    rows = -(-len(views) // columns)
    figure = _figure(2.6 * columns, 2.75 * rows)
    _draw_views(figure, views, rows, columns)
    return as_png(figure)


def save_scene_poster(
    path: str | Path,
    target: Surface,
    views: Sequence[CameraView],
    points: Array,
    distances_mm: Array,
    title: str,
    charts: Mapping[str, tuple[Sequence[float], float | None]],
    facing: Array | None = None,
) -> None:
    """Writes a PNG: some of the images, the bone with the points taken for it in one of them, and charts.

    Args:
        path: where to.
        target: the bone, mm.
        views: every image, in the order of time.
        points: (N, 3) mm in the target's frame, laid on it.
        distances_mm: (N,) their signed distances from the surface; NaN for points not taken for bone.
        title: the line above.
        charts: name to (values, limit); not finite where there is no value.
        facing: (3,) direction in the target's frame to the camera; from the front where it is None.
    """
    figure = _figure(11.0, 7.2)
    figure.suptitle(title, fontsize=13)
    above, below = figure.subfigures(2, 1, height_ratios=[1.0, 1.7])
    bone, right = below.subfigures(1, 2)
    count = min(POSTER_VIEWS, len(views))
    chosen = np.linspace(0, len(views) - 1, count).round().astype(int)
    _draw_views(above, [views[k] for k in chosen], 1, count)
    above.supxlabel(KEY, fontsize=9)
    is_taken = np.isfinite(distances_mm)
    draw_bone(bone, target, points[is_taken], distances_mm[is_taken], facing)
    all_axes = np.ravel(right.subplots(-(-len(charts) // 2), 2))
    for axes, (name, (values, limit)) in zip(all_axes, charts.items(), strict=False):
        draw_chart(axes, name, values, limit, "frame")
    figure.savefig(path)  # in all colours: few of them would leave steps in the bar


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _draw_views(figure: Any, views: Sequence[CameraView], rows: int, columns: int) -> None:
    all_axes = np.ravel(figure.subplots(rows, columns))
    for axes, view in zip(all_axes, views, strict=False):
        colours = np.where(view.looked_at[:, None], OTHER, NOT_LOOKED_AT)
        paint(axes, view.cloud, np.zeros(3), np.where(view.is_taken[:, None], BONE, colours))
        axes.set_title(view.title, fontsize=8)
    for axes in all_axes[len(views) :]:
        axes.axis("off")
