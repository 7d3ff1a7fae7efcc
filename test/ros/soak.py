"""Hours at 10 Hz through nodes in their own processes: every cloud is answered or counted, and memory stays flat.

python test/ros/soak.py [--minutes 10] [--hz 10] [--kinds sweeps scenes] [--out FOLDER]

Sweeps: a probe wanders over one side of a bone that moves, and loses it now and then. Scenes: a camera circles a wound
with soft tissue, retractors and hands. A node for each kind, one after the other; the time is shared between them. With
`--out` it writes `soak.png` and `soak.json`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import bones
import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from harness import NODE, Client, NodeProcess, wait_until
from rclpy.time import Time
from std_msgs.msg import Header

from gapr_core.data import stream
from gapr_core.data.pair import TARGET_POINTS, Pair
from gapr_core.data.parametric import make_bone
from gapr_core.data.scenes import stream as scenes
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3
from gapr_ros.node import units
from gapr_ros.node.outcome import stamp_ns
from msg_adapters import pose_to_matrix, xyz_to_cloud

SEED, SUBJECT = 3, 900_001  # a subject that no training draws
DISTINCT = 200  # clouds; they come again and again, to and fro
MOST_GROWTH = 0.02
START_S = 900.0
NOT_NOW = ("accepted", "refused", "dropped", "lost")


def sweeps(bone: Specimen, frames: int) -> list[Pair]:
    """A probe's views."""
    return stream.simulate(bone, SEED, stream.Motion(frames=frames, jump_every=50))


def a_scene(bone: Specimen, frames: int) -> list[Pair]:
    """A camera's views, each in the camera's frame."""
    return list(scenes.simulate(bone, SEED, scenes.SceneMotion(frames=frames)))


KINDS: dict[str, tuple[Callable[[Specimen, int], list[Pair]], dict[str, Any]]] = {
    "sweeps": (sweeps, {}),
    "scenes": (a_scene, {"viewpoint": "origin"}),
}


