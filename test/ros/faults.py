"""A table of faults on real processes: what goes wrong around a node in an operating room, and what it must do then.

python test/ros/faults.py [NAME ...]        (all of them without names; a line a fault, exit code 1 when one fails)

After every fault the process lives, its log has no traceback, and a good cloud gets its pose; or, where the fault ends
the process, it ends in time and a new one works.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import bones
import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from harness import Client, NodeProcess, environment, wait_until
from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from msg_adapters import xyz_to_cloud

ANSWER_S = 240.0  # for a cloud, or a start, on a busy machine
END_S = 2.0  # of CPU time, from a signal to the end
FULL_BYTES = 2**20
NOT_NOW = ("frames_accepted", "frames_refused", "frames_dropped", "frames_lost", "frames_merged")

PUBLISHER = textwrap.dedent("""
    import sys, time
    import numpy as np, rclpy
    from rclpy.node import Node
    from sensor_msgs.msg import PointCloud2
    from std_msgs.msg import Header
    from msg_adapters import xyz_to_cloud
    rclpy.init()
    node = Node("short_lived")
    publisher = node.create_publisher(PointCloud2, "points", 1)
    points = np.load(sys.argv[1]).astype("f4")
    while True:
        header = Header(frame_id="probe", stamp=node.get_clock().now().to_msg())
        publisher.publish(xyz_to_cloud(points, header))
        time.sleep(0.1)
""")


class Bench:
    """A node as a process, a client, a bone and a good cloud of it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.client = folder, Client()
        self.bone = bones.bone()
        self.model = bones.save(self.bone, folder / "bone.npz")
        self.cloud = bones.partial(self.bone, np.eye(4)).astype(np.float32)
        self.node: NodeProcess | None = None

    def start(self, **parameters: object) -> None:
        """A new node, active."""
        self.end()
        self.client.be_quiet()
        options = {"model_path": self.model, "model_unit": "mm"}
        self.node = NodeProcess(self.folder, keeps=True, **(options | parameters))
        self.client.wait_for_state("active", ANSWER_S)

    def end(self) -> None:
        """No node."""
        if self.node is not None and self.node.process.poll() is None:
            self.node.stop(signal.SIGKILL)
        self.node = None

    def close(self) -> None:
        """No node and no client."""
        self.end()
        self.client.close()

    def is_well(self, **kwargs: object) -> None:
        """The process lives, says nothing bad, and a good cloud gets its pose."""
        self.lives()
        self.settled()
        values = self.client.ask(self.cloud, timeout_s=ANSWER_S, **kwargs)
        assert values["level"] == 0, values["message"]

    def lives(self) -> None:
        """The process lives and has raised nothing."""
        assert self.node.process.poll() is None, self.node.log
        assert "Traceback" not in self.node.log, self.node.log

    def settled(self) -> None:
        """Every cloud that came is answered, dropped or merged."""

        def rest() -> int:
            values = self.client.values()
            return int(values["frames_received"]) - sum(int(values[key]) for key in NOT_NOW if key != "frames_lost")

        wait_until(lambda: rest() == 0, ANSWER_S, "the clouds on their way")

    def set(self, *messages: ParameterMessage) -> list[bool]:
        """Which of the parameters were taken."""
        service = self.client.ready(SetParameters, "/register_node/set_parameters")
        future = service.call_async(SetParameters.Request(parameters=list(messages)))
        wait_until(future.done, ANSWER_S)
        return [bool(result.successful) for result in future.result().results]


def a_publisher_is_killed_and_comes_back(bench: Bench) -> None:
    np.save(bench.folder / "cloud.npy", bench.cloud)
    for _ in range(2):
        before = int(bench.client.values()["frames_received"])
        command = [sys.executable, "-c", PUBLISHER, str(bench.folder / "cloud.npy")]
        process = subprocess.Popen(command, env=environment(bench.folder), cwd=Path(__file__).parents[2])
        wait_until(
            lambda before=before: int(bench.client.values()["frames_received"]) > before + 3, ANSWER_S, "its clouds"
        )
        process.kill()
        process.wait()
    bench.is_well()


def a_best_effort_publisher_comes_and_goes(bench: Bench) -> None:
    qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    weak = bench.client.do(lambda: bench.client.node.create_publisher(PointCloud2, "points", qos))
    wait_until(lambda: bench.client.values()["cloud_qos"] == "reliable and best_effort", 20.0)
    bench.is_well()
    bench.client.forget(weak)
    wait_until(lambda: bench.client.values()["cloud_qos"] == "reliable", 20.0)


