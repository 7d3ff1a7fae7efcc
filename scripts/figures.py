"""Draw pictures of the documentation.

python scripts/figures.py pose_or_refusal docs/figures/pose_or_refusal.png
python scripts/figures.py methods docs/figures/methods.png
python scripts/figures.py wound docs/figures/wound.gif
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial import cKDTree

from gapr_core import Registrar, RegistrarConfig, RegistrationResult, Tracker
from gapr_core.config import SensorConfig
from gapr_core.data.pair import Pair
from gapr_core.data.parametric import make_bone
from gapr_core.data.pool import parametric_specimen
from gapr_core.data.scenes.figure import BONE, OTHER, paint
from gapr_core.data.scenes.stream import SceneMotion, simulate
from gapr_core.geometry import se3
from gapr_core.pages import palette, views

METHODS = Path(__file__).resolve().parents[1] / "docs" / "results" / "methods.md"
AWAY = (30.0, -20.0, 50.0, 0.5, -0.4, 1.0)  # the source's frame against the bone's: mm, rad
FRAMES, DARK, REACH = 18, "#22262c", 0.22  # REACH: tangent of half the image


def main() -> None:
    """Draw one picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=FIGURES)
    parser.add_argument("out")
    args = parser.parse_args()
    FIGURES[args.name](Path(args.out))


def pose_or_refusal(out: Path) -> None:
    """Draw a femur with a pose above one with a refusal and the places to measure next."""
    bone, rng = make_bone("femur", 1), np.random.default_rng(0)
    config = RegistrarConfig(guide=True, sensor=SensorConfig("pointer", standoff_mm=0.0, noise_mm=0.4))
    registrar = Registrar.from_pretrained(config)
    target = registrar.prepare(bone)
    points, normals = bone.sample(40_000, rng)
    height = (points[:, 2] - bone.points[:, 2].min()) / np.ptp(bone.points[:, 2])
    head = bone.points[bone.points[:, 2].argmax()]
    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    for axes, is_touched in zip(figure.subplots(2, 1), (height < 0.35, abs(height - 0.55) < 0.09), strict=True):
        touched = points[rng.choice(np.flatnonzero(is_touched & (normals[:, 1] < -0.2)), 400, replace=False)]
        source = se3.apply(se3.exp(AWAY), touched + rng.normal(0.0, 0.4, touched.shape))
        result = registrar.register(source, target)
        if result.ok:
            result = result.with_targets(head[None], ["head screw"])
        on = views.of_result(result, with_gain=not result.ok)
        views.paint(axes, on, views.picture_of(on, "anterior"))
        axes.set_title(_verdict(result), fontsize=11, loc="left", color="#1b6e3c" if result.ok else "#a02334")
    figure.savefig(out, dpi=110)


def _verdict(result: RegistrationResult) -> str:
    if not result.ok:
        return f"No pose ({result.status}): the shaft can slide and turn. Measure at 1 next"
    (screw,) = result.targets
    return f"A pose. Head screw (1): {screw.expected_mm:.1f} mm, in 95 of 100 cases below {screw.bound95_mm:.1f} mm"


def methods(out: Path) -> None:
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
    figure.savefig(out, dpi=110)


def wound(out: Path) -> None:
    """Draw a camera that circles a wound, as a moving picture: each frame with the points taken for bone."""
    tracker, motion = Tracker(Registrar.from_pretrained()), SceneMotion(frames=FRAMES)
    pairs = list(simulate(parametric_specimen("pelvis", 1), 1, motion))
    target = tracker.prepare(pairs[0].target)
    images = [_frame(pair, tracker.register(pair.source, target, viewpoint=pair.viewpoint)) for pair in pairs]
    images[0].save(out, save_all=True, append_images=images[1:], duration=250, loop=0, optimize=True)


def _frame(pair: Pair, result: RegistrationResult) -> Image.Image:
    figure = Figure(figsize=(3.4, 3.2), layout="constrained", facecolor=DARK)
    axes = figure.subplots()
    is_taken = result.residuals.inlier[cKDTree(result.residuals.points).query(pair.source)[1]]
    paint(axes, pair.source, pair.viewpoint, np.where(is_taken[:, None], BONE, OTHER), np.array([0.0, 1.0, 0.0]))
    axes.collections[0].set_sizes([6.0])
    axes.set(xlim=(-REACH, REACH), ylim=(-REACH, REACH))
    axes.set_title(str(result).split("  inliers")[0], fontsize=9, color="white")
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return Image.open(buffer).convert("RGB").quantize(16)


FIGURES: dict[str, Callable[[Path], None]] = {"pose_or_refusal": pose_or_refusal, "methods": methods, "wound": wound}


if __name__ == "__main__":
    main()
