"""Processor time for a pair, and pairs per second, of `gapr train` in its steady state.

python -m benchmarks.training_speed --anatomy DIR [--seconds 60] [--workers 0] [--pool 8]
torchrun --nproc-per-node 2 -m benchmarks.training_speed --anatomy DIR

Nothing is kept of the run. With PYTHONPATH at another checkout it measures that one (from d0e9fa3 on): do so in turn.
The first steps are left out, in which loops are compiled and the pool of bones fills: a small pool is full soon.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from argparse import ArgumentParser
from pathlib import Path
from typing import Any

import torch

import gapr_core
from gapr_core.training import dataset, trainer
from gapr_core.training.config import TrainConfig

LEFT_OUT = 12  # steps


class Enough(Exception):
    """The time is over."""


def main() -> None:
    """Train for a while and print one line a process."""
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--anatomy", type=Path, help="corresponded meshes with splits.json; else parametric bones")
    parser.add_argument("--seconds", type=float, default=60.0, help="of processor time in the first process (60)")
    parser.add_argument(
        "--workers", type=int, default=0, help="processes that make pairs; their time is not counted (0)"
    )
    parser.add_argument("--pool", type=int, default=8, help="bones in use at once (8)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    config = TrainConfig(pool=args.pool, workers=args.workers, device="cpu", validation_pairs=0)
    out, clock = Path(tempfile.mkdtemp()), Clock(args.seconds)
    clock.watch()
    try:
        trainer.train(config, out / "run", args.anatomy)
    except Enough:
        print(f"{Path(gapr_core.__file__).parents[1]}: {clock.summary(config.batch)}", flush=True)
        os._exit(0)  # the other processes wait for this one
    finally:
        shutil.rmtree(out, ignore_errors=True)


class Clock:
    """Times of steps, taken where the trainer averages the weights at the end of each."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.drawing = seconds, 0.0
        self.steps: list[tuple[float, float, float]] = []

    def watch(self) -> None:
        """From now on every step and every drawing of pairs is timed."""
        average, get = trainer.average, dataset.TrainingPairs.__getitem__

        def timed(*given: Any) -> Any:
            self.steps.append((time.process_time(), time.perf_counter(), self.drawing))
            if time.process_time() > self.seconds and len(self.steps) > LEFT_OUT + 1:
                raise Enough
            return average(*given)

        def timed_get(pairs: Any, number: int) -> Any:
            begun = time.process_time()
            made = get(pairs, number)
            self.drawing += time.process_time() - begun
            return made

        trainer.average, dataset.TrainingPairs.__getitem__ = timed, timed_get  # type: ignore[method-assign]

    def summary(self, batch: int) -> str:
        """One line; the processor time is that of this process, the pairs are those of all."""
        (cpu, wall, drawn), (cpu_end, wall_end, drawn_end) = self.steps[LEFT_OUT], self.steps[-1]
        pairs = (len(self.steps) - 1 - LEFT_OUT) * batch
        whole, drawing = 1e3 * (cpu_end - cpu) / pairs, 1e3 * (drawn_end - drawn) / pairs
        times = f"{whole:.1f} ms of processor time a pair, {drawing:.1f} of them drawing"
        return f"{pairs} pairs, {times}; {pairs / (wall_end - wall):.2f} pairs per second"


if __name__ == "__main__":
    main()
