"""What the first registration costs more than the second: with the loops that are there, and with none.

    python benchmarks/first_registration.py

Run it with the Python of the installation in question. Each row is a process of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from gapr_core import Registrar
from gapr_core.commands.compile import made_up_bone
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

STEPS = ("first target", "first registration", "second target", "second registration", "all of the process, wall time")


def main() -> int:
    """Print one table, in seconds; of processor time but for the last column."""
    if "--one" in sys.argv:
        say(" ".join(f"{seconds:.2f}" for seconds in measured("network" in sys.argv)))
        return 0
    methods = ("search", "network") if find_spec("torch") else ("search",)
    lines = [markdown.head(("", *STEPS))]
    for method in methods:
        with tempfile.TemporaryDirectory() as empty:
            for name, cache in (("as installed", {}), ("nothing compiled", {"NUMBA_CACHE_DIR": empty})):
                command = [sys.executable, str(Path(__file__).resolve()), "--one", method]
                begun = time.perf_counter()
                run = subprocess.run(
                    command, cwd=empty, env=os.environ | cache, stdout=subprocess.PIPE, text=True, check=True
                )
                wall = f"{time.perf_counter() - begun:.2f}"
                lines.append(markdown.row((f"{method}, {name}", *run.stdout.split(), wall)))
    say("\n".join(lines))
    return 0


def measured(with_network: bool) -> list[float]:
    """CPU seconds of each of `STEPS` but the last."""
    bone, rng = made_up_bone(), np.random.default_rng(3)
    points, normals = bone.sample(9000, rng)
    source = points[normals[:, 0] > 0.2]
    registrar, found = Registrar.from_pretrained() if with_network else Registrar(), []
    for _ in range(2):
        start = time.process_time()
        target = registrar.prepare(bone)
        prepared = time.process_time()
        registrar.register(source, target)
        found += [prepared - start, time.process_time() - prepared]
    return found


if __name__ == "__main__":
    raise SystemExit(main())
