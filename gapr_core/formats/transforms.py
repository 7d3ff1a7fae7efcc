"""Poses for other tools: ITK transforms (.tfm, .h5), and 4x4 matrices as text.

ITK maps points of the FIXED image to the MOVING one, in LPS: what is written is the inverse of T_target_source. 3D
Slicer inverts it again as it reads, so that the source, placed under the transform, lies on the target.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.errors import ConfigError, MethodUnavailableError
from gapr_core.geometry import se3
from gapr_core.runtime import files

Array = NDArray[np.float64]

ENDINGS = (".tfm", ".h5", ".txt")
TFM = (
    "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_3_3\n"
    "Parameters: {}\nFixedParameters: 0 0 0\n"
)


def check(path: Path) -> None:
    """Raise `ConfigError` for an ending that no pose is written to, or that ITK does not read for its capitals."""
    if path.suffix.lower() not in ENDINGS:
        raise ConfigError(f"a pose as {' '.join(ENDINGS)}", path.name, "choose one of these")
    if path.suffix not in ENDINGS:
        how = "write the ending in small letters: ITK and 3D Slicer know no other"
        raise ConfigError(f"a pose as {' '.join(ENDINGS)}", path.name, how)


def write(path: Path, T_target_source: ArrayLike) -> None:
    """Write a pose, LPS mm.

    Args:
        path: .tfm or .h5: the inverse, as ITK has it; .txt: T_target_source itself, four lines of four numbers.
        T_target_source: (4, 4), source to target.

    Raises:
        ConfigError: another ending, or a path that cannot be written.
        MethodUnavailableError: .h5 without SimpleITK.
    """
    check(path)
    T = np.asarray(T_target_source, dtype=np.float64)
    if path.suffix.lower() == ".txt":
        files.write_text(path, "".join(" ".join(repr(float(x)) for x in row) + "\n" for row in T))
    elif path.suffix.lower() == ".tfm":
        files.write_text(path, TFM.format(" ".join(repr(float(x)) for x in _itk_parameters(T))))
    else:
        _write_h5(path, _itk_parameters(T))


def _itk_parameters(T_target_source: Array) -> Array:
    """(12,) the inverse: nine of the rotation, row by row, and the translation."""
    T_source_target = se3.inverse(T_target_source)
    return np.concatenate([T_source_target[:3, :3].ravel(), T_source_target[:3, 3]])


def _write_h5(path: Path, parameters: Array) -> None:
    try:
        import SimpleITK
    except ImportError as error:
        raise MethodUnavailableError(".h5 files", "no SimpleITK", "pip install 'gapr_ros[medical]'") from error
    transform = SimpleITK.AffineTransform(3)
    transform.SetParameters(parameters.tolist())
    with files.replacing(path) as scratch:
        SimpleITK.WriteTransform(transform, str(scratch))
