"""A long bag through the node in its own process: nothing is lost without being counted, and memory stays flat.

python test/ros/soak.py [--frames 200] [--hz 10] [--storage mcap]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import bones
import numpy as np
from harness import Client, NodeProcess, context, wait_until
from rclpy.node import Node

from gapr_core.geometry import se3
from gapr_ros.bags.files import open_bag
from gapr_ros.bags.replay import Replay, ReplayOptions
from gapr_ros.bags.writing import BagWriter
from gapr_ros.node import wire
from msg_adapters import pose_to_matrix

T_TARGET_SOURCE = se3.from_rotation_translation(se3.random_rotation(np.random.default_rng(5)), [90.0, -40.0, 120.0])
START_NS = 1_700_000_000_000_000_000


@dataclass
class Soak:
    """What came out of it.

    Attributes:
        sent: clouds that were played.
        received, accepted, refused, dropped, lost: as the node counts them.
        confidences, poses, transforms: how many messages arrived.
        errors_mm: of every pose, at the cloud's centroid.
        rss_mb: of the node, once a second.
        exit_code: after SIGINT.
    """

    sent: int
    received: int
    accepted: int
    refused: int
    dropped: int
    lost: int
    confidences: int
    poses: int
    transforms: int
    errors_mm: list[float]
    rss_mb: list[float] = field(repr=False)
    exit_code: int = 0

    @property
    def growth_mb(self) -> float:
        """How much the median of the last quarter is above that of the second quarter."""
        quarter = max(len(self.rss_mb) // 4, 1)
        return float(np.median(self.rss_mb[-quarter:]) - np.median(self.rss_mb[quarter : 2 * quarter]))

    def check(self) -> None:
        """Raise AssertionError for whatever must not happen."""
        assert self.received + self.lost == self.sent, self
        assert self.accepted + self.refused + self.dropped == self.received, self
        assert self.confidences == self.accepted + self.refused, "every processed cloud is answered"
        assert self.transforms == self.accepted, self
        assert 0 < self.poses <= self.accepted, "~/pose keeps the last only: a slow reader may miss some"
        assert self.errors_mm and max(self.errors_mm) < 1.0, self
        assert self.growth_mb < 20.0, (self.growth_mb, self.rss_mb)
        assert self.exit_code == 0, self


def soak(folder: Path, frames: int = 200, hz: float = 10.0, storage: str = "mcap") -> Soak:
    """Write a bag, start a node, play the bag, count."""
    bone = bones.bone()
    period_ns = round(1e9 / hz)
    with BagWriter(folder / "bag", storage) as bag:
        for i in range(frames):
            points = bones.partial(bone, T_TARGET_SOURCE, i, count=1500 + 10 * (i % 50))
            bag.write_cloud("/points", points, "tracker", START_NS + i * period_ns)
    client = Client()
    node = NodeProcess(folder, model_path=bones.save(bone, folder / "bone.npz"), model_unit="mm", timeout=60.0)
    client.wait_for_state("active", 120.0)
    rss_mb, done = [], threading.Event()
    sampler = threading.Thread(target=_sample, args=(node, rss_mb, done))
    sampler.start()
    sent = _play(folder / "bag")
    counts = _settled(client, node, sent)
    done.set()
    sampler.join()
    errors = [_error_mm(pose, bone) for pose in client.poses]
    result = Soak(sent, *counts, len(client.confidences), len(client.poses), len(client.transforms), errors, rss_mb)
    client.close()
    result.exit_code = node.stop()
    return result


def _sample(node: NodeProcess, rss_mb: list[float], done: threading.Event) -> None:
    while not done.wait(1.0):
        rss_mb.append(node.rss_mb())


def _play(path: Path) -> int:
    ros = context()
    node, bag = Node("player", context=ros), open_bag(path)
    try:
        return Replay(node, bag, ReplayOptions(wait_s=10.0)).run()
    finally:
        bag.reader.close()
        node.destroy_node()
        ros.try_shutdown()


def _settled(client: Client, node: NodeProcess, sent: int) -> list[int]:
    def counts() -> list[int]:
        values = client.values()
        return [int(values[f"frames_{kind}"]) for kind in ("received", "accepted", "refused", "dropped", "lost")]

    wait_until(lambda: sum(counts()[1:]) == sent or node.process.poll() is not None, 90.0, f"{sent}; have {counts()}")
    assert node.process.poll() is None, node.log
    time.sleep(1.0)
    return counts()


def _error_mm(pose: object, bone: object) -> float:
    source = bones.partial(bone, T_TARGET_SOURCE) * 1000.0
    return se3.pose_error(wire.core_pose(pose_to_matrix(pose)), T_TARGET_SOURCE, source)[0]


def main() -> int:
    """Run it and print what came out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--hz", type=float, default=10.0)
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    given = parser.parse_args()
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        result = soak(Path(folder), given.frames, given.hz, given.storage)
    report = (
        f"sent {result.sent}  received {result.received}  accepted {result.accepted}  refused {result.refused}  "
        f"dropped {result.dropped}  lost {result.lost}\n"
        f"answers: {result.confidences} confidences, {result.transforms} transforms, {result.poses} poses\n"
        f"largest error {max(result.errors_mm, default=float('nan')):.3f} mm\n"
        f"memory: {min(result.rss_mb):.0f} to {max(result.rss_mb):.0f} MB, growth {result.growth_mb:+.1f} MB\n"
        f"exit code {result.exit_code}, {time.monotonic() - start:.0f} s\n"
    )
    sys.stdout.write(report)
    result.check()
    sys.stdout.write("PASSED: every cloud was answered, refused with a reason, or counted\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
