"""Plays a rosbag2 bag over rclpy: recorded bytes, recorded QoS, recorded times; for machines without `ros2 bag`.

bag_replay BAG [--topics /points ...] [--rate 2.0] [--loop] [--clock [HZ]]
"""

from __future__ import annotations

import argparse
import heapq
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import uninstall_signal_handlers
from rclpy.time import Time
from rclpy.utilities import remove_ros_args
from rosbags.interfaces import Connection
from rosgraph_msgs.msg import Clock
from tqdm import tqdm

from gapr_ros.bags.files import Bag, BagError, open_bag, recorded_qos

CLOCK_HZ = 40.0
DISCOVERY_S = 1.0
SETTLE_S = 0.5  # a listener that we know of knows us a little later
DRAIN_S = 5.0
LARGEST_STEP_S = 0.1  # of one sleep, so that Ctrl-C is heard


@dataclass(frozen=True)
class ReplayOptions:
    """How a bag is played.

    Attributes:
        rate: of the recorded speed.
        topics: which ones; empty: all.
        loop: start over at the end, time goes back.
        clock_hz: how often /clock says the bag's time; 0: never.
        wait_s: longest wait, at the start, for somebody to listen to every topic.
        listeners: how many listeners each topic is to have before that wait ends.
        progress: show a bar.
    """

    rate: float = 1.0
    topics: Sequence[str] = ()
    loop: bool = False
    clock_hz: float = 0.0
    wait_s: float = DISCOVERY_S
    listeners: int = 1
    progress: bool = True


class Replay:
    """Plays an open bag through a node.

    Args:
        node: publishes; need not spin.
        bag: from `open_bag`.
        options: see there.
        on_message: is given the topic and the time (ns) after each message was sent.
    """

    def __init__(
        self, node: Node, bag: Bag, options: ReplayOptions, on_message: Callable[[str, int], None] | None = None
    ) -> None:
        if options.rate <= 0.0:
            raise ValueError(f"the rate must be positive, got {options.rate:g}")
        self._node, self._bag, self._options, self._on_message = node, bag, options, on_message
        self._publishers = {topic: self._advertise(topic) for topic in dict.fromkeys(c.topic for c in bag.connections)}
        self._clock = node.create_publisher(Clock, "/clock", 10) if options.clock_hz > 0.0 else None

    def run(self) -> int:
        """Play it, once or until rclpy is shut down. Returns the number of messages sent."""
        self._wait_for_listeners()
        sent = self._play_once()
        while self._options.loop and self._node.context.ok():
            sent += self._play_once()
        self._drain()
        return sent

    def close(self) -> None:
        """Give the topics back."""
        for publisher in [*self._publishers.values(), *([self._clock] if self._clock else [])]:
            self._node.destroy_publisher(publisher)

    def _advertise(self, topic: str) -> Any:
        """Advertise one publisher for each topic: a bag has a connection for each recorded publisher."""
        connections = [c for c in self._bag.connections if c.topic == topic]
        first, *others = dict.fromkeys(c.msgtype for c in connections)
        if others:
            raise BagError(f"{self._bag.reader.path}: {topic} has messages of {first} and {', '.join(others)}")
        return self._node.create_publisher(self._bag.types[first], topic, recorded_qos(connections))

    def _wait_for_listeners(self) -> None:
        """Volatile messages that go out before a listener was discovered are lost."""
        deadline = time.monotonic() + self._options.wait_s
        while self._node.context.ok() and self._unheard():
            if time.monotonic() > deadline:
                self._say_who_is_not_heard()
                return
            time.sleep(0.02)
        time.sleep(SETTLE_S)

    def _unheard(self) -> list[str]:
        """Topics with fewer listeners than were asked for."""
        wanted = self._options.listeners
        return [topic for topic, p in self._publishers.items() if p.get_subscription_count() < wanted]

    def _say_who_is_not_heard(self) -> None:
        of, after = f"{self._options.listeners} listeners", f"after {self._options.wait_s:g} s"
        text = f"{', '.join(self._unheard())}: fewer than {of} {after}; it is played now (--wait waits longer)"
        self._node.get_logger().warning(text)

    def _play_once(self) -> int:
        origin, sent = time.monotonic(), 0
        hide = None if self._options.progress else True  # None: no bar when this is no terminal
        with tqdm(total=self._bag.count, unit="msg", desc="replay", disable=hide, leave=not self._options.loop) as bar:
            for stamp_ns, connection, data in self._events():
                self._sleep_until(origin + (stamp_ns - self._bag.reader.start_time) * 1e-9 / self._options.rate)
                if not self._node.context.ok():
                    break
                if connection is None:
                    self._tick(stamp_ns)
                    continue
                self._publishers[connection.topic].publish(data)
                sent += 1
                bar.update()
                if self._on_message:
                    self._on_message(connection.topic, stamp_ns)
        return sent

    def _tick(self, stamp_ns: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=Time(nanoseconds=stamp_ns).to_msg()))

    def _events(self) -> Iterator[tuple[int, Connection | None, bytes]]:
        """Messages and ticks of the clock, in the order of time."""
        if self._clock is None:
            return self._bag.messages()
        return heapq.merge(self._ticks(), self._bag.messages(), key=lambda event: event[0])

    def _ticks(self) -> Iterator[tuple[int, None, bytes]]:
        step_ns = int(1e9 / self._options.clock_hz * self._options.rate)
        for stamp_ns in range(self._bag.reader.start_time, self._bag.reader.end_time + 1, max(step_ns, 1)):
            yield stamp_ns, None, b""

    def _sleep_until(self, moment: float) -> None:
        while self._node.context.ok() and (left_s := moment - time.monotonic()) > 0.0:
            time.sleep(min(left_s, LARGEST_STEP_S))

    def _drain(self) -> None:
        """Let reliable messages arrive before the publishers go.

        By asking again and again: rclpy holds on to the interpreter lock while it waits, which stops all other threads.
        """
        deadline = time.monotonic() + DRAIN_S
        waiting = list(self._publishers.values())
        while waiting and self._node.context.ok() and time.monotonic() < deadline:
            waiting = [publisher for publisher in waiting if not publisher.wait_for_all_acked(Duration())]
            time.sleep(0.01)


