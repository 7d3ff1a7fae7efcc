"""Freeze the answers to fixed lists of sources, and compare the answers of today with them.

    python benchmarks/yardstick.py --anatomy DIR [--split val] [--lists L2,L3] [--jobs 1] --out FILE.jsonl
    python benchmarks/yardstick.py --out FILE.jsonl --against FROZEN.jsonl [--plot FILE.png]

Lists are drawn by seed from subjects of one split: clean views, L2, L3, sweeps, each sensor family, damage, few points,
wounds with and without a viewpoint, streams of the three classes, mirrored and scaled bones, other subjects. Finished
sources stay in the file, so that a stopped run goes on. Frozen answers: `benchmarks/frozen/`.
"""

from __future__ import annotations

import argparse
import gzip
import json
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import damage
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from gapr_core import Accumulator, LookAccumulator, Registrar, RegistrarConfig, RegistrationResult, Tracker, metrics
from gapr_core.calibration import pairs
from gapr_core.calibration.pairs import Task
from gapr_core.config import SensorConfig
from gapr_core.data.damage import DAMAGES
from gapr_core.data.pair import Pair
from gapr_core.data.pool import specimens
from gapr_core.data.scenes.stream import SceneMotion
from gapr_core.data.scenes.stream import simulate as simulate_scenes
from gapr_core.data.stream import Motion, simulate
from gapr_core.pages import markdown
from gapr_core.pages.plots import reliability_diagram
from gapr_core.runtime.console import say

Row = dict[str, Any]
SEED = 4100
SURE = 0.9
FEW = (12, 20, 30, 50)  # points of the list of few points
FRAMES, LOOKS = 24, 8


class List(NamedTuple):
    """A list of single sources: how a bone is seen, whose it is, how many, and what is left out of the pair."""

    family: str
    source_kind: str
    count: int
    real: bool = False
    few: bool = False
    unnamed: bool = False


SINGLE = {
    "clean": List("clean", "own", 80), "L2": List("L2", "own", 120), "L3": List("L3", "own", 120),
    "wave": List("wave", "own", 40), "waves": List("waves", "own", 40), "gp": List("gp", "own", 40),
    "mixed": List("mixed", "own", 40), "pointer": List("pointer", "own", 60),
    "ultrasound": List("ultrasound", "own", 60),
    "depth-camera": List("depth-camera", "own", 40), "laser": List("laser", "own", 40),
    "structured-light": List("structured-light", "own", 40), "stereo": List("stereo", "own", 40),
    "photogrammetry": List("photogrammetry", "own", 40), "thinned": List("thinned", "own", 40),
    "covered": List("covered", "own", 40), "moving": List("moving", "own", 40),
    "few": List("pointer", "own", 60, few=True),
    "wound": List("scene", "own", 60), "wound-unnamed": List("scene", "own", 30, unnamed=True),
    "wound-stereo": List("scene-stereo", "own", 20), "wound-layers": List("scene-layers", "own", 20),
    "person-L3": List("L3", "person", 120, real=True), "person-L2": List("L2", "person", 60, real=True),
    "person-clean": List("clean", "person", 40, real=True),
    "person-thinned": List("thinned", "person", 40, real=True),
    "person-pointer": List("pointer", "person", 40, real=True), "person-wound": List("scene", "person", 30, real=True),
    "bone": List("L2", "bone", 30), "mirrored": List("clean", "mirrored", 40),
    "mirrored-L3": List("L3", "mirrored", 40),
    "scaled": List("L2", "scaled", 40),
    "drawn-own": List("L3", "own", 200), "drawn-person": List("L3", "person", 400),
}  # fmt: skip
STREAMS = {"tracker": (6, 10), "accumulator": (4, 6), "looks": (3, 4)}  # streams of own bones, of another subject's
ASKING = ("unit", "stand-off", "strained", "apart", "layered")
HEAD = (
    "list", "sources", "right and accepted", "of these at .9", "wrong accepted", "at .9", "bound holds %",
    "bound, median mm", "ECE", "CPU s",
)  # fmt: skip


