"""What the ROS tests share: a client that talks to a node over DDS, nodes as processes or in threads, synthetic bones.

Every test process has a domain of its own and stays on this machine, so that runs side by side do not meet. No node
outlives the test that started it, nor the process that the tests run in.
"""

from __future__ import annotations

import gc
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import domain
import numpy as np
import psutil
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from gapr_core.config import RegistrarConfig
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus
from gapr_ros.node import lifecycle
from gapr_ros.node.lifecycle import RegisterNode
from gapr_ros.parameters import NodeParameters
from msg_adapters import xyz_to_cloud

lifecycle.PERIOD_S = 0.1  # between two diagnostics of nodes in this process
DOMAIN = domain.claim()
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
NODE = "/register_node"
PATIENCE_S = 240.0  # for what comes in a moment on a machine of one's own, and in minutes on a busy one
SIBLINGS_S = 5.0  # for the other messages about a cloud, once its diagnostics are here
REPOSITORY = Path(__file__).resolve().parents[2]


def wait_until(condition: Callable[[], Any], timeout_s: float = 60.0, what: Any = "") -> Any:
    """The first true value of the condition; fails when there is none in time, and says what was waited for.

    A callable is asked for what to say when the time is up.
    """
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.005)
    raise AssertionError(f"waited {timeout_s} s in vain for {what() if callable(what) else what or condition}")


def context() -> Context:
    """An rclpy context in this process's domain.

    Nodes of earlier tests live on in cycles of references inside rclpy until they are collected. A service of which one
    of them still holds half is never ready: rmw_fastrtps wants as many ends for requests as for responses.
    """
    gc.collect()
    made = Context()
    made.init(args=[], domain_id=DOMAIN)
    return made


class Spinner:
    """Runs nodes in a thread, in a context of their own."""

    def __init__(self, in_context: Context) -> None:
        self.context = in_context
        self.executor = SingleThreadedExecutor(context=in_context)
        self._nodes: list[Node] = []
        self._thread = threading.Thread(target=self._spin, daemon=True)

    def start(self, node: Node) -> None:
        self._nodes.append(node)
        self.executor.add_node(node)
        self._thread.start()

    def do(self, call: Callable[[], Any]) -> Any:
        """The result of a call in the executor's thread: nothing may be destroyed while it waits for it."""
        task = self.executor.create_task(call)
        wait_until(task.done, what="the executor's thread")
        return task.result()

    def stop(self) -> None:
        self.executor.shutdown(timeout_sec=5.0)
        self._thread.join(5.0)

    def close(self) -> None:
        self.stop()
        for node in self._nodes:
            node.destroy_node()
        self.context.try_shutdown()

    def _spin(self) -> None:
        try:
            self.executor.spin()
        except (ExternalShutdownException, ShutdownException):
            pass


