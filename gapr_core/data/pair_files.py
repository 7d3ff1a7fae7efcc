"""Pairs as .npz files: `source`, `target`, `transform`, and everything else that is known as extra arrays."""

from __future__ import annotations

import os
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.protocols import Pair
from gapr_core.errors import InvalidPointCloudError

NAMES = ("name", "bone", "person", "protocol")


def save_pair(path: str | Path, pair: Pair) -> None:
    """Write one pair: clouds as float32 mm, the transform as float64 (all NaN and `has_truth` False for `wrong`).

    The file appears whole or not at all, so that an interrupted run can be taken up again.
    """
    path = Path(path)
    extra = {key: np.asarray(value) for key, value in pair.metadata.items()}
    names = {key: np.asarray(getattr(pair, key)) for key in NAMES}
    partial = path.with_name(f".{path.stem}.{os.getpid()}.npz")
    arrays: dict[str, Any] = {**_content(pair), "has_truth": np.asarray(pair.has_truth), **names, **extra}
    np.savez_compressed(partial, **arrays)
    partial.replace(path)


def load_pair(path: str | Path) -> Pair:
    """Read one pair; a file with `source` and `target` alone is a pair without truth, named after the file.

    Raises:
        InvalidPointCloudError: not a readable .npz with these arrays.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = {key: data[key] for key in data.files}
        source, target = (arrays.pop(key).astype(np.float64) for key in ("source", "target"))
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise InvalidPointCloudError("an .npz with source and target", f"{path} ({error})", "write it again") from error
    transform = arrays.pop("transform", np.full((4, 4), np.nan)).astype(np.float64)
    arrays.pop("has_truth", None)
    names = {key: str(arrays.pop(key, "")) for key in NAMES}
    names["name"] = names["name"] or Path(path).stem
    metadata: dict[str, Any] = {key: a.item() if a.ndim == 0 else a for key, a in arrays.items()}
    return Pair(source, target, transform, **names, metadata=metadata)


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
