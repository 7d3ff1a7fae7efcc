"""Draw the pictures of the documentation that show bones.

python scripts/figures.py pose_or_refusal docs/figures/pose_or_refusal.png
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import rankdata

from gapr_core import Registrar, RegistrarConfig, RegistrationResult
from gapr_core.config import SensorConfig
from gapr_core.data import picture
from gapr_core.data.parametric import make_bone
from gapr_core.geometry import se3
from gapr_core.results import Guidance
from gapr_core.surface import Surface

Array = NDArray[np.float64]
SIGNED = LinearSegmentedColormap.from_list("signed", ["#1450c8", "#5f5a66", "#d01c2a"])  # blue inside, red outside
LIMIT_MM, PIXEL_MM = 1.0, 0.35
GREEN = np.array([70.0, 190.0, 110.0])


def main() -> None:
    """Draw one picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=FIGURES)
    parser.add_argument("out")
    args = parser.parse_args()
    FIGURES[args.name]().savefig(args.out, dpi=110, facecolor="white")


def pose_or_refusal() -> Figure:
    """Draw an accepted pose next to a refusal with the places to measure next."""
    bone = make_bone("femur", 1)
    config = RegistrarConfig(guide=True, sensor=SensorConfig("pointer", standoff_mm=0.0, noise_mm=0.4))
    registrar = Registrar.from_pretrained(config)
    target = registrar.prepare(bone)
    points, normals = bone.sample(40_000, np.random.default_rng(0))
    front = normals[:, 1] < -0.2
    ends = front & (_height(bone, points) < 0.35)
    shaft = front & (np.abs(_height(bone, points) - 0.55) < 0.09)
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    for axes, seen in zip(figure.subplots(2, 1), (ends, shaft), strict=True):
        result = _registered(registrar, target, points[seen])
        _draw(axes, bone, result)
        axes.set_title(_verdict(result), fontsize=11, loc="left", color="#1b6e3c" if result.ok else "#a02334")
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {"pose_or_refusal": pose_or_refusal}


def _height(bone: Surface, points: Array) -> Array:
    low, high = bone.points[:, 2].min(), bone.points[:, 2].max()
    return (points[:, 2] - low) / (high - low)


def _registered(registrar: Registrar, target: object, seen: Array) -> RegistrationResult:
    rng = np.random.default_rng(2)
    drawn = seen[rng.choice(len(seen), 600, replace=False)]
    moved = se3.apply(se3.exp([30.0, -20.0, 50.0, 0.5, -0.4, 1.0]), drawn + rng.normal(0.0, 0.4, (600, 3)))
    return registrar.register(moved, target)


def _verdict(result: RegistrationResult) -> str:
    if result.ok:
        return f"A pose. Error over the whole bone: {result.tre_mm:.1f} mm, 95 % below {result.tre95_mm:.1f} mm"
    return f"No pose ({result.status}): the shaft can slide and turn. Measure where it is green"


def _draw(axes: Axes, bone: Surface, result: RegistrationResult) -> None:
    """Draw the bone lying on its side, the points coloured by their distance, a refusal's guidance in green."""
    guidance = None if result.ok else result.guidance
    image = picture.shade(bone, "anterior", PIXEL_MM, colours=None if guidance is None else _gains(guidance))
    axes.imshow(np.rot90(image))
    on_bone = se3.apply(result.best, result.residuals.points)
    places, seen = picture.pixels(on_bone, bone, "anterior", PIXEL_MM)
    colour = np.nan_to_num(result.residuals.distance_mm)[seen]
    across, down = places[seen, 1], image.shape[1] - places[seen, 0]
    axes.scatter(across, down, s=7, c=colour, cmap=SIGNED, vmin=-LIMIT_MM, vmax=LIMIT_MM, linewidths=0)
    axes.set_axis_off()


def _gains(guidance: Guidance) -> Callable[[Array], Array]:
    tree, ranks = cKDTree(guidance.points), rankdata(guidance.gain_mm, method="max") / len(guidance.gain_mm)

    def colours(points: Array) -> Array:
        share = ranks[tree.query(points, k=12)[1]].mean(axis=1)[:, None] ** 3
        return share * GREEN + (1.0 - share) * picture.BONE

    return colours


if __name__ == "__main__":
    main()
