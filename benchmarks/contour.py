"""How far the surface of a label lies from the bone that was voxelised, for three ways to take it out of the mask.

    python benchmarks/contour.py [--anatomy DIR] [--split val] [--subjects 3] [--spacings 0.5,1,2,3]

Means over femur, tibia and pelvis of the first subjects of the split; without --anatomy of parametric ones.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes
from tqdm import tqdm

from gapr_core.data.masks import mask_of
from gapr_core.data.pool import specimens
from gapr_core.data.solid import is_closed, volume_mm3
from gapr_core.formats.volumes.contour import surface_of
from gapr_core.pages import markdown
from gapr_core.runtime.console import say
from gapr_core.surface import Surface

BONES = ("femur", "tibia", "pelvis")
POINTS = 100_000


def main() -> int:
    """Print the errors of each way at each voxel size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else parametric ones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--subjects", type=int, default=3, help="of each bone")
    parser.add_argument("--spacings", default="0.5,1,2,3", help="sizes of the voxels, mm, with commas")
    args = parser.parse_args()
    people = [s.surface for bone in BONES for s in closed(bone, args)]
    rows: dict[tuple[float, str], list[list[float]]] = {}
    for number, bone in enumerate(tqdm(people, "bones", disable=None)):
        for spacing_mm in map(float, args.spacings.split(",")):
            mask, affine = mask_of(bone, spacing_mm, seed=number)
            for way, surface in ways(mask, affine):
                rows.setdefault((spacing_mm, way), []).append(errors(surface, bone))
    say(table(rows))
    return 0


def closed(bone: str, args: argparse.Namespace) -> list:  # type: ignore[type-arg]
    """The first subjects whose mesh has an inside."""
    known = specimens(bone, args.split, args.subjects, args.anatomy)
    return [s for s in known if is_closed(s.surface.triangles)][: args.subjects]


def ways(mask: NDArray[np.uint8], affine: NDArray[np.float64]) -> list[tuple[str, Surface]]:
    """The staircase as it is, after a Gaussian of one voxel, and as GAPR reads it."""
    gaussian = ndimage.gaussian_filter(mask.astype(np.float32), 1.0)
    return [
        ("the staircase", contour(mask.astype(np.float32), affine)),
        ("a Gaussian of one voxel", contour(gaussian, affine)),
        ("as gapr reads it", surface_of(mask, affine)),
    ]


def contour(field: NDArray[np.float32], affine: NDArray[np.float64]) -> Surface:
    """The level of one half, faces outward for an affine that is no reflection."""
    vertices, faces, _, _ = marching_cubes(field, 0.5, gradient_direction="ascent")
    return Surface(vertices[:, ::-1] @ affine[:3, :3].T + affine[:3, 3], faces[:, ::-1].astype(np.int64))


def errors(surface: Surface, bone: Surface) -> list[float]:
    """Of signed distances to the bone, mm: mean, rms, 95 % of the lengths; rms angle of the normals, deg; volume, %."""
    points, normals = surface.sample(POINTS, np.random.default_rng(0))
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(bone.to_open3d()))
    query = o3d.core.Tensor(points.astype(np.float32))
    off = scene.compute_signed_distance(query).numpy()
    true = scene.compute_closest_points(query)["primitive_normals"].numpy()
    turn = np.degrees(np.arccos(np.clip((true * normals).sum(axis=1), -1.0, 1.0)))
    volume = 100.0 * (volume_mm3(surface) / volume_mm3(bone) - 1.0)
    return [off.mean(), np.sqrt((off**2).mean()), np.percentile(np.abs(off), 95), np.sqrt((turn**2).mean()), volume]


def table(rows: dict[tuple[float, str], list[list[float]]]) -> str:
    """Markdown, one line for each voxel size and way."""
    head = ("voxels, mm", "surface", "bones", "mean distance, mm (negative: inside)", "rms, mm", "95 %, mm",
            "normals off, rms deg", "volume off, %")  # fmt: skip
    lines = [markdown.head(head)]
    for (spacing_mm, way), found in rows.items():
        mean, rms, tail, turn, volume = np.mean(found, axis=0)
        figures = [f"{mean:+.3f}", f"{rms:.2f}", f"{tail:.2f}", f"{turn:.1f}", f"{volume:+.2f}"]
        lines.append(markdown.row([f"{spacing_mm:g}", way, len(found), *figures]))
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
