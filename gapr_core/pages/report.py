"""Pages that open anywhere: one HTML file with tables and 3-D views that can be turned, no network; and pictures."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.pages import palette
from gapr_core.runtime import files
from gapr_core.surface import Surface

Array = NDArray[np.float64]

TEMPLATE = Path(__file__).with_name("templates") / "report.html"
WORST_SHOWN_MM = 5.0  # where the colours of distances end


@dataclass(frozen=True)
class Image:
    """A picture of a page.

    Attributes:
        png: its bytes; None where there is none, which is said in its place.
        name: what it shows, for those who cannot see it.
        caption: a line below.
        is_bad: the caption reports a mistake.
    """

    png: bytes | None
    name: str
    caption: str = ""
    is_bad: bool = False


def _image(image: Image) -> str:
    shown = "<p>(not on this machine)</p>"
    if image.png is not None:
        data = base64.b64encode(image.png).decode()
        shown = f'<img alt="{escape(image.name)}" src="data:image/png;base64,{data}">'
    kind = ' class="bad"' if image.is_bad else ""
    return f"<figure>{shown}<figcaption{kind}>{escape(image.caption)}</figcaption></figure>"


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

    def subheading(self, text: str) -> None:
        """A part of a section begins."""
        self._parts.append(f"<h3>{escape(text)}</h3>")

    def note(self, text: str) -> None:
        """Text that must not be overlooked, or, at the end of a page, where it comes from."""
        self._parts.append(f'<p class="note">{escape(text)}</p>')

    def matrix(self, values: Array) -> None:
        """Numbers (N, M) in rows, to be copied: `numpy.loadtxt` reads them."""
        rows = (" ".join(f"{value + 0.0:14.9f}" for value in row) for row in np.round(values, 9))
        self._parts.append("<pre>{}</pre>".format("\n".join(rows)))

    def bullets(self, lines: Sequence[str]) -> None:
        """A list."""
        self._parts.append(f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>")

    def images(self, images: Sequence[Image]) -> None:
        """Pictures side by side, as many as fit."""
        self._parts.append(f'<div class="images">{"".join(map(_image, images))}</div>')

    def facts(self, values: Mapping[str, str]) -> None:
        """What matters most, in big type: name to value."""
        tiles = (f'<div class="fact"><b>{escape(v)}</b><span>{escape(k)}</span></div>' for k, v in values.items())
        self._parts.append(f'<div class="facts">{"".join(tiles)}</div>')

    def table(
        self,
        columns: Sequence[str],
        rows: Sequence[Sequence[str]],
        marks: Sequence[str] = (),
        text: Sequence[str] = (),
        best: Set[tuple[int, int]] = frozenset(),
    ) -> None:
        """A table of strings.

        Args:
            columns: the headings.
            rows: the cells, row by row.
            marks: for each row "ok", "hold", "bad", "first" (of a group), "aside" or "": how it looks.
            text: the columns that hold words; the others are set to the right.
            best: (row, column) of the cells in bold.
        """
        classes = [' class="text"' if name in text else "" for name in columns]
        head = "".join(f"<th{c}>{escape(name)}</th>" for name, c in zip(columns, classes, strict=True))
        body = ""
        for i, (row, mark) in enumerate(zip(rows, marks or [""] * len(rows), strict=True)):
            texts = [f"<b>{escape(cell)}</b>" if (i, j) in best else escape(cell) for j, cell in enumerate(row)]
            cells = "".join(f"<td{c}>{cell}</td>" for cell, c in zip(texts, classes, strict=True))
            body += f'<tr class="{mark}">{cells}</tr>'
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
        files.write_text(path, text)


@dataclass(frozen=True)
class Step:
    """One state of a 3-D view: points laid on the target, or none.

    Attributes:
        label: what the slider shows.
        caption: one line above the view.
        points: (N, 3) mm in the target's frame; empty when there is no pose.
        distances_mm: (N,) distance of each point to the target's surface.
        others: (M, 3) mm, points that do not count for the pose: shown in grey.
    """

    label: str
    caption: str
    points: Array
    distances_mm: Array
    others: Array = field(default_factory=lambda: np.zeros((0, 3)))


def alignment_figure(
    target: Surface,
    steps: Sequence[Step],
    shown: int = -1,
    facing: Array | None = None,
    word: str = "frame ",
    always: Sequence[Any] = (),
) -> Any:
    """A plotly figure: the target and on it the points of one step, coloured by distance; a slider chooses the step.

    Args:
        target: the bone.
        steps: what the slider chooses from.
        shown: which step the view begins with.
        facing: (3,) direction in the target's frame from which the view begins; from the front where it is None.
        word: what stands before the label of a step.
        always: plotly traces that every step shows.
    """
    import plotly.graph_objects as go

    shown = range(len(steps))[shown]
    kinds = (_cloud_trace, _others_trace) if any(len(step.others) for step in steps) else (_cloud_trace,)
    clouds = [trace(step, visible=k == shown) for trace in kinds for k, step in enumerate(steps)]
    figure = go.Figure([_target_trace(target), *always, *clouds])
    own = np.tile(np.eye(len(steps), dtype=bool), len(kinds))
    fixed = [True] * (1 + len(always))
    choices = [(step.label, fixed + visible, step.caption) for step, visible in zip(steps, own.tolist(), strict=True)]
    figure.update_layout(**view_layout(target, choices, shown, word, facing))
    return figure


def view_layout(
    target: Surface,
    choices: Sequence[tuple[str, list[bool], str]],
    shown: int,
    word: str,
    facing: Array | None = None,
) -> Any:
    """The layout of a 3-D view with a slider.

    Args:
        target: what it is about.
        choices: label, which traces are visible, and caption of every choice.
        shown: which choice the view begins with.
        word: what stands before the label.
        facing: (3,) direction from which the view begins; from the front where it is None.
    """
    steps = [
        {"method": "update", "label": label, "args": [{"visible": visible}, {"title.text": caption}]}
        for label, visible, caption in choices
    ]
    hidden = {"visible": False}
    slider = {"active": shown, "steps": steps, "currentvalue": {"prefix": word}, "pad": {"t": 0, "b": 40}}
    return {
        "title": {"text": choices[shown][2], "font": {"size": 15}, "x": 0.02},
        "height": 600 if len(choices) > 1 else 500,  # the slider needs the rest
        "margin": {"l": 0, "r": 0, "t": 44, "b": 0},
        "showlegend": False,
        "sliders": [slider] if len(choices) > 1 else [],
        "scene": {"xaxis": hidden, "yaxis": hidden, "zaxis": hidden, **_camera(target, facing)},
    }


def _camera(target: Surface, facing: Array | None) -> dict[str, Any]:
    """From the side that `facing` says, a long bone lying across, as large as the page allows; true proportions."""
    size = np.ptp(target.points, axis=0)
    lies = size[2] > 1.5 * size[0]
    ratio = size * (4.2 / size[2] if lies else 2.0 / size[[0, 2]].max())
    x, y = 1.2 * level(facing)
    up = {"x": y, "y": -x, "z": 0} if lies else {"x": 0, "y": 0, "z": 1}
    camera = {"eye": {"x": x + 0.15, "y": y, "z": 0.15}, "up": up, "projection": {"type": "orthographic"}}
    return {"aspectmode": "manual", "aspectratio": dict(zip("xyz", ratio.tolist(), strict=True)), "camera": camera}


def level(facing: Array | None) -> Array:
    """(2,) x and y of a unit direction across the long axis z: that of `facing` (3,), or the front (-y) for none."""
    across = np.zeros(2) if facing is None else facing[:2]
    length = float(np.linalg.norm(across))
    return across / length if length > 1e-6 else np.array([0.0, -1.0])


def _target_trace(target: Surface) -> Any:
    import plotly.graph_objects as go

    x, y, z = target.points.astype(np.float32).T
    if target.faces is None:
        return go.Scatter3d(
            x=x, y=y, z=z, mode="markers", marker={"size": 1.5, "color": palette.BONE}, hoverinfo="skip"
        )
    i, j, k = target.faces.astype(np.int32).T
    lighting = {"ambient": 0.5, "diffuse": 0.7, "specular": 0.1, "roughness": 0.8}
    light = {"x": 1.0, "y": 3.0, "z": -10.0}  # in view coordinates: from the eye, a little from above
    mesh = {"x": x, "y": y, "z": z, "i": i, "j": j, "k": k}
    return go.Mesh3d(**mesh, color=palette.BONE, lighting=lighting, lightposition=light, hoverinfo="skip")


def _cloud_trace(step: Step, visible: bool) -> Any:
    import plotly.graph_objects as go

    x, y, z = step.points.reshape(-1, 3).astype(np.float32).T
    bar = {"title": {"text": "distance to the bone, mm", "side": "right"}, "len": 0.7}
    colours = {"colorscale": "Turbo", "cmin": 0.0, "cmax": WORST_SHOWN_MM, "colorbar": bar}
    marker = {"size": 2.5, "color": step.distances_mm.astype(np.float32), **colours}
    hover = "%{marker.color:.2f} mm off<extra></extra>"
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, visible=visible, hovertemplate=hover)


def _others_trace(step: Step, visible: bool) -> Any:
    import plotly.graph_objects as go

    x, y, z = step.others.reshape(-1, 3).astype(np.float32).T
    marker = {"size": 1.5, "color": palette.OTHERS}
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, visible=visible, hoverinfo="skip")


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