@dataclass
class Soak:
    """What came out of one kind of clouds.

    Attributes:
        sent: clouds that were published.
        received, accepted, refused, dropped, lost: as the node counts them.
        reasons: of the refusals.
        statuses, transforms: how many messages arrived.
        answered_s, latency_s: when each answer came, and how long after its cloud was sent; in order.
        errors_mm: of the poses that were heard, at the cloud's centroid.
        rss_mb: of the node, once a second.
        exit_code: after SIGINT.
    """

    kind: str
    sent: int = 0
    received: int = 0
    accepted: int = 0
    refused: int = 0
    dropped: int = 0
    lost: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    statuses: int = 0
    transforms: int = 0
    answered_s: list[float] = field(default_factory=list, repr=False)
    latency_s: list[float] = field(default_factory=list, repr=False)
    errors_mm: list[float] = field(default_factory=list, repr=False)
    rss_mb: list[float] = field(default_factory=list, repr=False)
    exit_code: int = -1

    @property
    def growth(self) -> float:
        """By what share the median memory of the last quarter is above that of the second quarter."""
        quarter = max(len(self.rss_mb) // 4, 1)
        before = float(np.median(self.rss_mb[quarter : 2 * quarter]))
        return (float(np.median(self.rss_mb[-quarter:])) - before) / before

    @property
    def report(self) -> str:
        """Four lines."""
        p50, p99 = np.percentile(self.latency_s, [50, 99]) * 1000.0
        reasons = ", ".join(f"{name} {count}" for name, count in sorted(self.reasons.items())) or "none"
        wrong = sum(error > 4.0 for error in self.errors_mm)
        return (
            f"{self.kind}: sent {self.sent}  received {self.received}  accepted {self.accepted}  refused {self.refused}"
            f"  dropped {self.dropped}  lost {self.lost}\n"
            f"  refusals: {reasons}\n"
            f"  from the cloud to its answer: p50 {p50:.0f} ms, p99 {p99:.0f} ms, longest {max(self.latency_s):.2f} s\n"
            f"  poses heard: {len(self.errors_mm)}, {wrong} farther off than 4 mm, median error "
            f"{np.median(self.errors_mm or [np.nan]):.2f} mm\n"
            f"  memory: {min(self.rss_mb):.0f} to {max(self.rss_mb):.0f} MB, growth {100.0 * self.growth:+.2f} %\n"
        )

    def check(self) -> None:
        """Raise AssertionError for whatever must not happen."""
        assert self.received + self.lost == self.sent, self
        assert self.accepted + self.refused + self.dropped == self.received, self
        assert self.statuses == self.accepted + self.refused == len(self.latency_s), "every processed cloud answers"
        assert self.transforms == self.accepted > 0, self
        assert self.growth < MOST_GROWTH, (self.growth, self.rss_mb)
        assert self.exit_code == 0, self


def soak(folder: Path, kind: str, seconds: float, hz: float = 10.0, distinct: int = DISTINCT) -> Soak:
    """Start a node, send it clouds for a while, count."""
    bone = Specimen(make_bone("femur", SUBJECT), "femur", "soak")
    make, parameters = KINDS[kind]
    pairs = make(bone, distinct)
    clouds = [(units.to_metres(pair.source).astype(np.float32), _truth(pair, bone)) for pair in pairs]
    model = bones.save(bone.surface, folder / f"{kind}.npz")
    client, result = Client(), Soak(kind)
    node = NodeProcess(folder, model_path=model, model_unit="mm", **parameters)
    try:
        wait_until(
            lambda: node.process.poll() is not None or client.values().get("state") == "active", START_S, "a node"
        )
        assert node.process.poll() is None, node.log
        client.wait_for_state("active")
        sent, truths = _listen(client, result), {}
        begin, steps = time.monotonic(), [*range(distinct), *range(distinct - 2, 0, -1)]
        while time.monotonic() - begin < seconds:
            points, truth = clouds[steps[result.sent % len(steps)]]
            key = time.time_ns()
            sent[key], truths[key] = time.monotonic(), (points, truth)
            client.send(xyz_to_cloud(points, Header(frame_id="probe", stamp=Time(nanoseconds=key).to_msg())))
            result.sent += 1
            if result.sent % round(hz) == 0:
                result.rss_mb.append(node.rss_mb())
            time.sleep(max(0.0, begin + result.sent / hz - time.monotonic()))
        _count(client, node, result)
        result.answered_s = [at - begin for at in result.answered_s]
        result.errors_mm = [_error_mm(pose, *truths[stamp_ns(pose.header)]) for pose in client.poses]
    finally:
        client.close()
        result.exit_code = node.stop()
    return result


def _listen(client: Client, result: Soak) -> dict[int, float]:
    """Note every answer; returns the dict in which the caller notes when it sent the cloud of a stamp."""
    sent: dict[int, float] = {}

    def note(status: DiagnosticStatus) -> None:
        now, values = time.monotonic(), {pair.key: pair.value for pair in status.values}
        result.answered_s.append(now)
        result.latency_s.append(now - sent[int(values["stamp"].replace(".", ""))])
        if values["reason"]:
            result.reasons[values["reason"]] = result.reasons.get(values["reason"], 0) + 1

    client.do(lambda: client.node.create_subscription(DiagnosticStatus, f"{NODE}/status", note, 1000))
    wait_until(lambda: client.node.count_publishers(f"{NODE}/status"), 20.0, "~/status")
    time.sleep(1.0)  # the publisher knows of the listener a moment later
    return sent


def _count(client: Client, node: NodeProcess, result: Soak) -> None:
    """Wait until every cloud is accounted for."""

    def count(kind: str) -> int:
        return int(client.values()[f"frames_{kind}"])

    def is_settled() -> bool:
        assert node.process.poll() is None, node.log
        return sum(map(count, NOT_NOW)) == result.sent

    wait_until(is_settled, 120.0, f"{result.sent} clouds; {client.values()}")
    for kind in ("received", *NOT_NOW):
        setattr(result, kind, count(kind))
    time.sleep(1.0)
    result.statuses, result.transforms = len(client.statuses), len(client.transforms)


def _truth(pair: Pair, bone: Specimen) -> np.ndarray:
    """T_model_source (4, 4), mm: pairs have a centred target, the model's file has the bone's own frame."""
    origin = pair.metadata.get("origin_mm")
    if origin is None:
        target, _ = bone.sample(TARGET_POINTS, np.random.default_rng([SEED, 23]))  # as `stream.simulate` draws it
        origin = target.mean(axis=0)
        np.testing.assert_allclose(target - origin, pair.target, atol=1e-6)
    return se3.from_rotation_translation(np.eye(3), origin) @ pair.T_target_source


def _error_mm(pose: Any, points: np.ndarray, truth: np.ndarray) -> float:
    return se3.pose_error(units.core_pose(pose_to_matrix(pose)), truth, points * 1000.0)[0]


def draw(results: list[Soak], path: Path) -> None:
    """Latency of every answer and the memory, over time."""
    from matplotlib.figure import Figure

    from gapr_core.pages import palette

    figure = Figure(figsize=(8.0, 5.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for result, colour in zip(results, palette.SERIES, strict=False):
        above.plot(np.array(result.answered_s) / 60.0, result.latency_s, ".", ms=3, color=colour, label=result.kind)
        below.plot(np.arange(len(result.rss_mb)) / 60.0, result.rss_mb, color=colour, lw=1.6, label=result.kind)
    above.set(ylabel="from cloud to answer (s)", yscale="log")
    below.set(xlabel="minutes since the node was active", ylabel="resident memory (MB)", ylim=(0, None))
    for axes in (above, below):
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    above.legend(frameon=False, markerscale=3)
    figure.savefig(path, dpi=120)


def main() -> int:
    """Run it and print what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="altogether; 60 is the long run")
    parser.add_argument("--hz", type=float, default=10.0)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--out", type=Path, help="folder for soak.png and soak.json")
    given = parser.parse_args()
    say, results = partial(print, flush=True), []
    with tempfile.TemporaryDirectory() as folder:
        for kind in given.kinds:
            results.append(soak(Path(folder), kind, 60.0 * given.minutes / len(given.kinds), given.hz))
            say(results[-1].report, end="")
    say(f"load of the machine at the end: {os.getloadavg()[1]:.1f} on {os.cpu_count()} cores")
    if given.out is not None:
        given.out.mkdir(parents=True, exist_ok=True)
        draw(results, given.out / "soak.png")
        (given.out / "soak.json").write_text(json.dumps([asdict(result) for result in results]) + "\n")
    for result in results:
        result.check()
    say("PASSED: every cloud was answered, refused with a reason, or counted; memory is flat")
    return 0


if __name__ == "__main__":
    sys.exit(main())
