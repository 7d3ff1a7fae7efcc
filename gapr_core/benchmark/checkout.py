"""Code of others from a checkout next to the project: found, imported, kept on the CPU; no line of it is here.

The operators of its C++ extensions (voxels, balls) are NumPy and k-d trees here, so that nothing is compiled.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from gapr_core.errors import MethodUnavailableError
from gapr_core.model.pyramid import voxel_means

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Origin:
    """Where the code of a network comes from.

    Attributes:
        name: of the method and of its weights; in capitals, the environment variable with the folder of the checkout.
        title: as its authors call it.
        repository: its address.
        holds: path inside that every checkout has.
        libraries: its requirements, for pip.
    """

    name: str
    title: str
    repository: str
    holds: str
    libraries: str

    @property
    def variable(self) -> str:
        """Environment variable with the folder of the checkout."""
        return self.name.upper()

    def find(self, folder: str | Path | None) -> Path:
        """Find the absolute path of a checkout; without a folder, that of the environment variable.

        Raises:
            MethodUnavailableError: there is none.
        """
        place = Path(folder or os.environ.get(self.variable, ""))
        if not (folder or self.variable in os.environ) or not (place / self.holds).exists():
            raise MethodUnavailableError(
                f"a checkout of {self.title} in the environment variable {self.variable}",
                f"{place} without {self.holds}" if str(place) != "." else "none",
                f"git clone {self.repository}, and name its folder",
            )
        return place.resolve()

    @contextmanager
    def importing(
        self, places: Sequence[Path], names: Collection[str], stand_ins: Mapping[str, ModuleType]
    ) -> Iterator[None]:
        """Inside, modules and packages of these names are the checkout's; outside, they are as before.

        Args:
            places: folders to import from.
            names: top-level modules and packages of the checkout.
            stand_ins: modules by their full names, in place of those of the checkout.

        Raises:
            MethodUnavailableError: for a failed import.
        """
        before = {name: sys.modules.pop(name) for name in _within(names)}
        sys.modules.update(stand_ins)
        try:
            with patch.object(sys, "path", [*map(str, places), *sys.path]):
                yield
        except (ImportError, AttributeError, KeyError) as error:
            missing = (getattr(error, "name", None) or "").partition(".")[0]
            if isinstance(error, ImportError) and missing not in names:
                needed, todo = f"libraries that {self.title} needs", f"pip install {self.libraries}"
            else:
                needed, todo = f"code of {self.title} as its authors publish it", f"git clone {self.repository}"
            raise MethodUnavailableError(f"the {needed}", str(error), todo) from error
        finally:
            for name in _within(names):
                del sys.modules[name]
            sys.modules.update(before)


def _within(names: Collection[str]) -> list[str]:
    return [module for module in sys.modules if module.partition(".")[0] in names]


@contextmanager
def without_cuda() -> Iterator[None]:
    """Tensors stay on the CPU, though the code would move them."""
    move = Tensor.to

    def stay(tensor: Tensor, *where: Any, **more: Any) -> Tensor:
        is_gpu = bool(where) and isinstance(where[0], torch.device) and where[0].type == "cuda"
        return tensor if is_gpu else move(tensor, *where, **more)

    with patch.object(Tensor, "cuda", lambda tensor, *_, **__: tensor), patch.object(Tensor, "to", stay):
        yield


def voxels(points: Array, lengths: Sequence[int], voxel: float) -> tuple[Array, list[int]]:
    """Means of the points (N, 3) in each voxel, cloud by cloud: (M, 3) and how many of each cloud."""
    thinned = [voxel_means(p, voxel) for p in np.split(np.asarray(points, np.float64), np.cumsum(lengths)[:-1])]
    return np.concatenate(thinned), [len(p) for p in thinned]


def balls(
    queries: Array,
    points: Array,
    query_lengths: Sequence[int],
    lengths: Sequence[int],
    radius: float,
    most: int | None = None,
) -> NDArray[np.int64]:
    """Find the points of the same cloud within a radius of each query (N, 3), nearest first; M for none.

    Without `most` there are as many columns as the fullest ball has points.
    """
    near = np.split(queries, np.cumsum(query_lengths)[:-1])
    trees = [cKDTree(cloud) for cloud in np.split(points, np.cumsum(lengths)[:-1])]
    if most is None:
        counts = [tree.query_ball_point(q, radius, return_length=True) for q, tree in zip(near, trees, strict=True)]
        most = int(np.concatenate(counts).max())
    rows, first = [], 0
    for q, tree in zip(near, trees, strict=True):
        found = tree.query(q, range(1, most + 1), distance_upper_bound=radius)[1]
        rows.append(np.where(found == tree.n, len(points), found + first))
        first += tree.n
    return np.concatenate(rows)
