"""The process that reads a transform with ITK: `python -m gapr_core.formats.itk_child PATH`.

Its matrix goes to stdout as JSON, or null where it has none. HDF5's messages and crashes on a damaged file stay here.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

KEYS = ("Parameters", "FixedParameters")
FEWEST_FIXED = 3  # the centre; newer versions of ITK write a fourth number with it


def main(path: str) -> int:
    """Write the (4, 4) matrix of a linear transform in 3-D: of any kind, about any centre, or composed of such."""
    import SimpleITK

    transform = SimpleITK.ReadTransform(path)
    if transform.GetDimension() != 3 or not transform.IsLinear():
        sys.stdout.write("null")
        return 0
    if path.endswith(".tfm"):
        _check_whole(Path(path), transform)
    T = np.eye(4)
    T[:3, 3] = transform.TransformPoint((0.0, 0.0, 0.0))
    for axis, unit in enumerate(np.eye(3)):
        T[:3, axis] = np.array(transform.TransformPoint(unit.tolist())) - T[:3, 3]
    sys.stdout.write(json.dumps(T.tolist()))
    return 0


def _check_whole(path: Path, transform: Any) -> None:
    """Raise `ValueError` for text that is cut: ITK takes the parameters that are there, and any for the others."""
    lines = [line.partition(":") for line in path.read_text().splitlines()]
    counts = [[len(values.split()) for name, _, values in lines if name.strip() == key] for key in KEYS]
    parts = _parts(transform) if transform.GetName() == "CompositeTransform" else [transform]
    due = [part.GetNumberOfParameters() for part in parts]
    fixed = [min(len(part.GetFixedParameters()), FEWEST_FIXED) for part in parts]
    if not due or counts[0] != due or [min(count, FEWEST_FIXED) for count in counts[1]] != fixed:
        raise ValueError(f"{counts} parameters where {[due, fixed]} are due")


def _parts(transform: Any) -> list[Any]:
    """List the parts of a composed transform."""
    import SimpleITK

    composite = SimpleITK.CompositeTransform(transform)
    return [composite.GetNthTransform(n) for n in range(composite.GetNumberOfTransforms())]


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
