"""Pairs as .npz files: `source`, `target`, `transform`, and everything else that is known as extra arrays."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.pair import Pair
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.runtime import files
from gapr_core.surface import as_points

Array = NDArray[np.float64]

NAMES = ("name", "bone", "person", "protocol")
NUMBERS = ("overlap", "noise_mm", "bias_mm", "outlier_share", "bone_share")  # facts that records keep
TEXTS = ("cohort", "wrong_kind", "degraded_as", "source_person")
CLOUDS = ("source", "target")
LANDMARK = "landmark_"


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
    """List the files of a folder of pairs, by name.

    Raises:
        ConfigError: no such folder, or none in it.
    """
    paths = sorted(path for path in Path(folder).glob("*.npz") if not path.name.startswith("."))
    if not paths:
        raise ConfigError("a folder with NAME.npz files", str(folder), "check the path, or run gapr make-pairs")
    return paths


def load_clouds(path: str | Path) -> tuple[Array, Array, Array | None]:
    """Read source, target, mm, and the camera's place in the source's frame, (3,) or (N, 3); None if not said.

    Nothing else of the file is read, so that no truth can be looked at.

    Raises:
        InvalidPointCloudError: not a readable .npz with these arrays.
    """
    arrays = _arrays(path, lambda name: name in (*CLOUDS, "viewpoint"))
    source, target = _clouds(arrays, path)
    return source, target, _viewpoint(arrays, path)


def load_pair(path: str | Path) -> Pair:
    """Read one pair; a file with `source` and `target` alone is a pair without truth, named after the file.

    Raises:
        InvalidPointCloudError: not a readable .npz with these arrays; points that are missing or not finite; a
            transform that is not rigid; wrong landmarks or facts.
    """
    arrays = _arrays(path)
    clouds = _clouds(arrays, path)
    for name, points in zip(CLOUDS, clouds, strict=True):
        _check_count(name, len(points), path)
        if not np.isfinite(points).all():
            raise _wrong(path, f"finite points in {name}", "some that are not", "remove these rows")
    return _pair(clouds, arrays, path)


def load_facts(path: str | Path) -> Pair:
    """Read and check the facts of a pair like a whole one; its clouds stay empty.

    Raises:
        InvalidPointCloudError: as of `load_pair`, as far as it can be known without the coordinates.
    """
    arrays = _arrays(path, _is_fact)
    try:
        with np.load(path, allow_pickle=False) as data:
            heads = {name: _head(data, name) for name in CLOUDS}
    except Exception as error:  # NumPy, zipfile and zlib raise many kinds
        raise _unreadable(path, " ".join(str(error).split())) from error
    for name, (shape, dtype) in heads.items():
        if len(shape) != 2 or shape[1] != 3 or dtype.kind not in "fiu":
            raise _unreadable(path, f"{name} of shape {shape} and type {dtype}")
        _check_count(name, shape[0], path)
    return _pair((np.zeros((0, 3)), np.zeros((0, 3))), arrays, path)


def _check_count(name: str, count: int, path: str | Path) -> None:
    """Raise for a cloud of no points: there is nothing to judge an answer by."""
    if count == 0:
        raise _wrong(path, f"points in {name}", "none", "take the file out; gapr evaluate answers without a judge")


def _is_fact(name: str) -> bool:
    return name in (*NAMES, *NUMBERS, *TEXTS, "transform", "viewpoint") or name.startswith(LANDMARK)


def _head(data: Any, name: str) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of an array in an open .npz file, from its first bytes."""
    with data.zip.open(f"{name}.npy") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    return shape, dtype


def _pair(clouds: tuple[Array, Array], arrays: Mapping[str, NDArray[Any]], path: str | Path) -> Pair:
    """Make the pair with its metadata, and check shapes and types."""
    _check_facts(arrays, path)
    transform = _transform(arrays, path)
    facts = {key: array for key, array in arrays.items() if key not in (*CLOUDS, "transform", "has_truth")}
    names = {key: str(facts.pop(key, "")) for key in NAMES}
    names["name"] = names["name"] or Path(path).stem
    metadata: dict[str, Any] = {key: a.item() if a.ndim == 0 else a for key, a in facts.items()}
    source, target = clouds
    return Pair(source, target, transform, **names, metadata=metadata)