def parse_arguments(args: Sequence[str]) -> tuple[Path, ReplayOptions]:
    """Path and options from the command line."""
    parser = argparse.ArgumentParser(prog="bag_replay", description="Play a rosbag2 bag over rclpy.")
    parser.add_argument("bag", type=Path, help="folder of the bag, its metadata.yaml, .mcap or .db3 file")
    parser.add_argument("--topics", nargs="+", default=(), help="play only these")
    parser.add_argument("--rate", type=_positive, default=1.0, help="speed; 2: twice as fast")
    parser.add_argument("--loop", action="store_true", help="start over at the end")
    parser.add_argument("--clock", type=_positive, nargs="?", const=CLOCK_HZ, default=0.0, metavar="HZ",
                        help=f"publish /clock, {CLOCK_HZ:g} times a second by default")  # fmt: skip
    parser.add_argument("--wait", type=float, default=DISCOVERY_S, metavar="S", help="longest wait for listeners")
    parser.add_argument("--listeners", type=int, default=1, metavar="N", help="listeners per topic to wait for")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    given = parser.parse_args(args)
    waiting = {"wait_s": given.wait, "listeners": given.listeners}
    return given.bag, ReplayOptions(
        given.rate, given.topics, given.loop, given.clock, **waiting, progress=not given.quiet
    )


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be positive, got {text}")
    return value


def main(args: Sequence[str] | None = None) -> int:
    """`bag_replay BAG`; 1 for a bag that cannot be played."""
    arguments = list(sys.argv if args is None else ["bag_replay", *args])
    path, options = parse_arguments(remove_ros_args(arguments)[1:])
    try:
        bag = open_bag(path, options.topics)
    except BagError as error:
        sys.stderr.write(f"bag_replay: {error}\n")
        return 1
    rclpy.init(args=arguments)
    try:
        return _play(bag, options)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except RuntimeError:  # of a call to rclpy that was shut down just before
        if rclpy.ok():
            raise
        return 0
    finally:
        bag.reader.close()
        uninstall_signal_handlers()  # ends rclpy's thread for signals first: it shuts down too, and twice is an error
        rclpy.try_shutdown()


def _play(bag: Bag, options: ReplayOptions) -> int:
    node = Node("bag_replay", enable_rosout=False)  # its last line comes after Ctrl-C has shut rclpy down
    for topic, why in bag.skipped.items():
        node.get_logger().warning(f"{topic} is left out: {why}")
    try:
        sent = Replay(node, bag, options).run()
    except BagError as error:
        node.get_logger().error(str(error))
        return 1
    node.get_logger().info(f"{sent} messages sent")
    return 0


if __name__ == "__main__":
    sys.exit(main())
