"""Records to learn from: every pair registered by every kind of round, and judged.

The registrars here accept everything (`ACCEPTING`): no model of the confidence may select the records that it is fitted
to. Finished pairs stay in the records file, so that a stopped run goes on where it was.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from gapr_core import metrics
from gapr_core.calibration import pairs, streams
from gapr_core.calibration.answers import STREAM, kind_of
from gapr_core.calibration.pairs import Drawn, Task
from gapr_core.config import ClutterConfig, RegistrarConfig, SensorConfig
from gapr_core.data.pair import Pair
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.geometry import se3
from gapr_core.geometry.sampling import random_directions
from gapr_core.registration.checks.assessment import Assessment
from gapr_core.registration.confidence.additive import Additive
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.confidence.features import FEATURES_OF
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.proposals.network import SHIPPED, NetworkProposer
from gapr_core.registration.proposals.search import NormalAlignedSearch, Proposer
from gapr_core.registration.registrar import Registrar
from gapr_core.registration.scenes import clutter
from gapr_core.registration.streams.memory import PreviousPoses
from gapr_core.registration.uncertainty.error_calibration import Precision
from gapr_core.results import Hypothesis, Refusal
from gapr_core.runtime import cluster, origin
from gapr_core.runtime.clock import Clock
from gapr_core.runtime.files import write_text
from gapr_core.runtime.parallel import end_with_parent

Array = NDArray[np.float64]
Record = dict[str, Any]
Shared = tuple[str, str, pairs.Bones]  # folder, split and the bones of both
STEP_MM, STEP_DEG = 10.0, 10.0  # of a stream: the largest motion from source to source
FOLLOWED = 0.5  # share of the pairs that become a stream
LOOKED_AT = 3  # every third cloud of bone alone is also registered as a scene, where one camera may have seen it
ALONE = 4  # every fourth pair is searched without the network's poses, as a user without torch does
FORGOTTEN = 0.25  # share of the streams whose best pose is forgotten
AS_IT_IS = ClutterConfig(infer_viewpoint=False)  # a cloud refused as bone alone is recorded as such
SETTINGS = RegistrarConfig(num_threads=1, clutter=AS_IT_IS)
# log odds of 0.9 and a sure bone: above `min_confidence`, below `sure`, so that every round runs
ACCEPTING = Classifier(dict.fromkeys(FEATURES_OF, Additive(2.2, ())), dict.fromkeys(FEATURES_OF, Additive(9.0, ())))


def collect(tasks: Sequence[Task], path: Path, jobs: int, dask: str | None = None) -> list[Record]:
    """Register every pair that the records file does not hold yet, or holds of other bones, models or settings.

    Args:
        tasks: tasks of one folder and split.
        path: file of the records, one JSON object a line.
        jobs: processes.
        dask: address of a Dask cluster to use instead; its workers see the folder of the bones.

    Returns:
        The records of these tasks.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    wanted, bones = {_name(task) for task in tasks}, (_anatomy(tasks[0]), tasks[0].split)
    of_these = [record for record in _read(path) if (record.get("anatomy"), record.get("split")) == bones]
    made_of = _made_of(tasks[0].folder)
    done = {record["name"]: record for record in of_these if _is_current(record, made_of)}
    left = [task for task in tasks if _name(task) not in done]
    where = (tasks[0].folder, tasks[0].split)
    shared = *where, pairs.bones_of(*where) if left else {}
    records = _on_cluster(left, dask, shared) if dask else _in_processes(left, jobs, shared)
    with path.open("a") as file:
        for made in tqdm(records, total=len(left), unit="pair"):
            record = made | {"made_of": made_of[_is_stream(made)]}
            file.write(json.dumps(record) + "\n")
            file.flush()
            done[record["name"]] = record
    return [record for name, record in done.items() if name in wanted]


def _in_processes(tasks: Sequence[Task], jobs: int, shared: Shared) -> Iterator[Record]:
    with ProcessPoolExecutor(jobs, get_context("spawn"), _start, shared) as pool:
        yield from pool.map(record_of, tasks, chunksize=pairs.IN_A_ROW)


def _start(*shared: Any) -> None:
    end_with_parent()
    pairs.keep(*shared)


def _on_cluster(tasks: Sequence[Task], address: str, shared: Shared) -> Iterator[Record]:
    rows = [tasks[i : i + pairs.IN_A_ROW] for i in range(0, len(tasks), pairs.IN_A_ROW)]  # they share a target
    for records in cluster.results(address, _records_of, rows, shared):
        yield from records


def _records_of(tasks: Sequence[Task], shared: Shared) -> list[Record]:
    pairs.keep(*shared)
    return [record_of(task) for task in tasks]


