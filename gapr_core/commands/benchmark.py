"""`gapr benchmark`: pairs x methods to one table, plots and a report; resumable, parallel, sharded.

gapr benchmark --pairs DIR --methods gapr,kiss4,icp --out OUT [--shard 1/4] [--jobs 2] [--set NAME=VALUE]
gapr benchmark --pairs DIR --out OUT --dask tcp://host:8786
gapr benchmark merge OUT_1 OUT_2 ... --out OUT
"""

from __future__ import annotations

import logging
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

from tqdm import tqdm

from gapr_core.benchmark import methods as known_methods
from gapr_core.benchmark import records, runner, table
from gapr_core.benchmark.record import ERROR, Record
from gapr_core.benchmark.records import Inputs, Plan
from gapr_core.benchmark.table import Row
from gapr_core.commands import options
from gapr_core.config import RegistrarConfig
from gapr_core.data.make_pairs import MANIFEST, read_manifest
from gapr_core.data.pair_files import load_pair, pair_hash, pair_paths
from gapr_core.errors import ConfigError
from gapr_core.pages import writers
from gapr_core.runtime import cluster, files, origin
from gapr_core.runtime.arguments import a_path, at_least_one, names
from gapr_core.runtime.console import say

log = logging.getLogger(__name__)

DIFFERENT = {"commit": "commits", "threads": "numbers of threads", "machine": "machines"}
DEFAULT_METHODS = "gapr,kiss4,fpfh_ransac+point_to_plane,icp"


def add_arguments(parser: ArgumentParser) -> None:
    """Add the options of `gapr benchmark`."""
    parser.add_argument("merge", nargs="*", help="`merge DIR...`: join the outputs of several shards into --out")
    parser.add_argument("--pairs", type=a_path, help="folder of NAME.npz, as gapr make-pairs writes it")
    parser.add_argument(
        "--methods",
        default=DEFAULT_METHODS,
        help=f"with commas (default: {DEFAULT_METHODS}); docs/tutorials/research.md",
    )
    parser.add_argument("--out", type=a_path, required=True, help="folder for the table, the plots and the report")
    parser.add_argument("--shard", default="1/1", help="i/n: only every n-th pair, beginning with the i-th")
    parser.add_argument("--jobs", type=at_least_one, default=1, help="worker processes (1)")
    parser.add_argument("--threads", type=at_least_one, default=1, help="cores for each worker (1)")
    parser.add_argument("--dask", metavar="ADDRESS", help=cluster.ARGUMENT)
    options.add_settings(parser)
    parser.add_argument("--ours", help="the method that the others are compared with (gapr, or the first one)")


def run(args: Namespace) -> int:
    """Run or merge as the arguments say, and say where the report is."""
    import gapr_core.pages.benchmark_report  # noqa: F401  a missing library is said before the work

    if args.merge:
        folders = [Path(name) for name in args.merge[1:]]
        if args.merge[0] != "merge" or not folders:
            raise ConfigError("merge DIR...", " ".join(args.merge), "name the folders to merge after the word merge")
        rows = merge(folders, args.out, args.ours)
    else:
        if args.pairs is None:
            raise ConfigError("--pairs DIR", "none", "make some with gapr make-pairs")
        methods = names(args.methods)
        config, shard = options.registrar_config(args), _shard(args.shard)
        rows = benchmark(args.pairs, methods, args.out, shard, args.jobs, args.threads, args.ours, config, args.dask)
    say(f"{len(rows)} rows in {args.out / 'table.md'}; to look at: {args.out / 'report.html'}")
    return 0


