"""Shapes of which no pose can be known: how many are believed, and how surely.

    python benchmarks/unknowable.py [--count 8]

Straight bars of several cross-sections, of which the source shows a middle part, so that the slide along them is free,
and solids of revolution, whose spin is free; smooth, of 1 mm voxels, or rough. No accepted answer is right.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig
from gapr_core.data import scans
from gapr_core.geometry import se3
from gapr_core.pages import markdown
from gapr_core.runtime.console import say
from gapr_core.surface import Surface

Array = NDArray[np.float64]

NOISE_MM = (0.05, 0.2, 0.5, 1.0)
LENGTH_MM, POINTS, ROUGHNESS_MM = 160.0, 2000, 0.1


def bar(outline: Array) -> Surface:
    """A prism of LENGTH_MM along z over a closed, star-shaped outline (N, 2), mm."""
    count = len(outline)
    ring = np.arange(count)
    following = (ring + 1) % count
    ends = [np.column_stack([outline, np.full(count, z)]) for z in (-0.5 * LENGTH_MM, 0.5 * LENGTH_MM)]
    points = np.vstack([*ends, [[0.0, 0.0, -0.5 * LENGTH_MM], [0.0, 0.0, 0.5 * LENGTH_MM]]])
    lower = np.column_stack([ring, following, ring + count])
    upper = np.column_stack([following, following + count, ring + count])
    caps = [np.column_stack([following, ring, np.full(count, 2 * count)]),
            np.column_stack([ring + count, following + count, np.full(count, 2 * count + 1)])]  # fmt: skip
    return Surface(points, np.vstack([lower, upper, *caps]))


def polygon(corners: int, radius_mm: float) -> Array:
    """(N, 2) a regular polygon."""
    angle = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    return radius_mm * np.column_stack([np.cos(angle), np.sin(angle)])


def drop(corners: int = 64) -> Array:
    """(N, 2) an outline like that of a tibia's shaft: round behind, an edge in front."""
    angle = np.linspace(-np.pi, np.pi, corners, endpoint=False)
    radius_mm = 13.0 + 8.0 * np.exp(-((angle / 0.5) ** 2))
    return radius_mm[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def roughened(surface: Surface) -> Surface:
    """The surface as a fine mesh whose vertices are off by ROUGHNESS_MM."""
    fine = scans.of_voxels(2.0, 2.0, 2.0)(surface)
    fine = scans.smoothed(30)(fine)
    return Surface(fine.points + np.random.default_rng(0).normal(0.0, ROUGHNESS_MM, fine.points.shape), fine.faces)


SHAPES: dict[str, Surface] = {
    "box": bar(np.array([[-40.0, -25.0], [40.0, -25.0], [40.0, 25.0], [-40.0, 25.0]])),
    "hexagonal bar": bar(polygon(6, 25.0)),
    "round bar": bar(polygon(90, 20.0)),
    "bar with the outline of a shaft": bar(drop()),
    "cone": Surface.from_open3d(o3d.geometry.TriangleMesh.create_cone(40.0, 120.0, 90, 30)),
}
MODELS: dict[str, Callable[[Surface], Surface]] = {
    "smooth": scans.of_size(1.0),
    "voxels of 1 mm": scans.of_voxels(1.0, 1.0, 1.0),
    "rough": roughened,
}


def main() -> int:
    """Register every source, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=8, help="sources per shape, model and noise")
    args = parser.parse_args()
    registrar = Registrar.from_pretrained(RegistrarConfig(num_threads=1))
    head = ("shape", "model", "believed", "of these at >= 0.9", "ambiguous", "degenerate", "otherwise refused")
    say(markdown.head(head))
    for shape, surface in SHAPES.items():
        for model, scan in MODELS.items():
            target = registrar.prepare(scan(surface))
            answers = [
                registrar.register(source(surface, noise_mm, number), target)
                for noise_mm in NOISE_MM
                for number in tqdm(range(args.count), f"{shape}, {model}", leave=False)
            ]
            status = [str(answer.status) for answer in answers]
            sure = sum(answer.ok and answer.confidence >= 0.9 for answer in answers)
            ok, ambiguous, degenerate = (status.count(name) for name in ("OK", "AMBIGUOUS", "DEGENERATE"))
            row = shape, model, f"{ok} of {len(answers)}", sure, ambiguous, degenerate
            say(markdown.row((*row, len(answers) - ok - ambiguous - degenerate)))
    return 0


def source(surface: Surface, noise_mm: float, number: int) -> Array:
    """(POINTS, 3) of what is seen from one side of the middle third of the length, somewhere in space."""
    rng = np.random.default_rng([number, round(1000 * noise_mm)])
    points, normals = surface.sample(20 * POINTS, rng)
    direction = np.array([*rng.normal(size=2), 0.0])
    along = points[:, 2] - 0.5 * (points[:, 2].min() + points[:, 2].max())
    seen = points[(normals @ direction > 0.0) & (np.abs(along) < np.ptp(points[:, 2]) / 6.0)][:POINTS]
    T = se3.from_rotation_translation(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-100.0, 100.0, 3))
    return se3.apply(T, seen + rng.normal(0.0, noise_mm, seen.shape))


if __name__ == "__main__":
    raise SystemExit(main())
