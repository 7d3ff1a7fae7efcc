"""How does a benchmark grow with pairs and workers: pairs per second, memory, and is the table the same?

    python benchmarks/scale_out.py --out DIR [--pairs 100000]
    python benchmarks/scale_out.py --out DIR --pairs 300 --method gapr --protocols L2 --anatomy DIR --split test

Runs `gapr benchmark` over one list of pairs: in one process, on a Dask cluster of 1 and of 2 workers, and as two shards
at a time that are merged. The default method puts centroid on centroid, which costs nothing: what is measured is to
plan, read, judge, record and tabulate. Its pairs are 80 small ones (128 and 512 points; one in ten has a truth) under
as many names as wanted, hard links to 80 files; those of another method are drawn. Memory is the resident set of the
largest process of a kind, looked at once a second. Pairs per second are those between the first and the last record.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import psutil
from distributed import Client

from gapr_core import metrics
from gapr_core.benchmark import records
from gapr_core.benchmark.table import TIMES
from gapr_core.data import make_pairs, pool
from gapr_core.data.anatomy import BONES
from gapr_core.data.make_pairs import Recipe
from gapr_core.data.pair import Pair
from gapr_core.data.pair_files import load_pair, pair_hash, save_pair
from gapr_core.geometry import se3
from gapr_core.pages import markdown
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_core.runtime import files, origin
from gapr_core.runtime.console import say

COSTLESS = "scale_out:centroids"
DIFFERENT, TRUE = 80, 10  # small pairs; one in ten has a true pose, so that reading and writing outweigh judging
SOURCE_POINTS, TARGET_POINTS = 128, 512
LOOK_S = 1.0
MB = 2**20
GAPR = [sys.executable, "-m", "gapr_core.cli", "benchmark"]
DASK = [sys.executable, "-m", "dask"]
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


class Centroids:
    """Centroid on centroid, without rotation: an answer that costs nothing, and is wrong."""

    name = "centroids"

    def prepare(self, target: Any, units: str = "mm") -> Any:
        """The target itself."""
        return target

    def register(self, source: Any, target: Any) -> RegistrationResult:
        """Accepted, so that everything is judged that can be."""
        T = metrics.centroid_alignment(source, target)
        return RegistrationResult(RegistrationStatus.OK, T, confidence=0.5, method=self.name)


def centroids() -> Centroids:
    """The costless method, for `module:factory`."""
    return Centroids()


@dataclass
class Seen:
    """What was looked at during one run.

    Attributes:
        counts: (seconds since the start, records written).
        memory: kind of process to (records written, MB of its largest process).
        seconds: from the start to the end of the last command.
    """

    counts: list[tuple[float, int]] = field(default_factory=list)
    memory: dict[str, list[tuple[int, float]]] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def first_s(self) -> float:
        """When there was a record."""
        return next((t for t, count in self.counts if count), self.seconds)

    @property
    def last_s(self) -> float:
        """When the last record was written."""
        return next((t for t, count in self.counts if count == self.counts[-1][1]), self.seconds)

    @property
    def per_s(self) -> float:
        """Records per second between the two."""
        before = next((count for _, count in self.counts if count), 0)
        return (self.counts[-1][1] - before) / max(self.last_s - self.first_s, LOOK_S)

    def mb(self, kind: str, share: float) -> float:
        """Of the largest process of a kind when this share of the records was written."""
        most = self.counts[-1][1]
        return next((mb for count, mb in self.memory.get(kind, []) if count >= share * most), float("nan"))

    def most_mb(self, kind: str) -> float:
        """The most that one had at any time."""
        return max((mb for _, mb in self.memory.get(kind, [])), default=float("nan"))


def main() -> int:
    """Make the pairs, run all cases, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="scratch folder for pairs and results")
    parser.add_argument("--pairs", type=int, default=100_000, help="how many, of all bones and protocols (100000)")
    parser.add_argument("--method", default=COSTLESS)
    parser.add_argument("--protocols", default="L2", help="of another method than the costless one, with commas")
    parser.add_argument("--anatomy", type=Path, help="folder with the bones for it; else parametric ones")
    parser.add_argument("--split", default="test")
    parser.add_argument("--cases", default="1,dask1,dask2,shards2", help="which, and in what order; the first compares")
    args = parser.parse_args()
    folder = args.out / "pairs"
    if args.method == COSTLESS:
        link_small_pairs(args.out / "small", folder, args.pairs)
    else:
        draw_pairs(folder, args)
    rows, first = [], None
    for case in args.cases.split(","):
        out = args.out / case
        seen = run(case, ["--pairs", str(folder), "--methods", args.method], out)
        table = timeless(out)
        first = first or table
        rows.append(row(case, seen, "yes" if table == first else "NO"))
        say(rows[-1])
    say("\n" + "\n".join([markdown.head(HEAD), *rows]))
    say(f"\n{args.pairs} pairs, {args.method}, commit {origin.commit()}, {origin.cpu_name()}, {os.cpu_count()} cores")
    return 0


