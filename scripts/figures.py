"""Draw pictures of the documentation.

python scripts/figures.py methods docs/figures/methods.png
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from gapr_core.pages import palette

METHODS = Path(__file__).resolve().parents[1] / "docs" / "results" / "methods.md"


def main() -> None:
    """Draw one picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=FIGURES)
    parser.add_argument("out")
    args = parser.parse_args()
    FIGURES[args.name]().savefig(args.out, dpi=110, facecolor="white")


def methods() -> Figure:
    """Draw the first table of the page on other methods: right poses by kind of cloud, as bars."""
    rows = re.findall(
        r"^\| (?!\|)(.+?) \| \d+ \| (.+?) \| (.+?) \| (.+?) \| (.+?) \|$", METHODS.read_text(), re.MULTILINE
    )
    names = [row[0].replace("`", "") for row in rows]
    right = np.array([[float(re.match(r"[\d.]+", cell)[0]) for cell in (row[1], *row[3:])] for row in rows])
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    axes = figure.subplots()
    for k, name in enumerate(("GAPR", "KISS-Matcher, refined", "FPFH and RANSAC, refined")):
        places = np.arange(len(rows)) + 0.27 * (k - 1)
        bars = axes.bar(places, right[:, k], 0.25, color=palette.SERIES[k], label=name)
        axes.bar_label(bars, [f"{value:.0f}" for value in right[:, k]], fontsize=8)
    axes.set_xticks(range(len(rows)), names)
    axes.set(ylabel="right within 4 mm and 5 deg, %", ylim=(0.0, 125.0), yticks=range(0, 101, 25))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="upper right", ncols=3, fontsize=8, frameon=False)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {"methods": methods}


if __name__ == "__main__":
    main()
