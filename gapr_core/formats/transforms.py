"""Poses for and from other tools: ITK transforms (.tfm, .h5), and 4x4 matrices as text.

ITK maps points of the FIXED image to the MOVING one, in LPS: what is written is the inverse of T_target_source. 3D
Slicer inverts it again as it reads, so that the source, placed under the transform, lies on the target.
"""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gapr_core.errors import ConfigError, MethodUnavailableError
from gapr_core.geometry import se3
from gapr_core.runtime import child, files

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


def read(path: Path) -> Array:
    """(4, 4) T_target_source, LPS mm, as `write` writes it: .tfm and .h5 hold the inverse, .txt holds itself.

    Raises:
        ConfigError: not there, another ending, damaged, or no rigid motion.
        MethodUnavailableError: .tfm or .h5 without SimpleITK.
    """
    check(path)
    if not path.is_file():
        raise ConfigError("a file that exists", str(path), "check the path")
    T = _matrix_of_text(path) if path.suffix == ".txt" else _matrix_of_itk(path)
    if not np.isfinite(T).all() or (why := se3.why_not_rigid(T)):
        given = f"{path.name} whose {why}" if np.isfinite(T).all() else f"{path.name} with numbers that are not finite"
        raise ConfigError("a rigid motion", given, "save a transform without scale or shear")
    T = se3.nearest_rigid(T)
    return T if path.suffix == ".txt" else se3.inverse(T)


def _matrix_of_text(path: Path) -> Array:
    content = ""
    try:
        content = path.read_text(encoding="utf-8-sig")
        T = np.loadtxt(content.splitlines(), ndmin=2)
    except (OSError, ValueError) as error:
        given = f"{path.name} with {'commas' if ',' in content else 'other content'}"
        how = "write T_target_source so, or rename an ITK transform to .tfm"
        if "," in content:
            how = "put spaces between the numbers, and write decimals with a point"
        raise ConfigError("four lines of four numbers", given, how) from error
    if T.shape != (4, 4):
        raise ConfigError("four lines of four numbers", f"{path.name} with {T.shape[0]} by {T.shape[1]}", "correct it")
    return T


def _matrix_of_itk(path: Path) -> Array:
    """(4, 4) of a linear transform, read in a process of its own."""
    if find_spec("SimpleITK") is None:
        how = "pip install 'gapr_ros[medical]'"
        raise MethodUnavailableError(f"reading {path.suffix} files", "no SimpleITK", how)
    done = child.run("gapr_core.formats.itk_child", str(path.absolute()))
    if done.returncode != 0:
        given = f"{path.name}, which ITK cannot read"
        raise ConfigError("an ITK transform", given, "save it from 3D Slicer as .tfm or .h5")
    if (matrix := json.loads(done.stdout)) is None:
        raise ConfigError("a linear transform in 3-D", path.name, "save the linear part alone")
    return np.array(matrix, dtype=np.float64)


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