class Client:
    """Publishes clouds and remembers everything that the node says, with the order of arrival."""

    def __init__(self, reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE) -> None:
        self._spinner = Spinner(context())
        self.node = Node("client", context=self._spinner.context)
        self.poses: list[PoseWithCovarianceStamped] = []
        self.transforms: list[TransformStamped] = []
        self.statuses: list[DiagnosticArray] = []
        self.models: list[PointCloud2] = []
        self.diagnostics: list[DiagnosticArray] = []
        self._services: dict[str, Any] = {}
        listen = self.node.create_subscription
        listen(PoseWithCovarianceStamped, f"{NODE}/pose", self.poses.append, LATCHED)
        listen(TransformStamped, f"{NODE}/debug/transform", self.transforms.append, 10)
        listen(
            DiagnosticArray,
            f"{NODE}/status",
            self.statuses.append,
            QoSProfile(depth=1000, durability=LATCHED.durability),
        )
        listen(PointCloud2, f"{NODE}/model", self.models.append, LATCHED)
        listen(DiagnosticArray, "/diagnostics", self.diagnostics.append, 100)
        self.points = self.node.create_publisher(PointCloud2, "points", QoSProfile(depth=10, reliability=reliability))
        self.seeds = self.node.create_publisher(PoseWithCovarianceStamped, "initialpose", 1)
        self.clock = self.node.create_publisher(Clock, "/clock", 10)
        self._spinner.start(self.node)

        self.do = self._spinner.do

    def close(self) -> None:
        self._spinner.close()

    def forget(self, publisher: Any) -> None:
        """Give a publisher back."""
        self.do(lambda: self.node.destroy_publisher(publisher))

    def values(self, status: str = "registration") -> dict[str, Any]:
        """Key and value of the newest diagnostics, with `level` and `message`; empty before the first.

        Those of the registration with what the newest ~/status says, its `cloud_stamp` and `frame`.
        """
        for array in reversed(self.diagnostics):
            for entry in array.status:
                if entry.name.endswith(f": {status}"):
                    own = {"level": ord(entry.level), "message": entry.message}
                    said = self.said() if status == "registration" else {}
                    return said | {pair.key: pair.value for pair in entry.values} | own
        return {}

    def said(self) -> dict[str, Any]:
        """Key and value of the newest ~/status of a cloud, with its `cloud_stamp`, `frame` and `line`."""
        for array in reversed(self.statuses):
            values: dict[str, Any] = {pair.key: pair.value for pair in array.status[0].values}
            if values["reason"] != "withdrawn":
                stamp = f"{array.header.stamp.sec}.{array.header.stamp.nanosec:09d}"
                return values | {"cloud_stamp": stamp, "frame": array.header.frame_id, "line": array.status[0].message}
        return {"cloud_stamp": "", "frame": "", "line": ""}

    def wait_for_state(self, state: str, timeout_s: float = PATIENCE_S) -> None:
        wait_until(lambda: self.values().get("state") == state, timeout_s, f"state {state}")
        if state == "active":
            wait_until(lambda: self.points.get_subscription_count(), 60.0, "the subscription")
            wait_until(lambda: self.node.count_publishers(f"{NODE}/status"), 60.0, "the publishers")

    def send(self, cloud: PointCloud2 | np.ndarray | bytes, frame: str = "probe", stamp_s: float | None = None) -> str:
        """Publish a cloud, (N, 3) points in metres, or the bytes of a message.

        Returns the stamp of points as the node writes it; empty for a message, whose stamp is what it is.
        """
        if isinstance(cloud, PointCloud2 | bytes):
            self.points.publish(cloud)
            return ""
        stamp_s = time.time() if stamp_s is None else stamp_s
        stamp = Time(nanoseconds=int(stamp_s * 1e9)).to_msg()
        self.points.publish(xyz_to_cloud(np.asarray(cloud, dtype=np.float32), Header(frame_id=frame, stamp=stamp)))
        return f"{stamp.sec}.{stamp.nanosec:09d}"

    def ask(self, cloud: PointCloud2 | np.ndarray, timeout_s: float = PATIENCE_S, **kwargs: Any) -> dict[str, Any]:
        """Publish one cloud and wait for its answer: the diagnostics after it was counted.

        Answers to earlier clouds may still be on their way: the stamp tells them apart. The pose of an accepted cloud
        is waited for too, or it would pass for that of the next cloud.
        """
        before, heard, posed = _answered(self.values()), len(self.statuses), len(self.poses)
        stamp = self.send(cloud, **kwargs)

        def answer() -> dict[str, Any]:
            values = self.values()
            is_new = _answered(values) > before and len(self.statuses) > heard
            return values if is_new and stamp in ("", values["cloud_stamp"]) else {}

        try:
            values: dict[str, Any] = wait_until(answer, timeout_s, "an answer")
        except AssertionError as error:
            sent = self.diagnostics[-1].header.stamp if self.diagnostics else "none"
            text = f"{error} after {before} others; newest diagnostics of {sent}: {self.values()}"
            raise AssertionError(text) from error
        deadline = time.monotonic() + SIBLINGS_S
        while values["level"] == 0 and len(self.poses) <= posed and time.monotonic() < deadline:
            time.sleep(0.002)  # what the test waits for says more
        return values

    def be_quiet(self) -> None:
        """Wait until nothing comes any more from a node that has ended, and forget what it said."""
        count = -1
        while count != len(self.diagnostics):
            count = len(self.diagnostics)
            time.sleep(1.0)
        self.diagnostics.clear()

    def ready(self, kind: Any, name: str) -> Any:
        """A client whose service has been found."""
        if name not in self._services:
            self._services[name] = self.do(lambda: self.node.create_client(kind, name))
        wait_until(self._services[name].service_is_ready, 60.0, f"service {name}")
        return self._services[name]

    def call(self, name: str, request: Any = None, timeout_s: float = PATIENCE_S) -> Any:
        """The response of one of the node's services."""
        request = request or Trigger.Request()
        kind = SetBool if isinstance(request, SetBool.Request) else Trigger
        client = self.ready(kind, f"{NODE}/{name}")
        future = client.call_async(request)
        wait_until(future.done, timeout_s, f"the answer of {name}")
        return future.result()

    def ask_for(self, transition: int) -> Any:
        """The future of a transition of the lifecycle (`lifecycle_msgs.msg.Transition`)."""
        service = self.ready(ChangeState, f"{NODE}/change_state")
        return service.call_async(ChangeState.Request(transition=Transition(id=transition)))

    def change_state(self, transition: int) -> bool:
        """Whether the node made a transition of the lifecycle."""
        future = self.ask_for(transition)
        wait_until(future.done, PATIENCE_S, "the transition")
        return bool(future.result().success)


