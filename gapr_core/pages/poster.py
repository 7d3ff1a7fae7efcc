"""One picture for a page or a README: the bone with the points on it, and how the registration went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.picture import shade
from gapr_core.pages.report import level
from gapr_core.surface import Surface

Array = NDArray[np.float64]

LYING = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # a long bone from above: z runs to the left
MM_PER_PIXEL = 0.35


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
        distances_mm: (N,) their distances from the surface.
        title: the line above.
        charts: name to (values, limit): small charts under the bone; not finite where there is no value.
        x_title: what the charts run over, counted from 1.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

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
    """The bone, a long one lying, with points on it that are coloured by their distance, seen as `level` says."""
    size, (x, y) = np.ptp(target.points, axis=0), level(facing)
    to_front = np.array([[-y, x, 0.0], [-x, -y, 0.0], [0.0, 0.0, 1.0]])
    turn = (LYING if size[2] > 1.5 * size[0] else np.eye(3)) @ to_front
    turned = replace(target, points=target.points @ turn.T, normals=None)
    low, high = turned.points.min(axis=0) - 8.0, turned.points.max(axis=0) + 8.0
    axes = figure.subplots()
    extent = (low[0], high[0], low[2], high[2])
    axes.imshow(shade(turned, "anterior", MM_PER_PIXEL), extent=extent, interpolation="bilinear")
    across, _, up = (points @ turn.T).T
    dots = axes.scatter(across, up, c=distances_mm, s=2.5, cmap="turbo", vmin=0.0, vmax=5.0, linewidths=0)
    figure.colorbar(dots, ax=axes, label="distance to the bone, mm", shrink=0.8)
    axes.set(xlim=(low[0], high[0]), ylim=(low[2], high[2]), aspect="equal")
    axes.axis("off")


def draw_chart(axes: Any, name: str, values: Sequence[float], limit: float | None, x_title: str) -> None:
    """One curve over the frames, counted from 1, with a dashed line at the limit."""
    axes.plot(np.arange(1, len(values) + 1), values, "o-", color="#1f5fa8", markersize=4, linewidth=1.2)
    if limit is not None:
        axes.axhline(limit, color="0.5", linestyle="--", linewidth=1.0)
    axes.set(title=name, xlabel=x_title, xlim=(0.5, len(values) + 0.5))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
