"""NIfTI, NRRD, MHA and DICOM SEG: the surface of one or several labels, LPS mm."""

from __future__ import annotations

import json
import logging
import re
import subprocess
import tempfile
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import InvalidPointCloudError, MethodUnavailableError
from gapr_core.formats.options import ReadOptions
from gapr_core.formats.volumes import contour
from gapr_core.runtime import child
from gapr_core.surface import Surface

Mask = NDArray[np.uint8]
log = logging.getLogger(__name__)

NEEDS = ("SimpleITK", "skimage", "highdicom")
LONGEST_READ_S = 300
CHILD = "gapr_core.formats.volumes.child"
NO_MEMORY = re.compile(r"MemoryError|bad_alloc|annot allocate|failed to map segment")
COMPLAINT = re.compile(r"error|fail|corrupt|truncated", re.IGNORECASE)  # ITK prints it and returns success


def read(path: Path, options: ReadOptions) -> Surface:
    """Read the labels' surface in patient coordinates (LPS, mm), whatever the file's own axes.

    Raises:
        InvalidPointCloudError: a file that is damaged or too large, or a label that is not in it.
        MethodUnavailableError: the libraries of the extra `medical` are missing.
    """
    if missing := [name for name in NEEDS if find_spec(name) is None]:
        raise MethodUnavailableError("label maps", f"no {' '.join(missing)}", "pip install 'gapr_ros[medical]'")
    if (shown := str(path).encode("utf-8", "backslashreplace").decode()) != str(path):  # ITK says nothing of the kind
        raise InvalidPointCloudError("a path in UTF-8", Path(shown).name, "rename the file or its folder")
    if path.stat().st_size > options.limits.file_mb * (1 << 20):
        options.limits.read(path)
    with tempfile.TemporaryDirectory() as folder:
        asked = _with_small_ending(path, Path(folder))
        mask, affine, notes = _in_a_child(asked, options, Path(folder) / "mask.npz")
    for note in notes:
        log.warning("%s: %s", path.name, note)
    return contour.surface_of(mask, affine)


def _with_small_ending(path: Path, folder: Path) -> Path:
    """Return SCAN.MHA under a name in small letters: ITK has no readers for others."""
    ending = "".join(path.suffixes[-2:]) if path.suffix.lower() == ".gz" else path.suffix
    if ending == ending.lower():
        return path
    link = folder / f"{path.name.removesuffix(ending)}{ending.lower()}"
    link.symlink_to(path.resolve())
    return link


def _in_a_child(path: Path, options: ReadOptions, out: Path) -> tuple[Mask, NDArray[np.float64], list[str]]:
    """Return the cropped mask [k, j, i], the affine of its indices (i, j, k), and notes."""
    request = {"path": str(path.absolute()), "labels": list(options.labels), "limits": asdict(options.limits),
               "seconds": LONGEST_READ_S}  # fmt: skip
    try:
        done = child.run(CHILD, json.dumps(request), str(out.absolute()), timeout_s=LONGEST_READ_S)
    except subprocess.TimeoutExpired as error:
        raise ValueError(f"not read in {LONGEST_READ_S} s") from error
    if done.returncode != 0 or COMPLAINT.search(done.stderr.replace(path.name, "")):
        raise _refusal(done)
    with np.load(out, allow_pickle=False) as data:
        affine, notes = data["affine"].copy(), json.loads(data["notes"].tobytes())
        affine[:3, 3] += affine[:3, :3] @ data["start"]
        return data["mask"], affine, notes


def _refusal(done: subprocess.CompletedProcess[str]) -> Exception:
    """Return the child's error, or how it ended."""
    if done.returncode == 1 and done.stdout.startswith("["):
        return InvalidPointCloudError(*json.loads(done.stdout))
    lines = done.stderr.strip().splitlines() or [f"its reader ended with {done.returncode}"]
    return MemoryError() if NO_MEMORY.search(done.stderr) else ValueError(lines[-1])
