"""From a bone to a mask to a transform that ITK maps points with: how far are they from where they were?

    python benchmarks/round_trip.py [--spacings "0.5;1;2;3;1,1.4,3;0.7,0.7,2.5"] [--method gapr_search]

Each parametric bone, left and right, is voxelised on grids that lie straight, oblique or as a reflection, and written
by libraries that others use: NIfTI by nibabel (RAS), NRRD in RAS and MHA by SimpleITK (LPS). `gapr register` registers
a part of the bone's own surface to it and writes pose.tfm, with which SimpleITK maps the points, in both directions.
"""

from __future__ import annotations

import argparse
import gzip
import logging
import tempfile
from contextlib import redirect_stdout
from dataclasses import dataclass
from io import StringIO
from itertools import product
from pathlib import Path

import numpy as np
import SimpleITK
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from gapr_core.cli import main as gapr
from gapr_core.data.masks import mask_of
from gapr_core.data.parametric import make_bone
from gapr_core.geometry import se3
from gapr_core.pages import markdown
from gapr_core.runtime.console import say
from gapr_core.surface import Surface

Array = NDArray[np.float64]
LABEL = 76
LPS_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
T = se3.from_rotation_translation(Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix(), [10.0, -70.0, 200.0])
PLACES = {
    "straight": np.eye(3),
    "along R, A, S": np.diag([-1.0, -1.0, 1.0]),
    "oblique": Rotation.from_rotvec([0.2, -0.3, 0.5]).as_matrix(),
    "oblique, a reflection": Rotation.from_rotvec([0.1, 0.6, 0.0]).as_matrix() @ np.diag([-1.0, 1.0, 1.0]),
}
AXES = {"as_is": [1, 1, 1], "lps": [1, 1, 1], "ras": [-1, -1, 1]}
EXACT_MM = 0.05  # float32 in the file, and what follows from it
SIDES = ("left", "right")
BONES = ("femur", "tibia", "pelvis")


@dataclass(frozen=True)
class Case:
    """A bone with the part of it that is registered."""

    name: str
    surface: Surface
    part: Array

    @classmethod
    def of(cls, bone: str, side: str) -> Case:
        """The lower 55 % of the bone; right bones are mirrored left ones."""
        surface = make_bone(bone, 3)
        surface = surface.mirrored() if side == "right" else surface
        points = surface.sample(6000, np.random.default_rng(1))[0]
        return cls(f"{side} {bone}", surface, points[points[:, 2] < np.percentile(points[:, 2], 55)])


def main() -> int:
    """Print one line for each file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spacings", default="0.5;1;2;3;1,1.4,3;0.7,0.7,2.5", help="mm, one number or three; with ;")
    parser.add_argument("--method", default="gapr_search")
    args = parser.parse_args()
    logging.disable(logging.WARNING)  # what each number and unit was taken for
    cases = [Case.of(bone, side) for bone, side in product(BONES, SIDES)]
    grids, rows = list(product(args.spacings.split(";"), PLACES)), []
    with tempfile.TemporaryDirectory() as folder:
        on_mesh = {case.name: errors_on_mesh(case, Path(folder), "as_is", args.method) for case in cases}
        for case, axes in product(cases[:2], AXES):
            found = errors_on_mesh(case, Path(folder), axes, args.method)
            rows.append(row(case, f"PLY, --axes {axes}", "-", "-", found, max(on_mesh[case.name]) + EXACT_MM))
        for number, (spacing, place) in enumerate(tqdm(grids, "grids", disable=None)):
            case, write = cases[number % len(cases)], list(WRITERS)[(number // len(PLACES) + number) % len(WRITERS)]
            size = np.array([float(word) for word in spacing.split(",")]) * np.ones(3)
            path = WRITERS[write](Path(folder), *mask_of(case.surface, size, PLACES[place], seed=number))
            found = errors(case, path, Path(folder), ["--label", str(LABEL), "--method", args.method])
            limit = 0.3 * size.max() + max(on_mesh[case.name])
            rows.append(row(case, write, place, " x ".join(f"{s:g}" for s in size), found, limit))
    head = ("bone", "file", "grid", "voxels, mm", "target to source: farthest point off, mm", "source to target, mm",
            "0.3 voxel + error on the mesh, mm", "within")  # fmt: skip
    say(markdown.table(head, rows))
    return 0


def row(case: Case, file: str, place: str, size: str, found: tuple[float, float], limit: float) -> list[str]:
    """The cells of one line."""
    figures = [f"{value:.2f}" for value in (*found, limit)]
    return [case.name, file, place, size, *figures, "yes" if max(found) < limit else "NO"]


def errors_on_mesh(case: Case, folder: Path, axes: str, method: str) -> tuple[float, float]:
    """The same part on the bone's own mesh, in a file of these axes."""
    import open3d as o3d

    mesh = Surface(case.surface.points * AXES[axes], case.surface.faces).to_open3d()
    o3d.io.write_triangle_mesh(str(folder / "bone.ply"), mesh)
    return errors(case, folder / "bone.ply", folder, ["--axes", axes, "--method", method])