def main() -> int:
    """Answer the lists, or compare two files of answers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones")
    parser.add_argument("--split", default="val")
    parser.add_argument("--lists", default="", help="with commas; all when not given")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, required=True, help="answers, one JSON object a line (.gz is read, too)")
    parser.add_argument("--against", type=Path, help="frozen answers to compare with")
    parser.add_argument("--plot", type=Path, help="picture of confidence against the share of right poses, own bones")
    parser.add_argument("--jitter", type=Path, metavar="DIR", help="folder of the bones: move points by 1e-4 mm")
    args = parser.parse_args()
    if args.jitter is not None:
        say(jitter(str(args.jitter), args.split))
        return 0
    if args.anatomy is not None:
        names = args.lists.split(",") if args.lists else [*SINGLE, "damage", *STREAMS]
        run(list(cases_of(names, str(args.anatomy), args.split)), args.out, args.jobs)
    now = read(args.out)
    say(table(now) if args.against is None else comparison(read(args.against), now))
    say("\n" + of_checks(now) + "\n\n" + of_evidence(now))
    if args.plot is not None:
        plot({"now": now} if args.against is None else {"before": read(args.against), "now": now}, args.plot)
    return 0


Case = tuple[str, str, str, int, bool]  # list, folder, split, number, and whether the target is another subject's


def cases_of(names: Sequence[str], folder: str, split: str) -> Iterator[Case]:
    """All sources of these lists, those that share a target in a row."""
    for name in names:
        if name in SINGLE:
            yield from ((name, folder, split, number, False) for number in range(SINGLE[name].count))
        elif name == "damage":
            count = len(DAMAGES)
            yield from (("damage", folder, split, number, False) for number in range(6 * count))
            yield from (("damage", folder, split, number, True) for number in range(2 * count))
        else:
            own, others = STREAMS[name]
            yield from ((name, folder, split, number, False) for number in range(own))
            yield from ((name, folder, split, number, True) for number in range(others))


def run(cases: Sequence[Case], path: Path, jobs: int) -> None:
    """Append the answers that the file does not hold yet."""
    done = {(row["list"], row["number"], row["other"]) for row in read(path)} if path.exists() else set()
    left = [case for case in cases if (case[0], case[3], case[4]) not in done]
    path.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool, path.open("a") as file:
        for rows in tqdm(pool.map(answers, left, chunksize=4), total=len(left), unit="source"):
            file.write("".join(json.dumps(row) + "\n" for row in rows))
            file.flush()


def answers(case: Case) -> list[Row]:
    """The answers to one source, or to the frames of one stream."""
    name, folder, split, number, other = case
    common = {"list": name, "number": number, "other": other}
    if name in STREAMS:
        return [common | {"frame": k} | row for k, row in enumerate(stream_answers(name, folder, split, number, other))]
    if name == "damage":
        pair, sensor = damaged(folder, split, number, other), "unknown"
    else:
        pair, sensor = drawn(SINGLE[name], folder, split, number)
    start = time.process_time()
    registrar = registrar_of(sensor)
    target = prepared(registrar, pair)
    prepared_at = time.process_time()
    result = registrar.register(pair.source, target, viewpoint=pair.viewpoint)
    cpu = {"cpu_s": round(time.process_time() - prepared_at, 3), "prepare_s": round(prepared_at - start, 3)}
    return [common | judged(result, pair) | cpu]


def drawn(how: List, folder: str, split: str, number: int) -> tuple[Pair, str]:
    """Source `number` of a list, and the sensor that the user names."""
    found = pairs.draw(Task(folder, split, SEED, number, how.family, how.source_kind, how.real))
    pair = found.pair
    if how.few:
        rng = np.random.default_rng([SEED, number, 5])
        count = min(FEW[number % len(FEW)], len(pair.source))
        pair = replace(pair, source=pair.source[rng.permutation(len(pair.source))[:count]])
    if how.unnamed:
        pair = replace(pair, metadata={name: fact for name, fact in pair.metadata.items() if name != "viewpoint"})
    return pair, found.sensor


@cache
def _bones(folder: str, split: str) -> Any:
    return {bone: specimens(bone, split, 12, Path(folder)) for bone in damage.BONES}


def damaged(folder: str, split: str, number: int, other: bool) -> Pair:
    """Damaged source `number`, kinds and bones in turn; some are of another subject's femur or tibia."""
    kinds = list(damage.CHANGES) if other else list(DAMAGES)
    of = list(damage.NEXT) if other else damage.BONES
    bones = _bones(folder, split)
    return damage.pair_of(kinds[number % len(kinds)], of[number // len(kinds) % len(of)], number, other, bones)


def stream_answers(name: str, folder: str, split: str, number: int, other: bool) -> Iterator[Row]:
    """One stream: femora and tibiae in turn, the target of the subject or of another one."""
    bones = _bones(folder, split)["femur" if number % 2 == 0 else "tibia"]
    own = bones[number // 2 % len(bones)]
    if name == "looks":
        frames = list(
            simulate_scenes(own, SEED + number, SceneMotion(LOOKS, "scene-C1", sway_mm=0.0, sway_deg=0.0, in_room=True))
        )
    else:
        noise_mm, share = 0.6 + 0.3 * (number % 3), 0.12 + 0.06 * (number % 4)
        motion = Motion(FRAMES, share, 1200, noise_mm, 0.8, 0.05, bias_stays=number % 2 == 0)
        motion = replace(motion, step_mm=0.0, step_deg=0.0) if name == "accumulator" else motion
        frames = simulate(own, SEED + number, motion)
    if other:
        others = [each for each in pairs.without_twins(own, bones) if each.person != own.person]
        target = simulate(others[number % len(others)], SEED + number, Motion(frames=1))[0].target
        nowhere = np.full((4, 4), np.nan)
        frames = [replace(frame, target=target, T_target_source=nowhere) for frame in frames]
    registrar = Registrar.from_pretrained(RegistrarConfig(num_threads=1))
    method: Any = Tracker(registrar)
    if name == "accumulator":
        method = Accumulator(method, most=12)
    if name == "looks":
        method = LookAccumulator(registrar, most=4)
    target = method.prepare(frames[0].target)
    for frame in frames:
        start = time.process_time()
        more = {} if frame.viewpoint is None else {"viewpoint": frame.viewpoint}
        result = method.register(frame.source, target, **more)
        yield judged(result, frame) | {"cpu_s": round(time.process_time() - start, 3)}


@cache
def registrar_of(sensor: str) -> Registrar:
    """The shipped registrar, told what measured the source."""
    return Registrar.from_pretrained(RegistrarConfig(num_threads=1, sensor=SensorConfig(kind=sensor)))


_last: list[Any] = []


def prepared(registrar: Registrar, pair: Pair) -> Any:
    """The prepared target; the last one is kept, since sources in a row share a target."""
    if not _last or _last[0] is not pair.target:
        _last[:] = [pair.target, registrar.prepare(pair.target)]
    return _last[1]


def judged(result: RegistrationResult, pair: Pair) -> Row:
    """An answer as it is kept: status, numbers, the best pose and how right that is."""
    best = result.best
    row: Row = {
        "status": str(result.status), "confidence": round(result.confidence, 6), "truth": bool(pair.has_truth),
        "tre95_mm": None if result.tre95_mm is None else round(result.tre95_mm, 4), "right": False,
        "pose": None if best is None else np.round(best[:3], 6).ravel().tolist(), "bone": pair.bone,
        "person": pair.person,
    }  # fmt: skip
    more = {name: getattr(result, name, None) for name in ("pose_probability", "bone_evidence")}
    row["findings"] = [each.check for each in getattr(result, "findings", ())]
    row |= {name: round(value, 5) for name, value in more.items() if value is not None}
    if best is not None and pair.has_truth:
        error = metrics.pose_error(best, pair.T_target_source, pair.source)
        true_mm = metrics.whole_bone_rmse_mm(best, pair.T_target_source, pair.target)
        row |= {"right": bool(error.is_right), "rte_mm": round(error.rte_mm, 4), "rre_deg": round(error.rre_deg, 4),
                "true_mm": round(true_mm, 4)}  # fmt: skip
    return row


def read(path: Path) -> list[Row]:
    """The answers of a file."""
    opened = gzip.open(path, "rt") if path.suffix == ".gz" else path.open()
    with opened as file:
        return [json.loads(line) for line in file if line.endswith("\n")]


def groups_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The answers of each list, streams and damage of another subject's bone apart, and all with and without truth."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["list"] + (", other" if row["other"] else ""), []).append(row)
    own = [row for row in rows if row["truth"]]
    return groups | {"all, own bone": own, "all, no pose": [row for row in rows if not row["truth"]]}


def counts(rows: Sequence[Row]) -> dict[str, Any]:
    """The columns of the table."""
    accepted = [row for row in rows if row["status"] == "OK"]
    right = [row for row in accepted if row["right"]]
    bounded = [row for row in right if row["tre95_mm"] is not None]
    held = [row["true_mm"] <= row["tre95_mm"] for row in bounded]
    confidence, is_right = np.array([row["confidence"] for row in rows]), np.array([row["right"] for row in rows])
    return {
        "sources": len(rows),
        "right": len(right),
        "right_sure": sum(row["confidence"] >= SURE for row in right),
        "wrong": len(accepted) - len(right),
        "wrong_sure": sum(row["confidence"] >= SURE and not row["right"] for row in accepted),
        "held": 100.0 * float(np.mean(held)) if held else np.nan,
        "bound_mm": float(np.median([row["tre95_mm"] for row in bounded])) if bounded else np.nan,
        "ece": metrics.expected_calibration_error(confidence, is_right) if len(rows) >= 30 else np.nan,
        "cpu_s": sum(row["cpu_s"] for row in rows),
    }


def _cells(found: dict[str, Any]) -> list[str]:
    texts = [f"{value:.0f}" if name in ("held", "cpu_s") else f"{value:.3f}" if name == "ece" else f"{value:.2f}"
             if isinstance(value, float) else str(value) for name, value in found.items()]  # fmt: skip
    return ["-" if text == "nan" else text for text in texts]


def table(rows: Sequence[Row]) -> str:
    """One row for each list."""
    return markdown.table(HEAD, [(name, *_cells(counts(group))) for name, group in groups_of(rows).items()])


def comparison(before: Sequence[Row], now: Sequence[Row]) -> str:
    """One row for each list, before > now in each cell; then sure answers at the wrong ones that .9 let pass before."""

    def key(row: Row) -> tuple[Any, ...]:
        return row["list"], row["number"], row["other"], row.get("frame", -1)

    both = {key(row) for row in before} & {key(row) for row in now}
    old, new = (groups_of([row for row in rows if key(row) in both]) for rows in (before, now))
    lines = []
    for name, group in new.items():
        cells = zip(_cells(counts(old[name])), _cells(counts(group)), strict=True)
        lines.append((name, *(a if a == b else f"{a} > {b}" for a, b in cells)))
    allowed = counts(list(old["all, own bone"]) + list(old["all, no pose"]))["wrong_sure"]
    sure = [sure_right(groups["all, own bone"] + groups["all, no pose"], allowed) for groups in (old, new)]
    text = f"at {allowed} wrong ones (as many as .9 let pass before), right ones: {sure[0]} > {sure[1]}"
    return markdown.table(HEAD, lines) + f"\n\n{text}"


def of_checks(rows: Sequence[Row]) -> str:
    """What each refusing check changes: answers that would be accepted without it, right, wrong and of no pose."""
    counted: dict[str, list[int]] = {}
    for row in rows:
        refusing = [name for name in row.get("findings", ()) if name not in ASKING]
        if row["status"] == "OK" or len(refusing) != 1 or row["confidence"] < 0.5:
            continue
        kind = 0 if row["right"] else 1 if row["truth"] else 2
        counted.setdefault(refusing[0], [0, 0, 0])[kind] += 1
    head = ("check", "right poses lost", "wrong poses kept out", "other bones kept out")
    return markdown.table(head, [(name, *values) for name, values in sorted(counted.items())])


def of_evidence(rows: Sequence[Row]) -> str:
    """Share of other subjects' pairs that the evidence doubts where it doubts 1 % and 5 % of own right answers."""
    own = [row["bone_evidence"] for row in rows if row["truth"] and row["right"] and "bone_evidence" in row]
    pairs_of: dict[tuple[str, ...], list[float]] = {}
    for row in rows:
        if "person" in row["list"] and "bone_evidence" in row:
            pairs_of.setdefault((row["list"], row["person"], str(row["number"])), []).append(row["bone_evidence"])
    if not own or not pairs_of:
        return ""
    means = np.array([np.mean(each) for each in pairs_of.values()])
    lines = []
    for share in (0.01, 0.05):
        doubted = means < np.quantile(own, share)
        low, high = metrics.share_interval(doubted.tolist(), [key[1] for key in pairs_of])
        lines.append((f"{share:.0%}", f"{doubted.mean():.3f} [{low:.3f}-{high:.3f}]", len(means), len(own)))
    return markdown.table(("own bones doubted", "pairs of subjects doubted", "pairs", "own"), lines)


def plot(answers: dict[str, Sequence[Row]], path: Path) -> None:
    """Draw the share of right poses over the confidence, one line for each file of answers."""
    records: Any = [SimpleNamespace(method=name, confidence=row["confidence"], best_right=row["right"])
                    for name, rows in answers.items() for row in rows if row["truth"]]  # fmt: skip
    reliability_diagram(records, list(answers)).savefig(path, dpi=150)


def jitter(folder: str, split: str, sources: int = 50, draws: int = 8) -> str:
    """Largest change of the confidence when the points of a source move by 1e-4 mm."""
    largest = []
    for number in tqdm(range(sources), unit="source"):
        pair, sensor = drawn(List("pointer" if number % 2 else "L3", "own", 0), folder, split, number)
        rng = np.random.default_rng([SEED, number, 6])
        count = int(np.exp(rng.uniform(np.log(12), np.log(400))))
        source = pair.source[rng.permutation(len(pair.source))[:count]]
        registrar = registrar_of(sensor)
        target = prepared(registrar, pair)
        moved = [source, *(source + rng.normal(0.0, 1e-4, source.shape) for _ in range(draws))]
        found = [registrar.register(each, target).confidence for each in moved]
        largest.append(max(found) - min(found))
    over = sum(change > 0.02 for change in largest)
    return f"{sources} sources, {draws} draws: largest change {max(largest):.4f}, above .02 in {over}"


def sure_right(rows: Sequence[Row], wrong: int) -> int:
    """How many accepted right poses a threshold keeps that lets so many wrong ones pass."""
    accepted = sorted((row for row in rows if row["status"] == "OK"), key=lambda row: -row["confidence"])
    off = np.cumsum([not row["right"] for row in accepted])
    kept: NDArray[np.bool_] = off <= wrong
    return int((kept & np.array([row["right"] for row in accepted])).sum())


if __name__ == "__main__":
    raise SystemExit(main())
