"""The process that reads a transform with ITK: `python -m gapr_core.formats.itk_child PATH`.

Its matrix goes to stdout as JSON, or null where it has none. What HDF5 says of a damaged file, or dies of, stays here.
"""

from __future__ import annotations

import json
import sys

import numpy as np


def main(path: str) -> int:
    """Write the (4, 4) matrix of a linear transform in 3-D: of any kind, about any centre, or composed of such."""
    import SimpleITK

    transform = SimpleITK.ReadTransform(path)
    if transform.GetDimension() != 3 or not transform.IsLinear():
        sys.stdout.write("null")
        return 0
    T = np.eye(4)
    T[:3, 3] = transform.TransformPoint((0.0, 0.0, 0.0))
    for axis, unit in enumerate(np.eye(3)):
        T[:3, axis] = np.array(transform.TransformPoint(unit.tolist())) - T[:3, 3]
    sys.stdout.write(json.dumps(T.tolist()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
