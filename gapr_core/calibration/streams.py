"""Streams that the confidence of a `Tracker` learns from: what the frames say together of own and of other bones.

The frames are answered by the models that are installed: those of single answers are fitted first. Each stream has its
own noise, and a smooth bias of one kind, drawn again for each frame or, as that of soft tissue, the same in all.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from gapr_core import metrics
from gapr_core.calibration import pairs
from gapr_core.calibration.pairs import Task
from gapr_core.config import RegistrarConfig
from gapr_core.data.pair import Pair
from gapr_core.data.stream import Motion, simulate
from gapr_core.geometry.sampling import log_uniform
from gapr_core.registration.confidence.additive import Additive, Curve
from gapr_core.registration.confidence.classifier import LARGEST_LOG_ODDS, Calibration
from gapr_core.registration.confidence.features import STREAM, STREAM_FEATURES
from gapr_core.registration.registrar import Registrar
from gapr_core.registration.streams.tracker import Tracker
from gapr_core.results import RegistrationResult

FRAMES = 12
JUMPS = 0.2  # share of the streams in which the bone is somewhere else halfway
BIASES = {
    "wave": {"wave": 1.5},
    "waves": {"waves-peak": 1.5, "waves-rms": 1.06},
    "gp": {"gp-peak": 1.5, "gp-rms": 1.06},
}  # family: kinds of smooth bias, and the largest size of each, mm, that of L3
STREAM_SEEDS = 900  # added to the seed: other targets than those of single pairs


def tasks(folder: str, split: str, seed: int, count: int) -> list[Task]:
    """Every other one as `pairs.WHAT` says; the others are of a subject's femur or tibia on that of another subject.

    Most frames of other bones are refused by a rule and say nothing: with fewer, almost all that is left is right.
    """
    bones = len(pairs.BONES)
    long = [number for number in range(bones * count) if pairs.BONES[number % bones] in pairs.LOOK_ALIKES]
    found = [Task(folder, split, seed, number, STREAM) for number in range((count + 1) // 2)]
    return found + [Task(folder, split, seed, number, STREAM, "person", True) for number in long[: count // 2]]


def record_of_stream(task: Task) -> dict[str, Any]:
    """The facts of a stream, and an answer "stream K" for each frame of which those before it say something."""
    family, what, people, frames = draw_stream(task)
    tracker, target = tracker_of_frames_alone(), _registrar().prepare(frames[0].target)
    answers = {}
    for number, frame in enumerate(frames):
        result = tracker.register(frame.source, target)
        if STREAM_FEATURES[-1] in result.features:
            answers[f"{STREAM} {number}"] = judged_frame(result, frame)
    return {"family": f"stream-{family}", "seen_as": "stream", "what": what, "sensor": "unknown",
            "bone": frames[0].bone, "people": list(people), "answers": answers}  # fmt: skip


def draw_stream(task: Task) -> tuple[str, str, tuple[str, ...], list[Pair]]:
    """(family of the bias, key of `pairs.WHAT`, everybody whose bone it is, frames on one target); always the same."""
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


def judged_frame(result: RegistrationResult, frame: Pair) -> dict[str, Any]:
    """The features of a frame in its stream, and whether its best pose is right.

    What a rule refuses has no such features.
    """
    features = {name: round(result.features[name], 6) for name in STREAM_FEATURES}
    record = {"features": features, "refusal": None, "right": False}
    if not frame.has_truth:
        return record
    error = metrics.pose_error(result.hypotheses[0].T_target_source, frame.T_target_source, frame.source)
    return record | {"right": error.is_right, "rte_mm": error.rte_mm, "rre_deg": error.rre_deg}


def tracker_of_frames_alone() -> Tracker:
    """A tracker for one stream that counts its frames one by one, whatever misfit they share."""
    limits = np.array([-LARGEST_LOG_ODDS, LARGEST_LOG_ODDS])
    nothing = tuple(Curve(name, np.zeros(1), np.zeros(1)) for name in STREAM_FEATURES[1:])
    same = Additive(0.0, (Curve(STREAM_FEATURES[0], limits, limits), *nothing))
    return Tracker(_registrar(), stream=Calibration(STREAM, same, {}))


@cache
def _registrar() -> Registrar:
    return Registrar.from_pretrained(RegistrarConfig(num_threads=1)).of_bone_alone()