def record_of(task: Task) -> Record:
    """Register and judge one pair in every way, or the frames of a stream one after another."""
    named = {"name": _name(task), "anatomy": _anatomy(task), "split": task.split, "commit": origin.commit(),
             "settings": origin.settings(SETTINGS)}  # fmt: skip
    if task.family == STREAM:
        return named | streams.record_of_stream(task)
    drawn = pairs.draw(task)
    target = _prepared(drawn.pair.target)
    facts = {"family": drawn.family, "seen_as": drawn.seen_as, "what": drawn.what, "sensor": drawn.sensor,
             "bone": drawn.pair.bone, "people": list(drawn.people)}  # fmt: skip
    return named | facts | {"answers": dict(_answers(drawn, target, task))}


def _answers(drawn: Drawn, target: PreparedTarget, task: Task) -> Iterator[tuple[str, Record]]:
    """Yield (round, answer of the round and its errors)."""
    rng = np.random.default_rng([task.seed, task.number, 17])
    registrars = _registrars(drawn.sensor)
    if drawn.family in pairs.SCENES or task.number % LOOKED_AT == 0:
        registrar = registrars["first round" if task.number % 2 else "search"]
        for number, viewpoint in enumerate(_viewpoints(drawn.pair)):
            in_scene = registrar.assess(drawn.pair.source, target, viewpoint=viewpoint)
            if isinstance(in_scene, Assessment):
                yield f"{clutter.NAME} {number}", judged_answer(in_scene, drawn.pair)
    if drawn.family in pairs.SCENES:
        return
    of_round = {"network": "network", "search": "search alone" if task.number % ALONE == 0 else "search"}
    found = {name: registrars[used].assess(drawn.pair.source, target) for name, used in of_round.items()}
    for name, assessment in found.items():
        if isinstance(assessment, Assessment):
            yield name, judged_answer(assessment, drawn.pair)
    last = found["network" if task.number % 2 else "search"]
    if rng.random() < FOLLOWED and isinstance(last, Assessment) and len(last.hypotheses) > 1:
        moved, memory = moved_on(drawn.pair, last.hypotheses, rng)
        tracked = accepting([memory], drawn.sensor).assess(moved.source, target)
        if isinstance(tracked, Assessment):
            yield memory.name, judged_answer(tracked, moved)


def _viewpoints(pair: Pair) -> Array:
    """Return (N, 3) mm: the place of the camera, or every place that the registrar would infer for this cloud.

    Of a cloud that is refused as bone both ends of its line of sight are tried, the wrong one too.
    """
    if pair.viewpoint is not None:
        return np.asarray(pair.viewpoint)[None]
    try:
        prepared = sources.prepare(pair.source, in_scene=True)
    except InvalidPointCloudError:  # of all points some are metres away
        return np.empty((0, 3))
    if isinstance(prepared, Refusal):
        return np.empty((0, 3))
    return np.reshape([place for place, _ in clutter.inferred_places(prepared, RegistrarConfig())], (-1, 3))


def judged_answer(assessment: Assessment, pair: Pair) -> Record:
    """Record the features of an answer, its refusal, and its errors where there is a truth."""
    features = {name: round(value, 6) for name, value in assessment.features.items()}
    refusal = assessment.refusal.check if assessment.refusal else None
    record: Record = {"features": features, "refusal": refusal, "right": False}
    if not pair.has_truth:
        return record
    T, truth = assessment.fit.T, pair.T_target_source
    error = metrics.pose_error(T, truth, pair.source)
    twist = metrics.error_twist(T, truth, assessment.source.points)
    return record | {
        "right": error.is_right,
        "rte_mm": error.rte_mm,
        "rre_deg": error.rre_deg,
        "nees": metrics.nees(twist, assessment.uncertainty.covariance),
        "true_mm": metrics.whole_bone_rmse_mm(T, truth, pair.target),
        "tre_mm": assessment.tre_mm,
        "tre95_mm": assessment.tre95_mm,
    }


def moved_on(pair: Pair, hypotheses: Sequence[Hypothesis], rng: np.random.Generator) -> tuple[Pair, PreviousPoses]:
    """Simulate the next source of a stream, and the previous poses of its `Tracker`.

    A part of the view is lost at one side, and the source has moved by up to 10 mm and 10 deg about its centroid. In
    one case of four the best pose is forgotten: the tracker followed a rival.
    """
    along = pair.source @ random_directions(1, rng)[0]
    seen = pair.source[along <= np.quantile(along, rng.uniform(0.7, 1.0))]
    source = seen[rng.permutation(len(seen))[: round(rng.uniform(0.7, 1.0) * len(seen))]]
    turn = np.radians(rng.uniform(0.0, STEP_DEG)) * random_directions(1, rng)[0]
    shift = rng.uniform(0.0, STEP_MM) * random_directions(1, rng)[0]
    memory = PreviousPoses()
    poses = np.stack([hypothesis.T_target_source for hypothesis in hypotheses])
    memory.poses = poses @ se3.exp(np.concatenate([shift, turn]), source.mean(axis=0))
    if rng.random() < FORGOTTEN and len(memory.poses) > 2:
        memory.poses = memory.poses[1:]
    return replace(pair, source=source), memory


