"""Clouds of a bag as a source: `gapr register --source bag --topic /points`. Found through the group `gapr.sources`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message

from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats.options import ReadOptions
from gapr_core.geometry import pinhole
from gapr_core.surface import Surface
from gapr_ros.bags.files import Bag, BagError, open_bag
from gapr_ros.bags.writing import type_name
from msg_adapters import INPUTS, Input

log = logging.getLogger(__name__)

Array = NDArray[np.float64]

UNIT = "m"  # REP-103
READABLE = {type_name(kind.message()): kind for kind in INPUTS.values()}
LONGEST_REASON = 160
NAME_ONE = "name one with --topic, or topic= in Python"


def read(path: Path, options: ReadOptions) -> Surface:
    """Read the clouds of one topic, joined, in its unit and frame; a single one with its camera.

    Raises:
        InvalidPointCloudError: a damaged or empty bag, no such topic, one without clouds, clouds of two frames, or a
            malformed one.
    """
    try:
        bag = open_bag(path)
    except BagError as error:
        raise _unreadable(path, error) from error
    try:
        topic = _topic(bag, options.topic)
        clouds = _clouds(bag, topic, options)
    except BagError as error:
        raise _unreadable(path, error) from error
    finally:
        bag.reader.close()
    joined = len(clouds) > 1
    camera = None if joined else clouds[0][1]
    return Surface(np.vstack([points for points, _ in clouds]), camera=camera, joined=joined)


def _unreadable(path: Path, error: BagError) -> InvalidPointCloudError:
    why = _short(str(error).removeprefix(f"{path}: "))
    return InvalidPointCloudError("a bag that can be read", f"{path.name} ({why})", "record it again, or repair it")


def _short(why: str) -> str:
    reason = " ".join(why.split())
    return reason if len(reason) <= LONGEST_REASON else f"{reason[:LONGEST_REASON]}..."


def _topic(bag: Bag, wanted: str) -> str:
    """Find the topic that is meant, once it is known to have clouds."""
    kinds = {connection.topic: connection.msgtype for connection in bag.reader.connections}
    usable = sorted(topic for topic, kind in kinds.items() if kind in READABLE)
    if wanted and wanted not in kinds:
        raise InvalidPointCloudError(f"a topic of the bag ({', '.join(sorted(kinds))})", wanted, NAME_ONE)
    if wanted and wanted not in usable:
        there = f"; the bag has {', '.join(usable)}" if usable else "; the bag has none"
        expected = f"a topic of {' or '.join(READABLE)}{there}"
        raise InvalidPointCloudError(expected, f"{wanted} of {kinds[wanted]}", NAME_ONE)
    if not wanted and len(usable) != 1:
        given = f"{len(usable)} of them" + (f" ({', '.join(usable)})" if usable else f" ({', '.join(sorted(kinds))})")
        raise InvalidPointCloudError(f"one topic of {' or '.join(READABLE)}", given, NAME_ONE)
    return wanted or usable[0]


def _clouds(bag: Bag, topic: str, options: ReadOptions) -> list[tuple[Array, Array | None]]:
    """Points and camera of each cloud that is asked for, all in one frame."""
    bag.connections = [connection for connection in bag.connections if connection.topic == topic]
    wanted = range(bag.count)[slice(*options.clouds)]
    if not wanted:
        given = f"{bag.count} of {topic}" + (" and a choice without any" if bag.count else "")
        raise InvalidPointCloudError("clouds", given, "record the topic, or choose others with --clouds")
    clouds: list[tuple[Array, Array | None]] = []
    frames: set[str] = set()
    for number, (received_ns, connection, data) in enumerate(bag.messages()):
        if number in wanted:
            try:
                frame, points, camera = _cloud(READABLE[connection.msgtype], data, received_ns)
            except _MalformedError as error:
                given, how = f"cloud {number} of {topic}, {error}", _how_to_leave_out(number, wanted)
                raise InvalidPointCloudError("clouds that can be read", given, how) from error
            clouds.append((points, camera))
            frames.add(frame)
            options.limits.check_counts(sum(len(points) for points, _ in clouds))
        elif number >= wanted.stop:
            break
    if len(clouds) != len(wanted):
        raise BagError(f"damaged: {len(clouds)} clouds where it announces {len(wanted)}")
    if len(frames) > 1:
        given = f"clouds in {', '.join(sorted(frames))}"
        raise InvalidPointCloudError(f"clouds of {topic} in one frame", given, "choose some with --clouds FIRST:LAST")
    if len(clouds) > 1:
        log.warning("%d clouds of %s (frame %s) are joined; the bone must not have moved in it; --clouds FIRST:LAST "
                    "chooses some", len(clouds), topic, *frames)  # fmt: skip
    return clouds


class _MalformedError(ValueError):
    """A message that cannot be used; the text says when it was, and what is wrong."""


def _cloud(kind: Input, data: bytes, received_ns: int) -> tuple[str, Array, Array | None]:
    """Frame and finite points of one message, and where its camera was if it says."""
    when = f"received at {received_ns // 10**9}.{received_ns % 10**9:09d} s"
    try:
        message: Any = deserialize_message(data, kind.message)
        when = f"stamp {message.header.stamp.sec}.{message.header.stamp.nanosec:09d} s"
        points, grid = kind.points(message), kind.grid(message)
    except Exception as error:  # the middleware raises several kinds
        raise _MalformedError(f"{when} ({_short(str(error))})") from error
    return message.header.frame_id.lstrip("/"), points, None if grid is None else pinhole.centre_of(grid)


def _how_to_leave_out(number: int, wanted: range) -> str:
    """Say how to leave out a malformed cloud, counted from 0 as --clouds does."""
    parts = [part for part in (range(wanted.start, number), range(number + 1, wanted.stop)) if part]
    if not parts:
        return "record it again"
    return f"choose others: {' or '.join(f'--clouds {part.start}:{part.stop}' for part in parts)}"