def benchmark(
    pairs: Path,
    methods: Sequence[str],
    out: Path,
    shard: tuple[int, int] = (1, 1),
    jobs: int = 1,
    threads: int = 1,
    ours: str | None = None,
    config: RegistrarConfig | None = None,
    dask: str | None = None,
) -> list[Row]:
    """Run missing cases of `out`, then write table, plots and report there.

    Args:
        pairs: folder of NAME.npz (see `gapr_core.data.pair_files`).
        methods: names that `methods.make` knows.
        out: folder of the results; an interrupted run there is taken up again.
        shard: (i, n): every n-th pair, beginning with the i-th, 1 to n.
        jobs: worker processes.
        threads: cores for each of them.
        ours: the method the others are compared with.
        config: settings of our own methods; the others have none.
        dask: address of a Dask cluster that runs it instead of processes here; `threads` is then its workers' affair.

    Returns:
        The rows of the table.

    Raises:
        ConfigError: no pairs, an unknown method, settings without a method of ours, other pairs or settings in `out`; a
            pair without a truth; an unknown `ours`.
        InvalidPointCloudError: a file that is no pair, or whose truth, landmarks or facts cannot be.
        MethodUnavailableError: a method whose library is not installed.
    """
    paths = pair_paths(pairs)
    if not methods:
        raise ConfigError("methods", "none", f"name some of {', '.join(known_methods.names())} with --methods")
    known_methods.check(methods)
    config = config or RegistrarConfig()
    if config != RegistrarConfig() and not any(map(known_methods.is_own, methods)):
        raise ConfigError(f"settings with one of {', '.join(known_methods.OWN)}", ", ".join(methods), "leave them out")
    chosen = [path.resolve() for path in paths[shard[0] - 1 :: shard[1]]]
    facts = runner.check_pairs(tqdm(chosen, desc="checking pairs", disable=None, leave=False))
    commit, made_of = _commit(), {name: known_methods.made_of(name) for name in methods}
    inputs = Inputs(
        _hashes(pairs, paths), {name: known_methods.settings_of(name, config) for name in methods}, made_of, facts
    )
    plan, done = _begin(pairs, inputs, methods, out, ours)
    tasks = [runner.Task(path, method, config) for path in chosen for method in methods]
    open_tasks = [task for task in tasks if (task.path.stem, task.method) not in done]
    with tqdm(total=len(tasks), initial=len(tasks) - len(open_tasks), desc="benchmark", disable=None) as bar:
        for record in runner.run_on_cluster(open_tasks, dask) if dask else runner.run(open_tasks, jobs, threads):
            check_content(record, plan)
            ran = replace(record, commit=commit, threads=threads, made_of=made_of[record.method])
            records.append(out / records.FILE, ran)
            bar.set_postfix_str(f"{record.method} {record.pair}", refresh=False)
            bar.update()
    return write(out, plan)


def _begin(
    pairs: Path, inputs: Inputs, methods: Sequence[str], out: Path, ours: str | None
) -> tuple[Plan, set[tuple[str, str]]]:
    """Write the plan; hand it back with an earlier run's records. Its records do not stay in memory."""
    known = records.read(out / records.FILE)
    before = records.read_plan(out) if (out / records.PLAN).is_file() else None
    there = [record.method for record in records.sort(known, before.methods if before else methods)]
    first = [name for name in before.methods if name in there] if before else []
    all_methods = list(dict.fromkeys([*first, *there, *methods]))
    ours = ours or (before.ours if before and before.ours in all_methods else None)
    plan = _plan(pairs, inputs.pairs, all_methods, ours)
    done = records.done(known, inputs)
    records.write_plan(out, plan)
    records.discard_cut_line(out / records.FILE)
    return plan, done


def merge(folders: Sequence[Path], out: Path, ours: str | None = None) -> list[Row]:
    """Join the results of shards of one run.

    Raises:
        ConfigError: a folder that is no output of a benchmark, or shards of different pairs or settings; `ours` that
            is none of their methods.
    """
    _join(folders, out, ours)
    return write(out, records.read_plan(out))


def _join(folders: Sequence[Path], out: Path, ours: str | None) -> None:
    """Collect the records and the plan of all shards in `out`."""
    plans = [records.read_plan(folder) for folder in folders]
    pairs: dict[str, str] = {}
    for folder, plan in zip(folders, plans, strict=True):
        if any(pairs.setdefault(name, digest) != digest for name, digest in plan.pairs.items()):
            raise ConfigError("shards of the same pairs", f"other clouds in {folder}", "merge runs over one folder")
    joined = [record for folder in (out, *folders) for record in records.read(folder / records.FILE)]
    named = (*(name for plan in plans for name in plan.methods), *(record.method for record in joined))
    methods = list(dict.fromkeys(named))
    _check_ours(ours, methods)
    _check_same_pairs(joined, pairs, out)
    of = {record.method: record for record in reversed(joined)}
    settings, made_of = ({name: getattr(r, key) for name, r in of.items()} for key in ("settings", "made_of"))
    records.done(joined, Inputs(pairs, settings, made_of))
    records.write(out / records.FILE, records.sort(joined, methods))
    plan = replace(plans[0], ours=ours or plans[0].ours)
    records.write_plan(out, replace(plan, pairs=pairs, methods=methods, command=_command()))


