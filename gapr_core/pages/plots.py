"""Plots of a benchmark, each a Matplotlib figure from the records."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from gapr_core import metrics
from gapr_core.benchmark.record import Record
from gapr_core.geometry.se3 import RIGHT_DEG, RIGHT_MM
from gapr_core.pages import palette

Array = NDArray[np.float64]

CHI2_95_2D = 5.991  # 95 % quantile with two degrees of freedom
DEG_PER_MM = RIGHT_DEG / RIGHT_MM


def recall_against_threshold(records: Sequence[Record], methods: Sequence[str]) -> Figure:
    """Share of pairs within x mm AND 1.25 x deg, refusals and failures counted."""
    figure, axes = _figure("Recall against threshold", "limit: x mm and 1.25 x °", "registration recall")
    limits = np.geomspace(0.1, 30.0, 120)
    for k, (method, own) in enumerate(_by_method(records, methods, "has_truth")):
        errors = np.array([(r.rte_mm, r.rre_deg) if r.accepted else (np.inf, np.inf) for r in own], dtype=np.float64)
        worst = np.maximum(errors[:, 0], errors[:, 1] / DEG_PER_MM)
        axes.plot(limits, (worst[:, None] <= limits).mean(axis=0), label=method, **_style(k))
    for limit in (1.0, 2.0, 4.0):
        axes.axvline(limit, color=palette.GUIDE, lw=0.8, zorder=0)
    axes.set_xscale("log")
    axes.set_xticks([0.1, 0.3, 1, 2, 4, 10, 30], ["0.1", "0.3", "1", "2", "4", "10", "30"])
    return _finish(figure, axes)


def recall_against(records: Sequence[Record], methods: Sequence[str], key: str, label: str) -> Figure | None:
    """Draw recall at 4 mm / 5 deg in bins of overlap or noise; None if all pairs are alike."""
    known = [r for r in records if r.has_truth and getattr(r, key) is not None]
    edges = _bins(np.array([getattr(r, key) for r in known], dtype=np.float64))
    if len(edges) < 3:
        return None
    figure, axes = _figure(f"Recall against {label}", label, "registration recall (4 mm / 5°)")
    for k, (method, own) in enumerate(_by_method(known, methods, "has_truth")):
        x, y = np.array([getattr(r, key) for r in own]), np.array([r.within_4_5 for r in own], dtype=float)
        index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
        used = np.unique(index)
        means = [(x[index == b].mean(), y[index == b].mean()) for b in used]
        axes.plot(*np.transpose(means), marker="o", ms=4, label=method, **_style(k))
    return _finish(figure, axes)


def reliability_diagram(records: Sequence[Record], methods: Sequence[str]) -> Figure:
    """Confidence against the share of right poses; the size of a dot is how many poses it stands for."""
    figure, axes = _figure("Reliability", "confidence", "share of right poses (4 mm / 5°)")
    axes.plot([0, 1], [0, 1], color=palette.GUIDE, lw=1, zorder=0)
    for k, (method, own) in enumerate(_by_method(records, methods)):
        own = [r for r in own if r.best_right is not None]
        if not own:
            continue
        rows = metrics.reliability([r.confidence for r in own], [bool(r.best_right) for r in own])
        axes.plot(rows.confidence, rows.accuracy, label=method, **_style(k))
        sizes = 8 + 200 * rows.pairs / len(own)
        axes.scatter(rows.confidence, rows.accuracy, s=sizes, color=_style(k)["color"], alpha=0.6)
    return _finish(figure, axes)


def risk_coverage(records: Sequence[Record], methods: Sequence[str]) -> Figure:
    """Share of wrong answers among the most confident ones; the curve ends where the method refuses the rest."""
    figure, axes = _figure("Risk against coverage", "share of all pairs answered", "share of wrong answers")
    for k, (method, own) in enumerate(_by_method(records, methods)):
        given = [r for r in own if r.accepted]
        curve = metrics.risk_coverage([r.confidence for r in given], [r.right for r in given], len(own))
        if len(given):
            axes.plot(*curve, label=method, **_style(k))
            axes.plot(curve[0][-1], curve[1][-1], "o", color=_style(k)["color"], ms=5)
    return _finish(figure, axes)


def error_ellipsoids(records: Sequence[Record], method: str) -> Figure | None:
    """Translation errors of a method's right answers along the bone's principal axes, one line per protocol.

    95 % ellipses of the errors found, of the covariance predicted (mean) and of the Cramer-Rao bound (mean).
    """
    right = [r for r in records if r.method == method and r.right]
    protocols = sorted({r.protocol for r in right})
    groups = [(p, own) for p in protocols if len(own := [r for r in right if r.protocol == p]) > 2]
    if not groups:
        return None
    figure = Figure(figsize=(10.5, 3.4 * len(groups)), layout="constrained")
    all_axes = figure.subplots(len(groups), 3, squeeze=False)
    for line, (protocol, own) in zip(all_axes, groups, strict=True):
        errors = np.array([np.array(r.axes) @ np.array(r.twist)[:3] for r in own])
        ellipses = _ellipses(own, errors)
        widest = max(np.linalg.eigvalsh(covariance)[-1] for covariance, *_ in ellipses)
        span = 1.1 * max(np.abs(errors).max(), np.sqrt(CHI2_95_2D * widest))
        for axes, (i, j) in zip(line, ((0, 1), (0, 2), (1, 2)), strict=True):
            axes.scatter(errors[:, i], errors[:, j], s=9, color=palette.FIRST, alpha=0.55, linewidths=0)
            for covariance, colour, dash, name in ellipses:
                _draw_ellipse(axes, covariance[np.ix_([i, j], [i, j])], colour, dash, name)
            axes.set(xlim=(-span, span), ylim=(-span, span), aspect="equal")
            axes.set(xlabel=f"axis {i + 1}, mm", ylabel=f"axis {j + 1}, mm")
            axes.locator_params(nbins=5)
        line[0].set_title(f"{protocol}, {len(own)} right answers", fontsize=10, loc="left")
    title = f"{method}: translation error at the mean of the points used, bone axes (1 is the longest); 95 % ellipses"
    figure.suptitle(title, fontsize=11)
    handles, labels = all_axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return figure


def _ellipses(own: Sequence[Record], errors: Array) -> list[tuple[Array, str, str, str]]:
    found = [(errors.T @ errors / len(errors), palette.FIRST, "-", "errors found")]
    for key, colour, dash, name in (
        ("covariance", palette.SECOND, "--", "mean predicted"),
        ("bound_covariance", "#222222", ":", "mean Cramer-Rao bound"),
    ):  # fmt: skip
        known = [(np.array(r.axes), np.array(given)[:3, :3]) for r in own if (given := getattr(r, key))]
        turned = [bone_axes @ covariance @ bone_axes.T for bone_axes, covariance in known]
        if turned:
            found.append((np.mean(turned, axis=0), colour, dash, name))
    return found


def _draw_ellipse(axes: Axes, covariance: Array, colour: str, dash: str, name: str) -> None:
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2.0 * np.sqrt(CHI2_95_2D * np.maximum(values, 0.0))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    axes.add_patch(Ellipse((0, 0), width, height, angle=angle, fill=False, ec=colour, ls=dash, lw=1.5, label=name))


def _by_method(
    records: Sequence[Record], methods: Sequence[str], flag: str | None = None
) -> list[tuple[str, list[Record]]]:
    groups = [(m, [r for r in records if r.method == m and (flag is None or getattr(r, flag))]) for m in methods]
    return [(method, own) for method, own in groups if own]


def _bins(values: Array) -> Array:
    """Edges of bins with about equally many pairs, at most six; one bin per value where there are few values."""
    distinct = np.unique(np.round(values, 6))
    if len(distinct) <= 6:
        return np.r_[distinct - 1e-6, np.inf]  # below all that rounds to it
    return np.unique(np.quantile(values, np.linspace(0, 1, min(6, max(2, len(values) // 8)) + 1)))


def _style(k: int) -> dict[str, Any]:
    """Give each line other dashes than the next ones: two methods that are always wrong coincide."""
    dash = palette.DASHES[k % len(palette.DASHES)]
    return {"color": palette.SERIES[k % len(palette.SERIES)], "ls": dash, "lw": 2.6 if k == 0 else 1.6}


def _figure(title: str, x: str, y: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title, loc="left", fontsize=11)
    axes.set(xlabel=x, ylabel=y, ylim=(-0.02, 1.02))
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _finish(figure: Figure, axes: Axes) -> Figure:
    if axes.get_legend_handles_labels()[0]:
        figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", fontsize=8, frameon=False)
    return figure