def stamps_are_wrong(bench: Bench) -> None:
    now = time.time()
    for stamp_s, reason in ((now + 60.0, "future"), (now + 1e8, "future"), (now - 60.0, "stale"), (1.0, "stale")):
        values = bench.client.ask(bench.cloud, stamp_s=stamp_s, timeout_s=ANSWER_S)
        assert values["last_refusal"].startswith(reason), values["last_refusal"]
        bench.is_well()
    cloud = xyz_to_cloud(bench.cloud, Header(frame_id="probe", stamp=TimeMessage(sec=-5)))
    assert bench.client.ask(cloud)["last_refusal"].startswith("bad_fields")


def frames_are_wrong(bench: Bench) -> None:
    for frame in ("", "/", "bone_preop", "/bone_preop"):
        assert bench.client.ask(bench.cloud, frame=frame)["last_refusal"].startswith("bad_frame")
    for frame in ("left", "right", "a" * 5000):
        bench.client.ask(bench.cloud, frame=frame, timeout_s=ANSWER_S)


def nan_storm(bench: Bench) -> None:
    for _ in range(300):
        bench.client.send(np.full((1000, 3), np.nan))
        time.sleep(0.005)


def five_million_points_at_thirty_hertz(bench: Bench) -> None:
    rng = np.random.default_rng(0)
    large = np.concatenate([bench.cloud] * (5_000_000 // len(bench.cloud) + 1))[:5_000_000]
    large = (large + rng.normal(scale=3e-4, size=large.shape)).astype(np.float32)
    before_mb = bench.node.rss_mb()
    message = xyz_to_cloud(large, Header(frame_id="probe"))
    for _ in range(30):
        bench.client.send(message)
        time.sleep(1.0 / 30.0)
    bench.settled()
    assert bench.node.rss_mb() - before_mb < 2000.0, (before_mb, bench.node.rss_mb())


def reloaded(bench: Bench, hint: str) -> None:
    """The reload fails with a reason, and the old bone stays."""
    answer = bench.client.call("reload_model", timeout_s=ANSWER_S)
    assert not answer.success and answer.message.startswith("the old bone stays"), answer
    assert hint in answer.message, answer


def model_is_replaced_deleted_truncated_or_emptied(bench: Bench) -> None:
    whole = bench.model.read_bytes()
    try:
        for damaged in (whole[: len(whole) // 2], b"", b"\0" * 4096, os.urandom(4096)):
            bench.model.write_bytes(damaged)
            reloaded(bench, "expected")
            bench.is_well()
        bench.model.unlink()
        reloaded(bench, "a file that exists")
        bench.model.mkdir()
        reloaded(bench, "expected")
        bench.model.rmdir()
    finally:
        bench.model.write_bytes(whole)
    assert bench.client.call("reload_model", timeout_s=ANSWER_S).success


def model_is_two_gigabytes_of_nothing(bench: Bench) -> None:
    sparse = bench.folder / "sparse.stl"
    with sparse.open("wb") as file:
        file.truncate(2 * 1024**3)
    bench.set(Parameter("model_path", value=str(sparse)).to_parameter_msg())
    try:
        service = bench.client.ready(Trigger, "/register_node/reload_model")
        future = service.call_async(Trigger.Request())
        bench.is_well()  # while it reads
        wait_until(future.done, ANSWER_S)
        assert not future.result().success, future.result().message
    finally:
        bench.set(Parameter("model_path", value=str(bench.model)).to_parameter_msg())
        sparse.unlink()


def model_is_a_fifo(bench: Bench) -> None:
    fifo = bench.folder / "fifo.stl"
    os.mkfifo(fifo)
    bench.set(Parameter("model_path", value=str(fifo)).to_parameter_msg())
    service = bench.client.ready(Trigger, "/register_node/reload_model")
    future = service.call_async(Trigger.Request())
    bench.is_well()
    bench.is_well()
    if not future.done():  # it waits for a writer, in a thread of its own
        fifo.write_bytes(b"")
        wait_until(future.done, 20.0)
    assert not future.result().success
    bench.set(Parameter("model_path", value=str(bench.model)).to_parameter_msg())


def signals(bench: Bench) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        bench.client.send(bench.cloud)
        assert bench.node.stop_cpu_s(number) < END_S, number
        bench.start()
        bench.is_well()


def the_clock_goes_back(bench: Bench) -> None:
    bench.start(use_sim_time=True)

    def tick(seconds: float) -> None:
        for _ in range(10):
            bench.client.clock.publish(Clock(clock=TimeMessage(sec=int(seconds))))
            time.sleep(0.05)

    try:
        for second in (1000.0, 1010.0, 900.0, 910.0, 0.0, 5.0):
            tick(second)
            values = bench.client.ask(bench.cloud, stamp_s=second + 0.1, timeout_s=ANSWER_S)
            assert values["level"] == 0, values
        bench.lives()
    finally:
        bench.start()


def parameters_are_nonsense(bench: Bench) -> None:
    names = ("min_confidence", "pose_lifetime", "error_after", "crop_min", "cloud_unit", "model_path", "accumulate")
    nonsense = (float("nan"), -1.0, 7, "x", True, [0.0], 10**12, "")
    for name in names:
        for value in nonsense:
            if not (name == "model_path" and isinstance(value, str)):
                taken = bench.set(Parameter(name, value=value).to_parameter_msg())
                assert taken == [False], (name, value)


def the_disk_is_full(bench: Bench) -> None:
    """The log files of the process cannot grow any more, nor any file to more than a megabyte.

    Small files can: Fast DDS makes one in shared memory for every listener, and that is no disk.
    """
    pid = bench.node.process.pid
    logs = [bench.node.log_path, *bench.folder.glob(f"*_{pid}_*.log")]
    assert len(logs) == 2, "its output, and that of rclpy's logger"
    for path in logs:
        os.truncate(path, FULL_BYTES)
    subprocess.run(["prlimit", f"--pid={pid}", f"--fsize={FULL_BYTES}:{FULL_BYTES}"], check=True)
    for _ in range(3):
        bench.client.ask(np.full((1000, 3), np.nan))  # a refusal is logged
    bench.is_well()
    assert bench.client.call("reload_model", timeout_s=ANSWER_S).success
    bench.is_well()
    assert {path.stat().st_size for path in logs} == {FULL_BYTES}, "this row filled nothing"
    bench.start()


def the_lifecycle_goes_round_while_clouds_come(bench: Bench) -> None:
    for _ in range(3):
        for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP,
                           Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):  # fmt: skip
            bench.client.send(bench.cloud)
            assert bench.client.change_state(transition)
    wait_until(lambda: bench.client.points.get_subscription_count() == 1, 20.0)


def resets_rain(bench: Bench) -> None:
    for i in range(60):
        bench.client.send(bench.cloud)
        if i % 3 == 0:
            assert bench.client.call("reset").success


FAULTS: dict[str, Callable[[Bench], None]] = {
    fault.__name__: fault
    for fault in (
        stamps_are_wrong, frames_are_wrong, nan_storm, parameters_are_nonsense, a_publisher_is_killed_and_comes_back,
        a_best_effort_publisher_comes_and_goes, model_is_replaced_deleted_truncated_or_emptied,
        model_is_two_gigabytes_of_nothing, model_is_a_fifo, five_million_points_at_thirty_hertz,
        the_lifecycle_goes_round_while_clouds_come, resets_rain, the_disk_is_full, the_clock_goes_back, signals,
    )
}  # fmt: skip


def inject(bench: Bench, name: str) -> str:
    """Why the fault was not survived; empty when it was."""
    try:
        if bench.node is None or bench.node.process.poll() is not None:
            bench.start()
        FAULTS[name](bench)
        bench.is_well()
    except (AssertionError, OSError, KeyError, subprocess.SubprocessError) as error:
        why = f"{type(error).__name__}: {error}"
        bench.end()
        return why
    return ""


def main() -> int:
    """Run them and say a line each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *FAULTS], metavar="NAME", help=", ".join(FAULTS))
    names = parser.parse_args().names or list(FAULTS)
    folder, failed = Path(tempfile.mkdtemp()), 0
    bench = Bench(folder)
    try:
        for name in names:
            start = time.monotonic()
            why = inject(bench, name)
            failed += bool(why)
            line = f"{'FAILED' if why else 'ok':7}{time.monotonic() - start:6.1f} s  {name.replace('_', ' ')}"
            sys.stdout.write(f"{line}  {why[:2000]}\n")
            sys.stdout.flush()
    finally:
        bench.close()
        shutil.rmtree(folder, ignore_errors=True)
    sys.stdout.write(f"{len(names) - failed} of {len(names)} faults survived\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