def _check_facts(arrays: Mapping[str, NDArray[Any]], path: str | Path) -> None:
    """Everything that a judge computes with, or a record keeps."""
    _viewpoint(arrays, path)
    for name in arrays:
        if name.startswith(LANDMARK):
            point = _of_shape(arrays, name, (3,), path)
            if not np.isfinite(point).all():  # type: ignore[arg-type]
                raise _wrong(path, f"a finite {name}", str(point), "leave it out, or write x y z in mm")
    for name, kinds, expected in [(n, "fiu", "a number") for n in NUMBERS] + [(n, "U", "a text") for n in TEXTS]:
        array = arrays.get(name)
        if array is not None and (array.ndim or array.dtype.kind not in kinds):
            raise _wrong(
                path, f"{name} as {expected}", f"shape {array.shape} and type {array.dtype}", "write one, or none"
            )


def _transform(arrays: Mapping[str, NDArray[Any]], path: str | Path) -> Array:
    """(4, 4) the truth; all NaN where there is none."""
    T = _of_shape(arrays, "transform", (4, 4), path)
    if T is None or np.isnan(T).all():
        return np.full((4, 4), np.nan)
    how = "write T_target_source in mm, or NaN where no pose is right"
    if not np.isfinite(T).all():
        raise _wrong(path, "a finite transform (4, 4)", "some entries that are not", how)
    if why := se3.why_not_rigid(T):
        raise _wrong(path, "a rigid transform (4, 4)", f"one whose {why}", how)
    return T


def _arrays(path: str | Path, is_wanted: Callable[[str], bool] = lambda name: True) -> dict[str, NDArray[Any]]:
    if Path(path).is_file() and not zipfile.is_zipfile(path):  # NumPy would speak of pickled data, and of trust
        raise _unreadable(path, "cut, or no .npz file")
    try:
        with np.load(path, allow_pickle=False) as data:
            return {key: data[key] for key in data.files if is_wanted(key)}
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
        given = f"shape {array.shape} and type {array.dtype}"
        raise _wrong(path, f"{name} as {shape} numbers", given, "write it again, or leave it out")
    return array.astype(np.float64)


def _viewpoint(arrays: Mapping[str, NDArray[Any]], path: str | Path) -> Array | None:
    """(3,) or, of several looks, a place for each point (N, 3); any N where the clouds are not read."""
    given = arrays.get("viewpoint")
    if given is None or given.ndim != 2:
        return _of_shape(arrays, "viewpoint", (3,), path)
    return _of_shape(arrays, "viewpoint", (len(arrays.get("source", given)), 3), path)


def _wrong(path: str | Path, expected: str, given: str, how: str) -> InvalidPointCloudError:
    return InvalidPointCloudError(expected, f"{given}, in {path}", how)


def _unreadable(path: str | Path, why: str) -> InvalidPointCloudError:
    return InvalidPointCloudError("an .npz with source and target", f"{path} ({why})", "write it again")


def pair_hash(pair: Pair) -> str:
    """sha256 of the clouds and the transform as they are written; by which frozen lists are compared."""
    digest = sha256()
    for key, array in sorted(_content(pair).items()):
        digest.update(f"{key}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def facts_hash(pair: Pair) -> str:
    """sha256 of what a file says of its pair besides the clouds, whether these were read or not."""
    fields = {**{name: getattr(pair, name) for name in NAMES}, **pair.metadata, "transform": pair.T_target_source}
    facts = {name: np.asarray(value).tolist() for name, value in fields.items() if _is_fact(name)}
    return sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _content(pair: Pair) -> dict[str, NDArray[np.floating]]:
    transform = np.asarray(pair.T_target_source, dtype="<f8")
    return {"source": pair.source.astype("<f4"), "target": pair.target.astype("<f4"), "transform": transform}
