"""A 3-D view of a probe that follows the guidance: look by look the bone coloured by gain, and where to go next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.pages.report import view_layout
from gapr_core.surface import Surface

Array = NDArray[np.float64]
COLOURS = [[0.0, "#eadfc8"], [0.5, "#f2a541"], [1.0, "#7a1fa2"]]  # bone, then ever more to gain


@dataclass(frozen=True, eq=False)
class GuidedStep:
    """What is known after a look.

    Attributes:
        label: what the slider shows.
        caption: one line above the view.
        points: (N, 3) mm in the target's frame, all looks so far.
        newest: how many of them, at the end, are of the last look.
        advice: points of the target (M, 3) mm, what a look at each would gain (M,) mm, and the middle (3,) of the best
            look; None where there is no advice.
    """

    label: str
    caption: str
    points: Array
    newest: int
    advice: tuple[Array, Array, Array] | None


def guidance_figure(target: Surface, steps: Sequence[GuidedStep], facing: Array | None = None) -> Any:
    """A plotly figure with a slider over the looks; the first one is shown.

    `facing` is the direction (3,) in the target's frame from which the view begins; from the front where it is None.
    """
    import plotly.graph_objects as go

    traces = [trace for k, step in enumerate(steps) for trace in _traces(target, step, visible=k == 0)]
    each = len(traces) // len(steps)
    figure = go.Figure(traces)
    choices = [
        (step.label, np.repeat(np.arange(len(steps)) == k, each).tolist(), step.caption) for k, step in enumerate(steps)
    ]
    figure.update_layout(**view_layout(target, choices, 0, "look ", facing))
    return figure


def gain_at(target: Surface, step: GuidedStep) -> Array:
    """(V,) the gain at every vertex of the target, mm: that of the nearest point of the advice; 0 without any."""
    if step.advice is None:
        return np.zeros(len(target.points))
    points, gain_mm, _ = step.advice
    return gain_mm[cKDTree(points).query(target.points)[1]]


def _traces(target: Surface, step: GuidedStep, visible: bool) -> list[Any]:
    old, new = np.split(step.points, [len(step.points) - step.newest])
    best = np.zeros((0, 3)) if step.advice is None else step.advice[2][None]
    return [
        _bone(target, gain_at(target, step), visible),
        _dots(old, "#1d2733", 2.0, visible),
        _dots(new, "#d62728", 3.0, visible),
        _dots(best, "#12a150", 11.0, visible),
    ]


def _bone(target: Surface, gain_mm: Array, visible: bool) -> Any:
    import plotly.graph_objects as go

    x, y, z = target.points.astype(np.float32).T
    bar = {"title": {"text": "gain of a look, mm", "side": "right"}, "len": 0.7}
    shade = {"colorscale": COLOURS, "cmin": 0.0, "cmax": max(1e-3, float(gain_mm.max())), "colorbar": bar}
    if target.faces is None:
        marker = {"size": 1.5, "color": gain_mm.astype(np.float32), **shade}
        return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, visible=visible, hoverinfo="skip")
    i, j, k = target.faces.astype(np.int32).T
    mesh = {"x": x, "y": y, "z": z, "i": i, "j": j, "k": k, "intensity": gain_mm.astype(np.float32)}
    lighting = {"ambient": 0.7, "diffuse": 0.5, "specular": 0.0}
    hover = "%{intensity:.1f} mm to gain<extra></extra>"
    return go.Mesh3d(**mesh, **shade, lighting=lighting, visible=visible, hovertemplate=hover)


def _dots(points: Array, colour: str, size: float, visible: bool) -> Any:
    import plotly.graph_objects as go

    x, y, z = points.astype(np.float32).T
    marker = {"size": size, "color": colour}
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, visible=visible, hoverinfo="skip")
