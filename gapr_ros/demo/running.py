"""The node as its own process, watched from this one, and a bag that is played to it."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.results import confidence_text
from gapr_ros.demo import interrupt
from gapr_ros.demo.act import Act, DemoError
from gapr_ros.demo.children import child, last_lines

if TYPE_CHECKING:
    from gapr_ros.demo.observer import Answer, Observer

START_LIMIT_S, SILENCE_LIMIT_S = 180.0, 60.0  # the first start on a machine compiles
STARTING = "waiting for the node to read the bone (the first time it compiles, up to a minute)"


@contextmanager
def observing(log_folder: Path) -> Iterator[Observer]:
    """Run an observer in a ROS graph of its own on this machine, shared with the children of this process.

    ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE are respected where they are set.
    """
    import rclpy

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
    os.environ["ROS_LOG_DIR"] = str(log_folder.resolve())
    from gapr_ros.demo.observer import Observer

    context = rclpy.Context()  # without handlers of its own: Ctrl-C stays a KeyboardInterrupt
    context.init(args=[])
    observer = Observer(context=context)
    try:
        yield observer
    finally:
        observer.destroy_node()
        context.try_shutdown()


class RunningNode:
    """A register_node in a process of its own.

    Args:
        process: it.
        log: its output.
        observer: who hears what it says.
    """

    def __init__(self, process: Any, log: Path, observer: Observer) -> None:
        self._process, self._log, self.observer = process, log, observer

    def wait_until_ready(self) -> None:
        """Until it is active and has found who sends clouds: what is sent earlier would be lost.

        Raises:
            DemoError: it did not start, or ended.
        """
        observer, deadline = self.observer, time.monotonic() + START_LIMIT_S
        while not observer.node_ready:
            self.check()
            if observer.node_failure or time.monotonic() > deadline:
                state = f"{observer.node_state or 'silent'} after {START_LIMIT_S:.0f} s; see {self._log}"
                raise DemoError(f"register_node did not start: {observer.node_failure or state}")
            observer.listen(0.1)

    def wait_for(self, done: Callable[[], bool], note: Callable[[], None] = lambda: None) -> None:
        """Until it is done, or nothing more comes for a minute; `note` is called after every news.

        Raises:
            DemoError: the node ended.
        """
        observer, before, heard = self.observer, -1, time.monotonic()
        while not done() and time.monotonic() < heard + SILENCE_LIMIT_S:
            self.check()
            observer.listen(0.1)
            if len(observer.answers) + observer.sent != before:
                before, heard = len(observer.answers) + observer.sent, time.monotonic()
                note()
        for _ in range(10):  # a pose may be a moment behind the status
            observer.listen(0.05)
        observer.complete()

    def check(self) -> None:
        """Raise if the node has ended, or somebody pressed Ctrl-C.

        Raises:
            DemoError: it ended with an error.
            KeyboardInterrupt: Ctrl-C was pressed.
        """
        interrupt.check()
        if self._process.poll() not in (None, 0):
            raise DemoError(f"{self._log.stem} ended with {self._process.returncode}:\n{last_lines(self._log)}")


class Sender:
    """Sends clouds to a node one at a time, each when the one before was answered.

    Args:
        node: that answers.
        frame_id: of the clouds.
    """

    def __init__(self, node: RunningNode, frame_id: str) -> None:
        from sensor_msgs.msg import PointCloud2

        self._node, self._frame_id = node, frame_id
        self._publisher = node.observer.create_publisher(PointCloud2, "points", 10)

    def ask(self, cloud_mm: NDArray[np.float64], stamp_ms: int) -> Answer | None:
        """Send a cloud (N, 3), mm, of this time and return the answer; None if none comes for a minute."""
        from rclpy.time import Time
        from std_msgs.msg import Header

        from gapr_ros.node import units
        from msg_adapters import xyz_to_cloud

        observer, stamp_ns = self._node.observer, stamp_ms * 1_000_000
        header = Header(frame_id=self._frame_id, stamp=Time(nanoseconds=stamp_ns).to_msg())
        message = xyz_to_cloud(units.to_metres(cloud_mm).astype("f4"), header)
        observer.note_sent("points", stamp_ns)
        self._publisher.publish(message)
        self._node.wait_for(lambda: stamp_ms in observer.answers)
        return observer.answers.get(stamp_ms)


@contextmanager
def running(observer: Observer, folder: Path, parameters: Mapping[str, Any]) -> Iterator[RunningNode]:
    """Starts the node with these parameters; it ends with the block."""
    log = folder / "register_node.log"
    with child("gapr_ros.register_node", ["--ros-args", *as_arguments(parameters)], log) as process:
        yield RunningNode(process, log, observer)


def as_arguments(parameters: Mapping[str, Any]) -> list[str]:
    """Parameters as a ROS command line takes them."""
    texts = {name: str(value).lower() if isinstance(value, bool) else value for name, value in parameters.items()}
    return [text for name, value in texts.items() for text in ("-p", f"{name}:={value}")]


def play(act: Act, observer: Observer, folder: Path, console: Any) -> None:
    """Plays the bag to a node; returns when every cloud is answered or nothing more comes.

    Raises:
        DemoError: the node did not start, or ended too early.
    """
    with running(observer, folder, act.node_parameters) as node, _player(observer, folder / "bag") as start:
        with console.status(STARTING):
            node.wait_until_ready()
        start()
        _collect(len(act.clouds), node, console)


@contextmanager
def _player(observer: Observer, bag_path: Path) -> Iterator[Callable[[], None]]:
    """Advertises the topics of the bag at once; call what it yields to play, in a thread of its own."""
    from gapr_ros.bags.replay import Replay, ReplayOptions, open_bag

    bag = open_bag(bag_path)
    player = Replay(observer, bag, ReplayOptions(progress=False), observer.note_sent)
    thread = Thread(target=player.run, daemon=True)
    try:
        yield thread.start
    finally:
        observer.context.try_shutdown()  # ends the player wherever it is
        if thread.ident is not None:
            thread.join()
        bag.reader.close()


def _collect(count: int, node: RunningNode, console: Any) -> None:
    """Takes in the answers, with a bar."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("answers"),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )
    observer = node.observer
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("", total=count)
        node.wait_for(
            lambda: len(observer.answers) + observer.dropped >= count,
            lambda: progress.update(task, completed=len(observer.answers), description=_last_answer(observer)),
        )


def _last_answer(observer: Observer) -> str:
    if not observer.answers:
        return ""
    answer = observer.answers[max(observer.answers)]
    if answer.refusal:
        return f"refused: {answer.refusal}"[:60]
    return f"pose, confidence {confidence_text(answer.confidence)}"
