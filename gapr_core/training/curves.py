"""Curves of one run, or of several laid over each other: losses, learning rate, inlier ratios and recall over pairs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, PercentFormatter
from numpy.typing import NDArray

from gapr_core.errors import ConfigError
from gapr_core.pages import palette
from gapr_core.runtime import files

Array = NDArray[np.float64]
Table = dict[str, Array]  # column name -> (rows,)

log = logging.getLogger(__name__)
LOSSES = {"coarse": "-", "fine": "--"}
INLIERS = {"coarse_inliers": "-", "fine_inliers": "--"}
RECALLS = {
    "first": "Recall: best pose within 4 mm and 5°",
    "near": "Recall: best pose within 20 mm and 15°",
    "among": "Recall: any proposal within 20 mm and 15°",
}
ALL = "all"  # the protocol that stands for all of them
LEGEND_LETTERS = 160  # that fit into a line of the picture


@dataclass(frozen=True)
class Run:
    """Files of a run so far: its name, log.csv, and validation.csv by protocol."""

    name: str
    steps: Table
    scores: dict[str, Table]


def draw(folders: Sequence[Path], out: Path, names: Sequence[str] = ()) -> Path:
    """Draw one PNG: a line per protocol for one run, a line per run for several.

    Args:
        folders: of the runs.
        out: the PNG; the old one stays until the new one is whole.
        names: of the runs in the legend; their folders' names where none are given.

    Raises:
        ConfigError: a folder in which no run has logged anything.
    """
    runs = [read(folder, name) for folder, name in zip(folders, names or labels(folders), strict=True)]
    with files.replacing(out) as new:
        figure(runs).savefig(new, dpi=110)
    return out


def draw_or_warn(folder: Path) -> None:
    """Draw the curves of a run under way, in its folder; warn if that fails, so training goes on."""
    try:
        draw([folder], folder / "curves.png")
    except Exception as error:
        log.warning("no curves of %s: %s: %s", folder, type(error).__name__, error)


def labels(folders: Sequence[Path]) -> list[str]:
    """Shorten paths to ends that differ."""
    parts = [folder.resolve().parts for folder in folders]
    for length in range(1, max(map(len, parts), default=1) + 1):
        ends = ["/".join(p[-length:]) for p in parts]
        if len(set(ends)) == len(ends):
            break
    return ends


def read(folder: Path, name: str) -> Run:
    """Read the run in a folder.

    Raises:
        ConfigError: none has logged anything there.
    """
    steps = _latest(read_csv(folder / "log.csv"))
    if not steps:
        raise ConfigError("the folder of a run with log.csv", f"{folder}, without a whole line", "check the path")
    rows = read_csv(folder / "validation.csv")
    protocols = dict.fromkeys(str(row["protocol"]) for row in rows)
    of_protocol = {p: _latest([row for row in rows if row["protocol"] == p]) for p in protocols}
    return Run(name, _columns(steps), {p: _columns(found) for p, found in of_protocol.items()})


def read_csv(path: Path) -> list[dict[str, float | str]]:
    """Read the whole lines of a growing file, none without one; logs a count of broken ones."""
    lines = path.read_text(errors="replace").splitlines(keepends=True) if path.exists() else []
    head = lines[0].rstrip().split(",") if lines else []
    parsed = [_parse(head, line) for line in lines[1:]]
    damaged = sum(row is None for row in parsed)
    if damaged:
        log.warning("%s: %d incomplete line(s) left out", path, damaged)
    return [row for row in parsed if row is not None]


def _parse(head: list[str], line: str) -> dict[str, float | str] | None:
    cells = line.rstrip().split(",")
    if len(cells) != len(head) or not line.endswith("\n"):
        return None
    try:
        return {key: cell if key == "protocol" else float(cell) for key, cell in zip(head, cells, strict=True)}
    except ValueError:
        return None


def _latest(rows: list[dict[str, float | str]]) -> list[dict[str, float | str]]:
    """Drop rows done again after an older checkpoint."""
    kept: list[dict[str, float | str]] = []
    for row in rows:
        while kept and kept[-1]["pairs"] >= row["pairs"]:  # type: ignore[operator]
            kept.pop()
        kept.append(row)
    return kept


def _columns(rows: list[dict[str, float | str]]) -> Table:
    return {key: np.array([row[key] for row in rows], dtype=np.float64) for key in rows[0] if key != "protocol"}


def smooth(values: Array, reach: int) -> Array:
    """Average the values (N,) within `reach` on either side, finite ones only."""
    known = np.isfinite(values)
    sums, counts = (np.r_[0.0, np.cumsum(part)] for part in (np.where(known, values, 0.0), known))
    first = np.maximum(np.arange(len(values)) - reach, 0)
    last = np.minimum(np.arange(len(values)) + reach + 1, len(values))
    with np.errstate(invalid="ignore"):
        return np.asarray((sums[last] - sums[first]) / (counts[last] - counts[first]))


def figure(runs: Sequence[Run]) -> Figure:
    """Two lines of three panels: losses, learning rate, inlier ratios; the three recalls."""
    one = len(runs) == 1
    drawn = Figure(figsize=(13.0, 7.2), layout="constrained")
    top, bottom = drawn.subplots(2, 3, sharex=True)
    _panel(top[0], "Loss: running mean" + (" (thin: each step)" if one else ""), "loss")
    _panel(top[1], "Learning rate of AdamW", "learning rate × 1000")
    _panel(top[2], "Inliers, all protocols", "share of matches that are right", True)
    for axes, (recall, title) in zip(bottom, RECALLS.items(), strict=True):
        _panel(axes, title, "share of pairs", True)
        _recalls(axes, runs, recall)
    for run, colour in zip(runs, _colours(len(runs)), strict=True):
        _losses(top[0], run, colour, one, reach=_reach(run, max(r.steps["pairs"][-1] for r in runs)))
        top[1].plot(run.steps["pairs"], 1e3 * run.steps["rate"], color=colour, lw=1.8)
        _inliers(top[2], run, colour, one)
    top[1].set_ylim(bottom=0.0)
    _kinds(top[0], LOSSES, one)
    _kinds(top[2], INLIERS, one)
    handles, texts = bottom[0].get_legend_handles_labels()
    if handles:
        drawn.legend(handles, texts, loc="outside lower center", ncols=_legend_columns(texts), frameon=False)
    drawn.suptitle(_title(runs), x=0.01, ha="left", fontsize=13, fontweight="bold")
    return drawn


def _legend_columns(texts: list[str]) -> int:
    """Fit columns of a legend below the axes side by side."""
    return max(1, min(8, len(texts), LEGEND_LETTERS // (max(map(len, texts)) + 8)))


def _title(runs: Sequence[Run]) -> str:
    if len(runs) > 1:
        return f"{len(runs)} runs, inliers and recall over all protocols"
    steps = runs[0].steps
    return f"{runs[0].name}: {steps['pairs'][-1]:,.0f} pairs, {steps['seconds'][-1] / 60:,.0f} min"


def _colours(count: int) -> list[str]:
    return [palette.SERIES[k % len(palette.SERIES)] for k in range(count)]


def _panel(axes: Axes, title: str, y: str, share: bool = False) -> None:
    axes.set_title(title, loc="left", fontsize=10.5)
    axes.set_xlabel("training pairs")
    axes.set_ylabel(y)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.tick_params(labelbottom=True)
    if share:
        axes.set_ylim(0.0, 1.03)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))


def _reach(run: Run, longest: float, share: float = 0.02) -> int:
    """Half the window of the running mean, in steps: a share of the longest run, and not more than half of this one."""
    steps = len(run.steps["pairs"])
    window = share * longest / (run.steps["pairs"][-1] / run.steps["step"][-1])
    return int(min(max(window, 24.0), steps / 2) / 2)


def _losses(axes: Axes, run: Run, colour: str, one: bool, reach: int) -> None:
    for k, (name, dash) in enumerate(LOSSES.items()):
        shade = palette.SERIES[k] if one else colour
        if one:
            axes.plot(run.steps["pairs"], run.steps[name], color=shade, lw=0.5, alpha=0.25)
        axes.plot(run.steps["pairs"], smooth(run.steps[name], reach), color=shade, lw=1.8, ls="-" if one else dash)


def _inliers(axes: Axes, run: Run, colour: str, one: bool) -> None:
    scores = run.scores.get(ALL, {})
    for k, (name, dash) in enumerate(INLIERS.items()):
        shade, style = (palette.SERIES[k], "-") if one else (colour, dash)
        if name in scores:
            axes.plot(scores["pairs"], scores[name], marker="o", ms=3.5, lw=1.8, color=shade, ls=style)


def _recalls(axes: Axes, runs: Sequence[Run], recall: str) -> None:
    """Draw a line per protocol and all in black for one run; for several, a line per run."""
    if len(runs) > 1:
        lines = [(run.name, run.scores.get(ALL, {}), colour, "-", 1.8) for run, colour in
                 zip(runs, _colours(len(runs)), strict=True)]  # fmt: skip
    else:
        apart = sorted(protocol for protocol in runs[0].scores if protocol != ALL)
        colours = _colours(len(apart))
        lines = [(p, runs[0].scores[p], colours[k], palette.dash(k), 1.4) for k, p in enumerate(apart)]
        of_all = runs[0].scores.get(ALL) if len(apart) > 1 else None  # of one protocol it would lie on its line
        lines += [("all protocols", of_all, "#111111", "-", 2.6)] if of_all else []
    for name, scores, colour, style, width in lines:
        axes.plot(scores.get("pairs", []), scores.get(recall, []), marker="o", ms=3.5, lw=width, color=colour, ls=style,
                  label=name)  # fmt: skip


def _kinds(axes: Axes, kinds: dict[str, str], one: bool) -> None:
    """Label the coarse and the fine line."""
    colours = _colours(len(kinds)) if one else ["#444444"] * len(kinds)
    styles = ["-"] * len(kinds) if one else list(kinds.values())
    handles = [Line2D([], [], color=c, ls=s, lw=1.8) for c, s in zip(colours, styles, strict=True)]
    axes.legend(handles, [name.removesuffix("_inliers") for name in kinds], frameon=False, loc="best")