def _answered(values: dict[str, Any]) -> int:
    return int(values.get("frames_accepted", 0)) + int(values.get("frames_refused", 0))


@contextmanager
def node_in_thread(
    method: Any,
    model_path: Path,
    namespace: str = "",
    factory: Callable[[NodeParameters], Any] | None = None,
    **parameters: Any,
) -> Iterator[RegisterNode]:
    """A register_node in this process with a registration method of the test's own, or with what a factory makes."""
    spinner = Spinner(context())
    values = {
        "model_path": str(model_path),
        "model_unit": "mm",
        "publish_tf": False,
        "pose_lifetime": 0.0,
    }
    overrides = [Parameter(name, value=value) for name, value in (values | parameters).items()]
    options = {"context": spinner.context, "parameter_overrides": overrides, "namespace": namespace}
    node = RegisterNode(factory or (lambda _: method), **options)
    spinner.start(node)
    try:
        yield node
    finally:
        spinner.stop()
        node.close()
        spinner.close()


class NodeProcess:
    """`python -m gapr_ros.register_node` as a process of its own.

    Args:
        folder: for its log.
        arguments: of the program.
        module, script: another program.
        keeps: it may outlive the test that starts it; who made it ends it.
        parameters: of the node.
    """

    running: ClassVar[list[NodeProcess]] = []  # those that were started and have not been waited for

    def __init__(
        self,
        folder: Path,
        *arguments: str,
        module: str = "gapr_ros.register_node",
        script: Path | None = None,
        keeps: bool = False,
        **parameters: Any,
    ) -> None:
        self.keeps = keeps
        self.log_path = folder / f"{script.stem if script else module}-{time.monotonic_ns()}.log"
        self._log = self.log_path.open("ab")
        given = [part for name, value in parameters.items() for part in ("-p", f"{name}:={yaml_value(value)}")]
        ros = ["--ros-args", *given] if given else []
        program = [str(script)] if script else ["-m", module]
        command = [*ends_with_its_parent(), sys.executable, *program, *arguments, *ros]
        self.process = subprocess.Popen(
            command, stdout=self._log, stderr=subprocess.STDOUT, env=environment(folder), cwd=REPOSITORY
        )
        NodeProcess.running.append(self)

    @property
    def log(self) -> str:
        return self.log_path.read_text()

    def rss_mb(self) -> float:
        return psutil.Process(self.process.pid).memory_info().rss / 2**20

    def stop(self, number: int = signal.SIGINT, timeout_s: float = 60.0) -> int:
        """Send a signal and return the exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.wait(timeout_s)

    def stop_cpu_s(self, number: int, timeout_s: float = 60.0) -> float:
        """CPU time from a signal to an end with 0: the wall clock says nothing on a busy machine."""
        process = psutil.Process(self.process.pid)
        before_s = last_s = sum(process.cpu_times()[:2])
        self.process.send_signal(number)
        deadline = time.monotonic() + timeout_s
        while self.process.poll() is None and time.monotonic() < deadline:
            try:
                last_s = sum(process.cpu_times()[:2])
            except psutil.NoSuchProcess:
                break
            time.sleep(0.01)
        code = self.wait(5.0)
        assert code in (0, -number) and (code == 0 or number == signal.SIGKILL), (code, self.log)
        return last_s - before_s

    def wait(self, timeout_s: float = 60.0) -> int:
        try:
            return self.process.wait(timeout_s)
        finally:
            self.kill()

    def kill(self) -> None:
        """End it, whatever it does; once more does nothing."""
        self.process.kill()
        self.process.wait()
        self._log.close()
        if self in NodeProcess.running:
            NodeProcess.running.remove(self)


def ends_with_its_parent() -> list[str]:
    """Begins a command whose process the kernel kills when this one ends, however it ends; empty without util-linux."""
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "KILL", "--"] if setpriv else []


def environment(folder: Path) -> dict[str, str]:
    """For child processes: this domain, this machine only, messages checked."""
    return os.environ | {
        "ROS_DOMAIN_ID": str(DOMAIN),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_PYTHON_CHECK_FIELDS": "1",
        "ROS_LOG_DIR": str(folder),
        "PYTHONUNBUFFERED": "1",
        "PYTHONFAULTHANDLER": "1",
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "2"),
    }


def yaml_value(value: Any) -> str:
    """A parameter's value as `-p name:=value` wants it."""
    return str(value).lower() if isinstance(value, bool) else repr(value) if isinstance(value, float) else str(value)


