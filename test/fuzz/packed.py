"""Bytes damaged inside voxels and meshes: `python test/fuzz/packed.py --count 10000`.

One to eight bytes behind the header of a label map or of a mesh change. The file is refused, or comes out as the whole
one does, or with a warning. What has no checksum may differ and is counted as `moved`: raw voxels, the points of a
cloud, and vertices of a mesh by at most six of its edges. Counts and faces are those of the whole file.
"""

import argparse
import logging
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from mesh_samples import samples
from patient_samples import native_samples
from reader import Warnings, in_this_process

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import reading
from gapr_core.formats.options import ReadOptions
from gapr_core.formats.volumes import child, label_map, whole

CHECKED = re.compile(r"\.nii\.gz|\.npz|packed\.(seg\.nrrd|mha)|(appended|binary)-(zlib|lzma)\.vtp")  # with a checksum
VOLUMES = (".nii", ".nii.gz", ".nrrd", ".mha", ".dcm")
MESHES = (".stl", ".ply", ".vtk", ".vtp", ".obj", ".npz", ".pcd")


def start_of(name, data, folder):
    """Where the numbers begin."""
    if name.endswith((".mha", ".nrrd")):
        (folder / name).write_bytes(data)
        return whole.header(folder / name)[1]
    marks = {
        ".stl": b"",
        ".ply": b"end_header\n",
        ".vtk": b"POINTS",
        ".vtp": b"<Piece",
        ".obj": b"\nv ",
        ".dcm": b"",
        ".pcd": b"\nDATA",
    }
    mark = next((mark for ending, mark in marks.items() if name.endswith(ending)), b"")
    sizes = {".nii": 352, ".stl": 84, ".dcm": len(data) // 2}
    return data.find(mark) if mark else next((n for ending, n in sizes.items() if name.endswith(ending)), 0)


def outcome(path, expected):
    """`refused`, `same`, `warned` or `moved`; anything else is a finding."""
    try:
        with Warnings() as warnings:
            surface = reading.read(path, ReadOptions(labels=("1",) if path.name.endswith(VOLUMES) else ()))
    except InvalidPointCloudError:
        return "refused"
    except Exception as error:
        return f"FINDING {type(error).__name__}: {error}"
    same = all(np.array_equal(a, b) for a, b in zip(parts(surface), expected, strict=True))
    if surface.faces is not None and len(surface.faces) and surface.faces.max() >= len(surface.points):
        return "FINDING a face beyond the vertices"
    if same or str(warnings):
        return "same" if same else "warned"
    return "moved" if path.name.endswith(VOLUMES) or is_near(*parts(surface), *expected) else "FINDING another surface"


def is_near(points, faces, whole, whole_faces):
    """Whether the faces are those of the whole mesh, and no vertex is far from its place; of a cloud, the counts."""
    if points.shape != whole.shape or not np.array_equal(faces, whole_faces):
        return False
    edges = [np.linalg.norm(whole[a] - whole[b]) for a, b in faces[:, :2].astype(int)]
    return not edges or np.linalg.norm(points - whole, axis=1).max() <= 6.0 * np.median(edges)


def parts(surface):
    return surface.points, np.empty((0, 3)) if surface.faces is None else surface.faces


def run(count, seed):
    """How often each outcome was, by (file, outcome)."""
    files = {n: d for n, d in (samples() | native_samples()).items() if n.endswith(MESHES + VOLUMES)}
    tally, names = Counter(), sorted(files)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        starts = {name: start_of(name, files[name], folder) for name in names}
        expected = {}
        for i in range(-len(names), count):
            name, rng = names[i % len(names)], np.random.default_rng([seed, max(i, 0)])
            damaged = bytearray(files[name])
            for at in rng.integers(starts[name], len(damaged), rng.integers(1, 9)) if i >= 0 else ():
                damaged[at] ^= 1 << rng.integers(8)
            (folder / name).write_bytes(damaged)
            if i < 0:
                how = ReadOptions(labels=("1",) if name.endswith(VOLUMES) else ())
                expected[name] = parts(reading.read(folder / name, how))
                continue
            found = outcome(folder / name, expected[name])
            if found == "moved" and CHECKED.search(name):
                found = "FINDING another surface in spite of a checksum"
            tally[name, found] += 1
    return tally


def in_one_process():
    """Read label maps here, which is quicker than a process for each."""
    logging.getLogger().addHandler(logging.NullHandler())
    child._limit = lambda limits, seconds: None
    label_map._in_a_child = in_this_process


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    in_one_process()
    tally = run(args.count, args.seed)
    for (name, found), times in sorted(tally.items()):
        sys.stdout.write(f"{name}: {times} {found}\n")
    return any(found.startswith("FINDING") for _, found in tally)


if __name__ == "__main__":
    raise SystemExit(main())
