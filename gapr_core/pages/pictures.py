"""The worst cases of one method as pictures: the bone, the source where the method put it, and where it belongs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from gapr_core.benchmark.record import Record
from gapr_core.data.pair import Pair
from gapr_core.data.pair_files import load_pair
from gapr_core.geometry import extent, se3
from gapr_core.pages import palette
from gapr_core.results import confidence_text

Array = NDArray[np.float64]
MOST_CASES = 10
MOST_TARGET_POINTS, MOST_SOURCE_POINTS = 5000, 1500


def worst(records: Sequence[Record], method: str) -> list[Record]:
    """False accepts first, the most confident of them first; then refused pairs that have a pose; then by RMSE."""
    own = [r for r in records if r.method == method and (r.has_truth or r.accepted)]
    return sorted(own, key=_badness, reverse=True)[:MOST_CASES]


def _badness(record: Record) -> tuple[float, float, float]:
    kind = 2.0 if record.false_accept else 1.0 if not record.accepted else 0.0
    return kind, record.confidence if kind == 2.0 else 0.0, record.rmse_mm or 0.0


def caption(record: Record) -> str:
    """Describe in one line how a case went wrong."""
    head = f"{record.pair} ({record.protocol}, {record.bone}): "
    if not record.accepted:
        return f"{head}refused, {record.status}, confidence {confidence_text(record.confidence)}. {record.reason}"
    if not record.has_truth:
        return f"{head}FALSE ACCEPT of a wrong pair, confidence {confidence_text(record.confidence)}"
    kind = "FALSE ACCEPT" if record.false_accept else "right"
    errors = f"{record.rte_mm:.2f} mm, {record.rre_deg:.2f}°, whole bone {record.whole_bone_mm:.2f} mm"
    return f"{head}{kind}, {errors}, confidence {confidence_text(record.confidence)}"


def picture(record: Record, folder: Path) -> Figure:
    """Two views along the bone's two shorter principal axes."""
    pair = load_pair(folder / record.file)
    centre = pair.target.mean(axis=0)
    axes = extent.principal(pair.target).axes
    clouds = [((points - centre) @ axes.T, colour, size, name) for points, colour, size, name in _clouds(record, pair)]
    length, *widths = np.ptp(clouds[0][0], axis=0)
    long = max(widths) < 0.45 * length  # views of a long bone one below the other
    figure = Figure(figsize=(9.0, 1.6 + 8.0 * sum(widths) / length if long else 4.6), layout="constrained")
    views = figure.subplots(2, 1, height_ratios=widths, sharex=True) if long else figure.subplots(1, 2)
    for view, (across, up) in zip(views, ((0, 1), (0, 2)), strict=True):
        _draw(view, clouds, across, up)
    handles, labels = view.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False, markerscale=4)
    return figure


def _clouds(record: Record, pair: Pair) -> list[tuple[Array, str, float, str]]:
    source = _thin(pair.source, MOST_SOURCE_POINTS)
    clouds = [(_thin(pair.target, MOST_TARGET_POINTS), palette.TARGET, 1.2, "target")]
    if pair.has_truth:
        clouds.append((se3.apply(pair.T_target_source, source), palette.FIRST, 2.0, "source, true pose"))
    if record.transform:
        clouds.append((se3.apply(record.transform, source), palette.SECOND, 2.0, "source, answer"))
    return clouds


def _draw(view: Axes, clouds: Sequence[tuple[Array, str, float, str]], across: int, up: int) -> None:
    for points, colour, size, name in clouds:
        view.scatter(points[:, across], points[:, up], s=size, c=colour, linewidths=0, label=name)
    view.set(aspect="equal", xlabel=f"axis {across + 1}, mm", ylabel=f"axis {up + 1}, mm")
    view.tick_params(labelsize=7)
    view.spines[["top", "right"]].set_visible(False)


def _thin(points: Array, most: int) -> Array:
    return points[:: max(1, -(-len(points) // most))]
