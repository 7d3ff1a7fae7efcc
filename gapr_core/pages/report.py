"""Pages that open anywhere: one HTML file with tables and 3-D views that can be turned, no network; and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.clouds import Surface

Array = NDArray[np.float64]

TEMPLATE = Path(__file__).with_name("templates") / "report.html"
BONE_COLOUR = "#eadfc8"
WORST_SHOWN_MM = 5.0  # where the colours of distances end


class Report:
    """A page that is put together piece by piece, then written.

    Args:
        title: the heading.
        lead: one or two sentences under it.
    """

    def __init__(self, title: str, lead: str = "") -> None:
        self.title, self.lead = title, lead
        self._parts: list[str] = []
        self._has_plotly = False

    def heading(self, text: str) -> None:
        """A section begins."""
        self._parts.append(f"<h2>{escape(text)}</h2>")

    def paragraph(self, text: str) -> None:
        """Plain text."""
        self._parts.append(f"<p>{escape(text)}</p>")

    def facts(self, values: Mapping[str, str]) -> None:
        """What matters most, as big figures: name to value."""
        tiles = (f'<div class="fact"><b>{escape(v)}</b><span>{escape(k)}</span></div>' for k, v in values.items())
        self._parts.append(f'<div class="facts">{"".join(tiles)}</div>')

    def table(
        self, columns: Sequence[str], rows: Sequence[Sequence[str]], marks: Sequence[str] = (), text: Sequence[str] = ()
    ) -> None:
        """A table of strings.

        Args:
            columns: the headings.
            rows: the cells, row by row.
            marks: for each row "ok", "hold", "bad" or "": its colour.
            text: the columns that hold words; the others are set to the right.
        """
        classes = [' class="text"' if name in text else "" for name in columns]
        head = "".join(f"<th{c}>{escape(name)}</th>" for name, c in zip(columns, classes, strict=True))
        body = "".join(
            f'<tr class="{mark}">{"".join(f"<td{c}>{escape(v)}</td>" for v, c in zip(row, classes, strict=True))}</tr>'
            for row, mark in zip(rows, marks or [""] * len(rows), strict=True)
        )
        html = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        self._parts.append(f'<div class="table">{html}</div>')

    def figure(self, figure: Any) -> None:
        """A plotly figure; its JavaScript is written into the page once."""
        html = figure.to_html(full_html=False, include_plotlyjs=not self._has_plotly, config={"displaylogo": False})
        self._has_plotly = True
        self._parts.append(f'<div class="figure">{html}</div>')

    def write(self, path: str | Path) -> None:
        """One self-contained HTML file."""
        page = Template(TEMPLATE.read_text(encoding="utf-8"))
        text = page.substitute(title=escape(self.title), lead=escape(self.lead), body="\n".join(self._parts))
        Path(path).write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class Step:
    """One state of a 3-D view: points laid on the target, or none.

    Attributes:
        label: what the slider shows.
        caption: one line above the view.
        points: (N, 3) mm in the target's frame; empty when there is no pose.
        distances_mm: (N,) distance of each point to the target's surface.
    """

    label: str
    caption: str
    points: Array
    distances_mm: Array


def alignment_figure(target: Surface, steps: Sequence[Step], shown: int = -1) -> Any:
    """A plotly figure: the target and on it the points of one step, coloured by distance; a slider chooses the step."""
    import plotly.graph_objects as go

    shown = range(len(steps))[shown]
    clouds = [_cloud_trace(step, visible=k == shown) for k, step in enumerate(steps)]
    figure = go.Figure([_target_trace(target), *clouds])
    choices = [
        {
            "method": "update",
            "label": step.label,
            "args": [{"visible": [True, *(k == chosen for k in range(len(steps)))]}, {"title.text": step.caption}],
        }
        for chosen, step in enumerate(steps)
    ]
    hidden = {"visible": False}
    slider = {"active": shown, "steps": choices, "currentvalue": {"prefix": "frame "}, "pad": {"t": 0, "b": 40}}
    figure.update_layout(
        title={"text": steps[shown].caption, "font": {"size": 15}, "x": 0.02},
        height=600,
        margin={"l": 0, "r": 0, "t": 44, "b": 0},
        showlegend=False,
        sliders=[slider] if len(steps) > 1 else [],
        scene={"xaxis": hidden, "yaxis": hidden, "zaxis": hidden, **_camera(target)},
    )
    return figure


def _camera(target: Surface) -> dict[str, Any]:
    """From the front (-y), a long bone lying across, as large as the page allows; true proportions."""
    size = np.ptp(target.points, axis=0)
    lies = size[2] > 1.5 * size[0]
    up = {"x": -1, "y": 0, "z": 0} if lies else {"x": 0, "y": 0, "z": 1}
    ratio = size * (4.2 / size[2] if lies else 2.0 / size[[0, 2]].max())
    camera = {"eye": {"x": 0.15, "y": -1.2, "z": 0.15}, "up": up, "projection": {"type": "orthographic"}}
    return {"aspectmode": "manual", "aspectratio": dict(zip("xyz", ratio.tolist(), strict=True)), "camera": camera}


def _target_trace(target: Surface) -> Any:
    import plotly.graph_objects as go

    x, y, z = target.points.astype(np.float32).T
    if target.faces is None:
        return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker={"size": 1.5, "color": BONE_COLOUR}, hoverinfo="skip")
    i, j, k = target.faces.astype(np.int32).T
    lighting = {"ambient": 0.5, "diffuse": 0.7, "specular": 0.1, "roughness": 0.8}
    light = {"x": 1.0, "y": 3.0, "z": -10.0}  # in view coordinates: from the eye, a little from above
    mesh = {"x": x, "y": y, "z": z, "i": i, "j": j, "k": k}
    return go.Mesh3d(**mesh, color=BONE_COLOUR, lighting=lighting, lightposition=light, hoverinfo="skip")


def _cloud_trace(step: Step, visible: bool) -> Any:
    import plotly.graph_objects as go

    x, y, z = step.points.reshape(-1, 3).astype(np.float32).T
    bar = {"title": {"text": "distance to the bone, mm", "side": "right"}, "len": 0.7}
    colours = {"colorscale": "Turbo", "cmin": 0.0, "cmax": WORST_SHOWN_MM, "colorbar": bar}
    marker = {"size": 2.5, "color": step.distances_mm.astype(np.float32), **colours}
    hover = "%{marker.color:.2f} mm off<extra></extra>"
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, visible=visible, hovertemplate=hover)


def timeline_figure(
    x: Sequence[float], curves: Mapping[str, Sequence[float]], x_title: str, limits: Mapping[str, float]
) -> Any:
    """Small charts under each other, one a curve, all over the same x; a dashed line where there is a limit."""
    from plotly.subplots import make_subplots

    figure = make_subplots(rows=len(curves), cols=1, shared_xaxes=True, vertical_spacing=0.06)
    for row, (name, values) in enumerate(curves.items(), start=1):
        figure.add_scatter(x=list(x), y=list(values), mode="lines+markers", name=name, row=row, col=1)
        figure.update_yaxes(title_text=name, rangemode="tozero", row=row, col=1)
        if name in limits:
            figure.add_hline(y=limits[name], line_dash="dash", line_color="#999", row=row, col=1)
    figure.update_xaxes(title_text=x_title, row=len(curves), col=1)
    figure.update_layout(height=170 * len(curves) + 60, showlegend=False, template="plotly_white")
    figure.update_layout(margin={"t": 20, "r": 20})
    return figure