class StandIn:
    """A registration method whose answers a test decides."""

    name = "stand-in"

    def __init__(self) -> None:
        self.answer, self.config = accepted(), RegistrarConfig()
        self.error: Exception | None = None
        self.calls: list[dict[str, Any]] = []
        self.gate = threading.Event()
        self.gate.set()
        self.prepared = 0

    def prepare(self, target: Any, units: str = "mm") -> Any:
        self.prepared += 1
        return target

    def register(
        self, source: np.ndarray, target: Any, initial: np.ndarray | None = None, viewpoint: np.ndarray | None = None
    ) -> RegistrationResult:
        self.calls.append({"source": source, "initial": initial, "target": target, "viewpoint": viewpoint})
        assert self.gate.wait(PATIENCE_S)
        if self.error is not None:
            raise self.error
        return self.answer


class Collecting(StandIn):
    """A stand-in that keeps clouds as an `Accumulator` does."""

    def __init__(self):
        super().__init__()
        self.kept, self.places = [], []

    @property
    def collected(self):
        return np.concatenate([np.empty((0, 3)), *self.kept])

    def together_with(self, source, viewpoint=None):
        return np.concatenate([self.collected, source])

    def collect(self, source, viewpoint=None):
        self.kept.append(source)
        self.places.append(viewpoint)

    def register(self, source, target, initial=None, viewpoint=None):
        result = super().register(source, target, initial, viewpoint)
        self.collect(source, viewpoint)
        return result

    def reset(self):
        self.kept = []


def accepted(T: np.ndarray | None = None, confidence: float = 0.9, **kwargs: Any) -> RegistrationResult:
    """An OK result."""
    covariance = np.diag([0.01, 0.02, 0.03, 1e-6, 2e-6, 3e-6])
    options = {"covariance": covariance, "tre_mm": 0.7, "inlier_ratio": 0.8} | kwargs
    return RegistrationResult(RegistrationStatus.OK, np.eye(4) if T is None else T, confidence=confidence, **options)


def pose_mm(rotation_vector: Any, translation_mm: Any) -> np.ndarray:
    """A rigid (4, 4)."""
    from scipy.spatial.transform import Rotation

    return se3.from_rotation_translation(Rotation.from_rotvec(rotation_vector).as_matrix(), translation_mm)