def errors(case: Case, target: Path, folder: Path, options: list[str]) -> tuple[float, float]:
    """Largest distance of a mapped point from its place, mm: target to source as ITK reads it, and its inverse."""
    source, pose = se3.apply(se3.inverse(T), case.part), folder / "pose.tfm"
    np.save(folder / "source.npy", source)
    pose.unlink(missing_ok=True)
    with redirect_stdout(StringIO()):
        code = gapr(["register", "--source", str(folder / "source.npy"), "--target", str(target), "--out", str(pose),
                     *options])  # fmt: skip
    if code != 0:
        return np.inf, np.inf
    to_source = SimpleITK.ReadTransform(str(pose))
    to_target = to_source.GetInverse()
    return farthest(to_source, case.part, source), farthest(to_target, source, case.part)


def farthest(transform: SimpleITK.Transform, points: Array, places: Array) -> float:
    """Largest distance of a point that SimpleITK maps from its place, mm."""
    mapped = np.array([transform.TransformPoint(point.tolist()) for point in points[::20]])
    return float(np.linalg.norm(mapped - places[::20], axis=1).max())


def nifti(folder: Path, mask: NDArray[np.uint8], affine: Array) -> Path:
    """By nibabel, whose affine goes to RAS."""
    import nibabel

    nibabel.save(nibabel.Nifti1Image(LABEL * mask.transpose(2, 1, 0), LPS_RAS @ affine), folder / "seg.nii.gz")
    return folder / "seg.nii.gz"


def nrrd_in_ras(folder: Path, mask: NDArray[np.uint8], affine: Array) -> Path:
    """With the header that says its axes are right, anterior, superior."""
    ras = LPS_RAS @ affine
    axes, origin = [",".join(map(repr, column.tolist())) for column in ras[:3, :3].T], ras[:3, 3].tolist()
    sizes = " ".join(str(n) for n in reversed(mask.shape))
    head = (f"NRRD0004\ntype: uint8\ndimension: 3\nspace: right-anterior-superior\nsizes: {sizes}\n"
            f"space directions: ({axes[0]}) ({axes[1]}) ({axes[2]})\nkinds: domain domain domain\nencoding: gzip\n"
            f"space origin: ({','.join(map(repr, origin))})\n\n")  # fmt: skip
    (folder / "seg.nrrd").write_bytes(head.encode() + gzip.compress((LABEL * mask).tobytes()))
    return folder / "seg.nrrd"


def mha(folder: Path, mask: NDArray[np.uint8], affine: Array) -> Path:
    """By SimpleITK, which is in LPS."""
    size = np.linalg.norm(affine[:3, :3], axis=0)
    image = SimpleITK.GetImageFromArray(LABEL * mask)
    image.SetSpacing(size.tolist())
    image.SetDirection((affine[:3, :3] / size).ravel().tolist())
    image.SetOrigin(affine[:3, 3].tolist())
    SimpleITK.WriteImage(image, str(folder / "seg.mha"))
    return folder / "seg.mha"


WRITERS = {"NIfTI (nibabel)": nifti, "NRRD in RAS": nrrd_in_ras, "MHA (SimpleITK)": mha}


if __name__ == "__main__":
    raise SystemExit(main())