@dataclass(eq=False)
class AskedOnce:
    """A proposer whose last answer is kept for two registrars with the same source."""

    proposer: Proposer

    def __post_init__(self) -> None:
        self.name = self.proposer.name
        self._last: tuple[Array, Array, Array] | None = None

    def prepare(self, target: PreparedTarget) -> None:
        """Prepare the proposer."""
        self.proposer.prepare(target)

    def propose(self, source: PreparedSource, target: PreparedTarget, rng: np.random.Generator) -> Array:
        """Propose as the proposer, or return its last answer for the same points and target."""
        last = self._last
        if last is None or last[1] is not target.points or not np.array_equal(last[0], source.points):
            self._last = last = source.points, target.points, self.proposer.propose(source, target, rng)
        return last[2]


def accepting(proposers: Sequence[Proposer], sensor: str, clutter_config: ClutterConfig = AS_IT_IS) -> Registrar:
    """Make a registrar that uses all proposers, accepts every answer and leaves its covariance as computed."""
    config = replace(SETTINGS, sensor=SensorConfig(kind=sensor), clutter=clutter_config)
    return Unmirrored(config, proposers, ACCEPTING, Precision.unscaled())


class Unmirrored(Registrar):
    """Registers no mirror images: no feature rests on them."""

    def _of_image(self, flipped: PreparedSource, target: PreparedTarget, clock: Clock) -> None:
        return None


@cache
def _proposers() -> tuple[Proposer, Proposer]:
    network = AskedOnce(NetworkProposer.from_weights())
    return network, NormalAlignedSearch(RegistrarConfig().search, num_threads=1)


@cache
def _registrars(sensor: str) -> dict[str, Registrar]:
    """Return the default registrar, its slower second pass, and those that users may ask for instead.

    "first round" is that of a scene, of which "search" answers after the last one.
    """
    network, search = _proposers()
    return {
        "network": accepting([network], sensor),
        "search": accepting([network, search], sensor),
        "search alone": accepting([search], sensor),
        "first round": accepting([search], sensor, replace(AS_IT_IS, rounds=1)),
    }


_last_target: list[tuple[Array, PreparedTarget]] = []  # the last cloud and its prepared target


def _prepared(cloud: Array) -> PreparedTarget:
    """Prepare a target; the last one is kept, since pairs in a row share a target."""
    if not _last_target or _last_target[0][0] is not cloud:
        _last_target[:] = [(cloud, _registrars("unknown")["search"].prepare(cloud))]
    return _last_target[0][1]


def _name(task: Task) -> str:
    return "-".join(filter(None, (str(task.seed), task.family, task.what, str(task.number))))


def _anatomy(task: Task) -> str:
    """Return the folder's own name, which is the same on all machines."""
    return Path(task.folder).resolve().name


def _read(path: Path) -> list[Record]:
    """Read every whole record, and cut an incomplete last line out of the file."""
    if not path.is_file():
        return []
    *whole, cut_off = path.read_text().split("\n")
    if cut_off:
        write_text(path, "".join(f"{line}\n" for line in whole))
    try:
        return [json.loads(line) for line in whole]
    except ValueError as error:
        raise ConfigError(
            "one record a line", f"{path}: {error}", "move the file away, or give another --out"
        ) from error


def _made_of(folder: str) -> dict[bool, str]:
    """Digest the folder's bones and the network (False) or, for streams, any model (True), as short texts."""
    bones = origin.digest_of(sorted(path for path in Path(folder).glob("*") if path.suffix in (".npz", ".json")))
    return {False: f"{bones} {origin.digest_of([SHIPPED])}", True: f"{bones} {origin.shipped_weights()}"}


def _is_stream(record: Record) -> bool:
    return str(record.get("seen_as")) == STREAM


def _is_current(record: Record, made_of: dict[bool, str]) -> bool:
    answers = record.get("answers", {}).items()
    of_frames = ("pose", "bone")
    return (
        record.get("settings") == origin.settings(SETTINGS)
        and record.get("made_of") == made_of[_is_stream(record)]
        and all(set(FEATURES_OF.get(kind_of(name), of_frames)) == set(answer["features"]) for name, answer in answers)
    )
