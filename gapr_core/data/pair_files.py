"""Pairs as .npz files: `source`, `target`, `transform`, and everything else that is known as extra arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.protocols import Pair
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.runtime import files
from gapr_core.surface import as_points

Array = NDArray[np.float64]

NAMES = ("name", "bone", "person", "protocol")


def save_pair(path: str | Path, pair: Pair) -> None:
    """Write one pair: clouds as float32 mm, the transform as float64 (all NaN and `has_truth` False for `wrong`).

    The file appears whole or not at all, so that an interrupted run can be taken up again.
    """
    extra = {key: np.asarray(value) for key, value in pair.metadata.items()}
    names = {key: np.asarray(getattr(pair, key)) for key in NAMES}
    arrays: dict[str, Any] = {**_content(pair), "has_truth": np.asarray(pair.has_truth), **names, **extra}
    with files.replacing(path) as partial:
        np.savez_compressed(partial, **arrays)


def pair_paths(folder: str | Path) -> list[Path]:
    """The files of a folder of pairs, by name.

    Raises:
        ConfigError: no such folder, or none in it.
    """
    paths = sorted(path for path in Path(folder).glob("*.npz") if not path.name.startswith("."))
    if not paths:
        raise ConfigError("a folder with NAME.npz files", str(folder), "check the path, or run gapr make-pairs")
    return paths


def load_clouds(path: str | Path) -> tuple[Array, Array, Array | None]:
    """Source (N, 3) and target (M, 3), mm, and where the camera was (3,) in the source's frame; None if not said.

    Nothing else of the file is read, so that no truth can be looked at.

    Raises:
        InvalidPointCloudError: not a readable .npz with these arrays.
    """
    arrays = _arrays(path, ("source", "target", "viewpoint"))
    return (*_clouds(arrays, path), _of_shape(arrays, "viewpoint", (3,), path))


def load_pair(path: str | Path) -> Pair:
    """Read one pair; a file with `source` and `target` alone is a pair without truth, named after the file.

    Raises:
        InvalidPointCloudError: not a readable .npz with these arrays.
    """
    arrays = _arrays(path)
    source, target = _clouds(arrays, path)
    transform = _of_shape(arrays, "transform", (4, 4), path)
    arrays = {key: array for key, array in arrays.items() if key not in ("source", "target", "transform", "has_truth")}
    names = {key: str(arrays.pop(key, "")) for key in NAMES}
    names["name"] = names["name"] or Path(path).stem
    metadata: dict[str, Any] = {key: a.item() if a.ndim == 0 else a for key, a in arrays.items()}
    return Pair(source, target, np.full((4, 4), np.nan) if transform is None else transform, **names, metadata=metadata)


def _arrays(path: str | Path, wanted: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as data:
            return {key: data[key] for key in data.files if wanted is None or key in wanted}
    except Exception as error:  # NumPy, zipfile and zlib raise many kinds
        raise _unreadable(path, " ".join(str(error).split())) from error


def _clouds(arrays: Mapping[str, NDArray[Any]], path: str | Path) -> tuple[Array, Array]:
    try:
        return as_points(arrays["source"]), as_points(arrays["target"])
    except KeyError as error:
        raise _unreadable(path, f"no array {error}") from error
    except InvalidPointCloudError as error:
        raise _unreadable(path, str(error)) from error


def _of_shape(arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...], path: str | Path) -> Array | None:
    array = arrays.get(name)
    if array is None:
        return None
    if array.shape != shape or array.dtype.kind not in "fiu":
        raise _unreadable(path, f"{name} of shape {array.shape} and type {array.dtype}")
    return array.astype(np.float64)


def _unreadable(path: str | Path, why: str) -> InvalidPointCloudError:
    return InvalidPointCloudError("an .npz with source and target", f"{path} ({why})", "write it again")


def pair_hash(pair: Pair) -> str:
    """sha256 of the clouds and the transform as they are written; what a frozen list is compared by."""
    digest = sha256()
    for key, array in sorted(_content(pair).items()):
        digest.update(f"{key}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _content(pair: Pair) -> dict[str, NDArray[np.floating]]:
    transform = np.asarray(pair.T_target_source, dtype="<f8")
    return {"source": pair.source.astype("<f4"), "target": pair.target.astype("<f4"), "transform": transform}