HEAD = (
    "run", "pairs/s", "until the first record, s", "table and report, s", "in all, s",
    "client MB at 10 %", "at 100 %", "with the report", "scheduler MB at 10 %", "at 100 %",
    "worker MB at 10 %", "at 100 %", "same table",
)  # fmt: skip
NAMES = {"1": "one process", "dask1": "Dask, 1 worker", "dask2": "Dask, 2 workers", "shards2": "2 shards, merged"}


def row(case: str, seen: Seen, same: str) -> str:
    """One line of the table."""
    times = seen.first_s, seen.seconds - seen.last_s, seen.seconds
    client = seen.mb("client", 0.1), seen.mb("client", 1.0), seen.most_mb("client")
    others = [seen.mb(kind, share) for kind in ("scheduler", "worker") for share in (0.1, 1.0)]
    memory = ["–" if np.isnan(mb) else f"{mb:.0f}" for mb in (*client, *others)]
    return markdown.row((NAMES[case], f"{seen.per_s:.1f}", *(f"{s:.0f}" for s in times), *memory, same))


def timeless(out: Path) -> list[dict[str, Any]]:
    """The rows of a run but for times."""
    rows = files.read_json(out / "table.json", "a table of gapr benchmark")["rows"]
    return [{key: value for key, value in row.items() if key not in TIMES} for row in rows]


def run(case: str, words: list[str], out: Path) -> Seen:
    """One case, from its first command to its table."""
    seen, outs = Seen(), [out]
    with ExitStack() as stack:
        clients: list[list[str]] = [[*GAPR, *words, "--out", str(out)]]
        others: dict[str, psutil.Process] = {}
        if case.startswith("dask"):
            address, others = stack.enter_context(cluster(int(case[4:]), out))
            clients = [[*clients[0], "--dask", address]]
        elif case.startswith("shards"):
            count = int(case[6:])
            outs = [out / f"shard{number}" for number in range(1, count + 1)]
            clients = [[*GAPR, *words, "--out", str(each), "--shard", f"{number}/{count}"]
                       for number, each in enumerate(outs, 1)]  # fmt: skip
        start = time.monotonic()
        with looking(seen, [each / records.FILE for each in outs], others, start) as watched:
            started = [stack.enter_context(process(client)) for client in clients]
            watched.extend(psutil.Process(each.pid) for each in started)
            finish(started)
            if len(outs) > 1:
                merging = stack.enter_context(process([*GAPR, "merge", *map(str, outs), "--out", str(out)]))
                watched.append(psutil.Process(merging.pid))
                finish([merging])
        seen.seconds = time.monotonic() - start
    return seen


def finish(started: Sequence[subprocess.Popen[bytes]]) -> None:
    """Wait for commands that have to succeed."""
    for each in started:
        if each.wait():
            raise RuntimeError(f"{each.args!r} ended with {each.returncode}")


@contextmanager
def looking(
    seen: Seen, paths: Sequence[Path], others: dict[str, psutil.Process], start: float
) -> Iterator[list[psutil.Process]]:
    """Look at records and memory from another thread; the list takes the clients, whose children are workers."""
    clients: list[psutil.Process] = []
    places, ended, written = dict.fromkeys(paths, 0), Event(), 0

    def look() -> None:
        nonlocal written
        while not ended.wait(LOOK_S):
            for path in paths:
                lines, places[path] = new_lines(path, places[path])
                written += lines
            seen.counts.append((time.monotonic() - start, written))
            sizes = [("client", rss(each)) for each in clients]
            sizes += [("worker", rss(child)) for each in clients for child in children(each)]
            for name, process_of in others.items():
                kind = name.rstrip("0123456789")
                sizes += [(kind, max(map(rss, (process_of, *children(process_of)))))]
            for kind in {kind for kind, _ in sizes}:
                most = max(mb for of, mb in sizes if of == kind)
                if most:
                    seen.memory.setdefault(kind, []).append((written, most))

    thread = Thread(target=look, daemon=True)
    thread.start()
    try:
        yield clients
        time.sleep(2 * LOOK_S)
    finally:
        ended.set()
        thread.join()