def write(out: Path, plan: Plan) -> list[Row]:
    """Table, plots and report of the records in `out`."""
    from gapr_core.pages import benchmark_report

    found = records.sort(records.read(out / records.FILE), plan.methods)
    if not found:
        raise ConfigError("results", f"none in {out}", "this shard has no pairs: use fewer shards")
    conditions = records.conditions(found)
    rows, notes = table.rows(found, plan.methods), _notes(found, plan, conditions)
    apart = table.differences(found, plan.methods, plan.ours)
    ran = {name: " and ".join(values) for name, values in conditions.items()}
    with files.together():
        writers.write_json(out / "table.json", rows, apart, plan, ran)
        writers.write_csv(out / "table.csv", rows)
        writers.write_markdown(out / "table.md", rows, apart, plan, ran, notes)
        benchmark_report.write(out, found, rows, apart, plan, ran, notes)
    return rows


def _hashes(pairs: Path, paths: Sequence[Path]) -> dict[str, str]:
    """Map name to sha256 for all pairs of a folder; warn of truths with suspicious conventions."""
    listed = listed_hashes(pairs)
    missing = [path for path in paths if path.stem not in listed]
    read, doubts = {}, []
    for path in tqdm(missing, desc="reading pairs", disable=None):
        pair = load_pair(path)
        read[path.stem] = pair_hash(pair)
        doubts += [f"that of {path.name} {doubt}" for doubt in [runner.doubt_of_truth(pair)] if doubt]
    if doubts:
        how = "Write T_target_source, source to target, in mm"
        log.warning("%d of %d transforms may not be the truth: %s. %s", len(doubts), len(missing), doubts[0], how)
    return {path.stem: listed.get(path.stem) or read[path.stem] for path in paths}


def _plan(pairs: Path, hashes: dict[str, str], methods: Sequence[str], ours: str | None) -> Plan:
    _check_ours(ours, methods)
    return Plan(
        command=_command(),
        started=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        ours=ours or (known_methods.OURS if known_methods.OURS in methods else methods[0]),
        methods=list(methods),
        folder=str(pairs.resolve()),
        pairs=hashes,
    )


def listed_hashes(pairs: Path) -> dict[str, str]:
    """Map name to sha256 from the folder's manifest, so no shard reads all pairs; empty without one."""
    if not (pairs / MANIFEST).is_file():
        return {}
    return {entry["name"]: entry["sha256"] for entry in read_manifest(pairs)["pairs"]}


def check_content(record: Record, plan: Plan) -> None:
    """Raise `ConfigError` where the pair that was registered is not the one that the manifest lists."""
    if record.sha256 != plan.pairs[record.pair]:
        wanted, given = f"the clouds that {MANIFEST} lists", f"others in {record.pair}.npz"
        raise ConfigError(wanted, given, "make the pairs again in another folder")


def _check_ours(ours: str | None, methods: Sequence[str]) -> None:
    """Raise for a method that nothing was compared with: the table would say that no other one beats it."""
    if ours and ours not in methods:
        raise ConfigError(f"--ours with one of {', '.join(methods)}", ours, "name a method of --methods")


def _check_same_pairs(joined: Sequence[Record], pairs: dict[str, str], out: Path) -> None:
    """Refuse to lose records of another run, or to mix them with these."""
    unknown = [r.pair for r in joined if pairs.get(r.pair) != r.sha256]
    if unknown:
        raise ConfigError("an --out that is empty, or of the same pairs", f"{unknown[0]} in {out}", "choose another")


def _notes(found: Sequence[Record], plan: Plan, conditions: dict[str, list[str]]) -> list[str]:
    """List notes a reader needs before the numbers."""
    notes = []
    wanted, there = len(plan.pairs) * len(plan.methods), len(found)
    if there < wanted:
        notes.append(f"{wanted - there} of {wanted} results are missing: one shard, or an interrupted run.")
    for name, values in conditions.items():
        if len(values) > 1:
            notes.append(f"Results of different {DIFFERENT[name]}: {', '.join(values)}.")
    changed = sorted({f"Settings of {r.method}: {r.settings}." for r in found if r.settings})
    failed = {f"{r.method} on {r.pair} ({r.reason})" for r in found if r.status == ERROR}
    return [*notes, *changed, *(f"Failed: {line}." for line in sorted(failed))]


def _shard(text: str) -> tuple[int, int]:
    try:
        index, count = (int(part) for part in text.split("/"))
    except ValueError:
        index, count = 0, 0
    if not 1 <= index <= count:
        raise ConfigError("--shard i/n with 1 <= i <= n", repr(text), "for example --shard 2/4")
    return index, count


def _command() -> str:
    return " ".join(["gapr", *sys.argv[1:]])


def _commit() -> str:
    """Commit of the source tree that runs, or the version of the installed package."""
    return origin.commit() or f"version {origin.release() or 'unknown'}"
