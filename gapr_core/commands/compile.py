"""`gapr compile`: compile all loops now, so that the first registration does not wait for it.

Numba keeps compiled code, for this processor and this version of Numba: with the package, or in the user's cache where
that folder is not writable. Whoever runs the registration should run this. A wheel that `pip install` builds from the
sources has been through it.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from tqdm import tqdm

from gapr_core import Accumulator, Registrar, Surface, Tracker
from gapr_core.formats import lzf
from gapr_core.geometry import se3
from gapr_core.geometry.sampling import fibonacci_directions
from gapr_core.registration.proposals import consensus

Array = NDArray[np.float64]
OK = 0


def add_arguments(parser: ArgumentParser) -> None:
    """Add no options."""


def run(args: Namespace) -> int:
    """Register made-up clouds in every way."""
    for work in tqdm(list(all_ways()), "compiling", unit="step"):
        work()
    return OK


def all_ways() -> Iterator[Callable[[], Any]]:
    """Calls that together run every compiled loop of a registration, in their order; training compiles its own."""
    registrar = Registrar.from_pretrained() if find_spec("torch") and find_spec("safetensors") else Registrar()
    tracker, bone = Tracker(registrar), made_up_bone()
    shell = Surface(np.concatenate([bone.points, 0.8 * bone.points]))
    rng = np.random.default_rng(0)
    points, normals = bone.sample(12_000, rng)
    seen = points[normals @ [0.6, 0.0, 0.8] > 0.3]
    near, far = seen[:3000] + rng.normal(0.0, 0.2, (3000, 3)), np.array([180.0, 0.0, 240.0])
    target = registrar.prepare(bone)
    yield partial(registrar.prepare, shell)
    yield partial(registrar.prepare, Surface(points))
    yield partial(registrar.register, near, target)
    yield partial(Registrar().register, near[:300], Registrar().prepare(bone))
    yield partial(registrar.register, np.concatenate([near, near + [40.0, 0.0, 0.0]]), target, viewpoint=far)
    for number in range(3):
        yield partial(tracker.register, se3.apply(se3.exp([1.0, 0, 0, 0, 0, 0]), near[number:]), target)
    together = Accumulator(registrar, 3)
    for number in range(3):
        yield partial(together.register, near[number::3], target)
    found = consensus.Correspondences(near[:40], near[:40], np.ones(40), np.arange(40) // 20)
    yield partial(consensus.local_to_global, found, 3.0)  # of the network, where torch comes later
    yield partial(lzf.decompress, b"\x00g", 1)


def made_up_bone() -> Surface:
    """Make a closed mesh of the size of a knee, mm, symmetric in y alone."""
    directions = fibonacci_directions(6000)
    x, y, z = directions.T
    radius = 1.0 + 0.2 * np.sin(3.0 * x + 1.0) * np.cos(2.0 * y) + 0.1 * np.sin(5.0 * z + 2.0 * x)
    faces = ConvexHull(directions).simplices
    a, b, c = directions[faces].transpose(1, 0, 2)
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), a) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return Surface(directions * [25.0, 32.0, 60.0] * radius[:, None], faces.astype(np.int64))
