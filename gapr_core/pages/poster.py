"""One picture for a page or a README: the bone with the points on it, and how the registration went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from gapr_core.pages import palette, views
from gapr_core.pages.views import OnBone
from gapr_core.surface import Surface

Array = NDArray[np.float64]
NOWHERE = np.zeros((0, 3))


def save_poster(
    path: str | Path,
    target: Surface,
    points: Array,
    distances_mm: Array,
    title: str,
    charts: Mapping[str, tuple[Sequence[float], float | None]],
    x_title: str = "frame",
) -> None:
    """Writes a PNG.

    Args:
        path: where to.
        target: the bone, mm.
        points: (N, 3) mm in the target's frame, laid on it.
        distances_mm: (N,) their signed distances from the surface.
        title: the line above.
        charts: name to (values, limit): small charts under the bone; not finite where there is no value.
        x_title: unit of the charts' x axis, counted from 1.
    """
    figure = Figure(figsize=(11.0, 6.2), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=13)
    rows: Any = figure.subfigures(2, 1, height_ratios=[1.15, 1.0])
    bone, below = rows
    draw_bone(bone, target, points, distances_mm)
    all_axes = np.ravel(below.subplots(1, len(charts)))
    for axes, (name, (values, limit)) in zip(all_axes, charts.items(), strict=True):
        draw_chart(axes, name, values, limit, x_title)
    figure.savefig(path)


def draw_bone(figure: Any, target: Surface, points: Array, distances_mm: Array, facing: Array | None = None) -> None:
    """Draw points on the bone by signed distance, seen from `facing` (3,) or the best side."""
    on = OnBone(target, points, distances_mm, NOWHERE)
    axes = figure.subplots()
    dots = views.paint(axes, on, views.picture_of(on, on.side_facing(facing)))
    figure.colorbar(dots, ax=axes, label="distance to the bone, mm", shrink=0.8, panchor=False)


def charts_as_png(charts: Mapping[str, tuple[Sequence[float], float | None]], x_title: str) -> bytes:
    """Small charts beside each other as a PNG: name to (values, limit); not finite where there is no value."""
    figure = Figure((2.6 * len(charts), 2.4), views.DPI, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, (values, limit)) in zip(np.ravel(figure.subplots(1, len(charts))), charts.items(), strict=True):
        draw_chart(axes, name, values, limit, x_title)
    return views.as_png(figure)


def draw_chart(axes: Any, name: str, values: Sequence[float], limit: float | None, x_title: str) -> None:
    """Draw one curve over the frames, counted from 1, with a dashed line at the limit."""
    axes.plot(np.arange(1, len(values) + 1), values, "o-", color=palette.FIRST, markersize=4, linewidth=1.2)
    if limit is not None:
        axes.axhline(limit, color="0.5", linestyle="--", linewidth=1.0)
    axes.set_title(name, fontsize=10)
    axes.set(xlabel=x_title, xlim=(0.5, len(values) + 0.5))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