def new_lines(path: Path, place: int) -> tuple[int, int]:
    """Whole lines after a place in a file that grows, and the place where it ends."""
    if not path.is_file():
        return 0, place
    with path.open("rb") as file:
        file.seek(place)
        text = file.read()
    return text.count(b"\n"), place + len(text)


def rss(of: psutil.Process) -> float:
    """Resident MB; 0 of a process that has ended."""
    try:
        return float(of.memory_info().rss / MB)
    except psutil.Error:
        return 0.0


def children(of: psutil.Process) -> list[psutil.Process]:
    """All processes below one."""
    try:
        return of.children(recursive=True)
    except psutil.Error:
        return []


@contextmanager
def cluster(count: int, out: Path) -> Iterator[tuple[str, dict[str, psutil.Process]]]:
    """Scheduler and workers as docs/tutorials/research.md starts them: the address, and the processes by name."""
    out.mkdir(parents=True, exist_ok=True)
    file = (out / "scheduler.json").resolve()
    file.unlink(missing_ok=True)
    where = ["--scheduler-file", str(file), "--no-dashboard"]
    with ExitStack() as stack:
        started = stack.enter_context(process([*DASK, "scheduler", "--host", "127.0.0.1", "--port", "0", *where]))
        found = {"scheduler": psutil.Process(started.pid)}
        while not file.is_file():
            time.sleep(LOOK_S)
        options = [*where, "--nthreads", "1", "--local-directory", str(out / "dask")]
        for number in range(count):
            started = stack.enter_context(process([*DASK, "worker", *options]))
            found[f"worker{number}"] = psutil.Process(started.pid)
        address = json.loads(file.read_text())["address"]
        with Client(address) as client:
            client.wait_for_workers(count, timeout=60)
        yield address, found


@contextmanager
def process(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A command with this folder on its path, one thread in its libraries and no output; ended at the end."""
    root = Path(__file__).resolve().parents[1]
    path = os.pathsep.join([str(root / "benchmarks"), str(root), os.environ.get("PYTHONPATH", "")])
    env = os.environ | ONE_THREAD | {"PYTHONPATH": path}
    with subprocess.Popen(command, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as started:
        try:
            yield started
        finally:
            started.terminate()


def link_small_pairs(small: Path, folder: Path, count: int) -> None:
    """The list of a costless run: `count` names, hard links to small pairs, and the manifest that lists them."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for number in range(DIFFERENT):
        pair = small_pair(number)
        save_pair(small / f"{number}.npz", pair)
        digest = pair_hash(load_pair(small / f"{number}.npz"))
        for turn in range(number, count, DIFFERENT):
            name = f"{pair.protocol}_{pair.bone}_{turn:06d}"
            (folder / f"{name}.npz").unlink(missing_ok=True)
            os.link(small / f"{number}.npz", folder / f"{name}.npz")
            entries.append({"name": name, "sha256": digest})
    files.write_json(folder / make_pairs.MANIFEST, {"recipe": {}, "hash": "", "pairs": entries})


def small_pair(number: int) -> Pair:
    """An ellipsoid of points, mm, and some of them in another place; one in ten says which."""
    rng, bone = np.random.default_rng(number), BONES[number % len(BONES)]
    target = rng.normal(size=(TARGET_POINTS, 3)) * [80.0, 25.0, 15.0]
    T = se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-100.0, 100.0, 3))
    source, has_truth = se3.apply(se3.inverse(T), target[:SOURCE_POINTS]), number % TRUE == 0
    protocol, truth = ("paper", T) if has_truth else ("wrong", np.full((4, 4), np.nan))
    return Pair(source, target, truth, f"small_{number}", bone, f"subject_{number % 7}", protocol)


def draw_pairs(folder: Path, args: argparse.Namespace) -> None:
    """The list of a run that registers."""
    protocols = tuple(args.protocols.split(","))
    each = -(-args.pairs // (len(protocols) * len(BONES)))
    origin_of = "anatomy" if args.anatomy else "parametric"
    recipe = Recipe(protocols, BONES, each, split=args.split, origin=origin_of)
    bones = {bone: pool.specimens(bone, args.split, recipe.people, args.anatomy) for bone in BONES}
    make_pairs.write_pairs(recipe, bones, folder)


if __name__ == "__main__":
    raise SystemExit(main())
