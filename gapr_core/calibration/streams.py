"""Streams that the evidence of a `Tracker` learns from: the correlation of the numbers of their frames.

The installed models answer the frames: those of single answers are fitted first. Each stream has its own noise and a
smooth bias of one kind, drawn again for each frame or, as that of soft tissue, the same in all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core import metrics
from gapr_core.calibration import pairs
from gapr_core.calibration.answers import STREAM
from gapr_core.calibration.pairs import Task
from gapr_core.config import RegistrarConfig
from gapr_core.data.pair import Pair
from gapr_core.data.stream import Motion, simulate
from gapr_core.geometry.sampling import log_uniform
from gapr_core.registration.confidence.classifier import Judgement
from gapr_core.registration.registrar import Registrar
from gapr_core.registration.streams.evidence import Evidence
from gapr_core.registration.streams.tracker import Tracker
from gapr_core.results import RegistrationResult

Array = NDArray[np.float64]

FRAMES = 12
UNKNOWN_RHO = 0.8
JUMPS = 0.2  # share of the streams in which the bone jumps halfway
BIASES = {
    "wave": {"wave": 1.5},
    "waves": {"waves-peak": 1.5, "waves-rms": 1.06},
    "gp": {"gp-peak": 1.5, "gp-rms": 1.06},
}  # family: kinds of smooth bias, and the largest size of each, mm, that of L3
STREAM_SEEDS = 900  # added to the seed, for other targets than those of single pairs


def tasks(folder: str, split: str, seed: int, count: int) -> list[Task]:
    """List streams: every other one by `pairs.WHAT`, the others of a femur or tibia on that of another subject.

    Most frames of other bones are refused by a rule and do not count: with fewer, almost all that count are right.
    """
    bones = len(pairs.BONES)
    long = [number for number in range(bones * count) if pairs.BONES[number % bones] in pairs.LOOK_ALIKES]
    found = [Task(folder, split, seed, number, STREAM) for number in range((count + 1) // 2)]
    return found + [Task(folder, split, seed, number, STREAM, "person", True) for number in long[: count // 2]]


def record_of_stream(task: Task) -> dict[str, Any]:
    """Track a stream whose frames count one by one; an answer "stream K" holds the numbers of each frame alone."""
    family, what, people, frames = draw_stream(task)
    tracker = Tracker(_registrar())
    witness = tracker._evidence = OneByOne(1.0, 1.0)
    target, answers = tracker.prepare(frames[0].target), {}
    for number, frame in enumerate(frames):
        seen = len(witness.frames)
        result = tracker.register(frame.source, target)
        if len(witness.frames) > seen:
            answers[f"{STREAM} {number}"] = judged_frame(result, witness.frames[-1], frame)
    return {"family": f"stream-{family}", "seen_as": "stream", "what": what, "sensor": "unknown",
            "bone": frames[0].bone, "people": list(people), "answers": answers}  # fmt: skip


class OneByOne(Evidence):
    """Evidence that keeps the numbers of each frame and leaves them as they are."""

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self.frames: list[Judgement] = []

    def observe(self, frame: Judgement, agrees: bool, again: bool = False) -> Judgement:
        """Keep a frame."""
        self.frames.append(frame)
        return frame


def draw_stream(task: Task) -> tuple[str, str, tuple[str, ...], list[Pair]]:
    """Draw (family of the bias, key of `pairs.WHAT`, all subjects of the bones, frames on one target).

    The same task always gives the same stream.
    """
    rng = np.random.default_rng([task.seed, task.number, 63, len(task.what)])
    setting = pairs.setting_of(task.folder, task.split, task.seed + STREAM_SEEDS, task.number, task.real)
    what, source = pairs.source_of(task, setting, rng)
    family = str(rng.choice(sorted(BIASES)))
    kind = str(rng.choice(sorted(BIASES[family])))
    motion = Motion(
        frames=FRAMES,
        share=rng.uniform(0.08, 0.35),
        points=round(log_uniform((400, 3000), rng)),
        noise_mm=rng.uniform(0.3, 1.6),
        bias_mm=rng.uniform(0.0, BIASES[family][kind]),
        outlier_share=rng.uniform(0.0, 0.2),
        smooth_bias=kind,
        bias_stays=bool(rng.random() < 0.5),
        step_mm=rng.uniform(0.0, 5.0),
        swing_deg=rng.uniform(10.0, 60.0),
        jump_every=FRAMES // 2 if rng.random() < JUMPS else 0,
    )
    frames = simulate(source, int(rng.integers(2**31)), motion)
    people = tuple(dict.fromkeys((setting.whole.person, source.person)))
    return family, what, people, [pairs.before(setting, source, what, frame) for frame in frames]


def judged_frame(result: RegistrationResult, numbers: Judgement, frame: Pair) -> dict[str, Any]:
    """Record the numbers of a frame alone, and whether its best pose is right."""
    record: dict[str, Any] = {
        "features": {"pose": round(numbers.pose_log_odds, 5), "bone": round(numbers.bone_evidence, 5)},
        "refusal": None,
        "right": False,
    }
    if frame.has_truth and result.best is not None:
        record["right"] = metrics.pose_error(result.best, frame.T_target_source, frame.source).is_right
    return record


def correlations(records: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """Fit rho of both numbers: the share of their variance that the frames of a stream have in common.

    One-way analysis of variance within each class (Searle 1971): own bones with right poses for the pose; own bones and
    other subjects' for the bone. Without streams .8 each.
    """
    own, others = [], []
    for record in records:
        if not str(record["name"]).split("-")[1:2] == [STREAM]:
            continue
        frames = [answer for answer in record["answers"].values()]
        right = [answer["features"] for answer in frames if answer["right"]]
        if record["what"] == "own" and len(right) > 1:
            own.append(np.array([[f["pose"], f["bone"]] for f in right]))
        if record["what"] == "person" and len(frames) > 1:
            others.append(np.array([[a["features"]["pose"], a["features"]["bone"]] for a in frames]))
    pose = _components([each[:, 0] for each in own])
    bone = _components([each[:, 1] for each in own]) + _components([each[:, 1] for each in others])
    return _share(pose), _share(bone)


def _components(streams: Sequence[Array]) -> Array:
    """Estimate (2,) the variance between streams and within them, weighted with the number of streams."""
    if len(streams) < 2:
        return np.zeros(2)
    counts = np.array([len(each) for each in streams], dtype=float)
    means = np.array([each.mean() for each in streams])
    within = sum(float(((each - each.mean()) ** 2).sum()) for each in streams) / max(counts.sum() - len(streams), 1.0)
    between = float(means.var(ddof=1)) - within * float((1.0 / counts).mean())
    return len(streams) * np.array([max(between, 0.0), within])


def _share(components: Array) -> float:
    total = float(components.sum())
    return round(float(components[0] / total), 3) if total > 0.0 else UNKNOWN_RHO


@cache
def _registrar() -> Registrar:
    return Registrar.from_pretrained(RegistrarConfig(num_threads=1)).of_bone_alone()
