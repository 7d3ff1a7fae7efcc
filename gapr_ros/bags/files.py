"""Opens rosbag2 bags (mcap or sqlite3) for replay: what is in them, what can be played, how it was offered."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosReliability
from rosbags.rosbag2 import Reader

METADATA = "metadata.yaml"  # names the files of the bag in its folder
DEEPEST = 2**31 - 1  # history that rclpy takes


class BagError(ValueError):
    """A bag that cannot be played; the text says why."""


@dataclass
class Bag:
    """An open bag: what it holds, as far as this machine knows the types.

    Attributes:
        connections: playable ones.
        skipped: topic and reason of the others.
        count: messages on the playable connections.
    """

    reader: Reader
    connections: list[Connection]
    types: dict[str, Any]
    skipped: dict[str, str] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Messages on the playable connections."""
        return sum(connection.msgcount for connection in self.connections)

    def messages(self) -> Iterator[tuple[int, Connection, bytes]]:
        """Time (ns), connection and CDR bytes, in the order of time.

        Raises:
            BagError: the rest of the bag cannot be read.
        """
        try:
            for connection, stamp_ns, data in self.reader.messages(self.connections):
                yield stamp_ns, connection, bytes(data)
        except Exception as error:  # the storages raise errors of their own
            raise BagError(f"{self.reader.path}: damaged: {error}") from error


def open_bag(path: str | Path, topics: Sequence[str] = ()) -> Bag:
    """Open a bag by its folder, its metadata or its one file, for replay; close its `reader` afterwards.

    Raises:
        BagError: no bag, a damaged one, a topic it does not have, or nothing in it that can be played.
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f"{path}: no such file or folder")
    if path.name == METADATA:
        path = path.absolute().parent
    try:
        reader = Reader(path)
        reader.open()
    except Exception as error:  # rosbags lets errors of YAML, sqlite and zstd through
        raise BagError(f"{path}: not a readable rosbag2: {error}") from error
    bag = Bag(reader, [], {})
    try:
        _choose(bag, topics)
    except BagError:
        reader.close()
        raise
    return bag


def _choose(bag: Bag, topics: Sequence[str]) -> None:
    there = {connection.topic for connection in bag.reader.connections}
    missing = sorted(set(topics) - there)
    if missing:
        raise BagError(f"{bag.reader.path}: no topic {', '.join(missing)}; it has {', '.join(sorted(there)) or 'none'}")
    for connection in bag.reader.connections:
        if topics and connection.topic not in topics:
            continue
        try:
            bag.types[connection.msgtype] = import_type(connection.msgtype)
            bag.connections.append(connection)
        except (ImportError, AttributeError, ValueError) as error:
            bag.skipped[connection.topic] = f"{connection.msgtype} cannot be imported ({error})"
    if not bag.count:
        raise BagError(
            f"{bag.reader.path}: no messages to play" + "".join(f"; {t}: {w}" for t, w in bag.skipped.items())
        )


def import_type(name: str) -> Any:
    """Import the message class of `package/msg/Name`."""
    package, kind, message = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), message)


def recorded_qos(connections: Sequence[Connection]) -> QoSProfile:
    """Choose the QoS of one publisher that serves every listener of the recorded ones.

    Reliable and latched where any of them was, since such a publisher serves best effort and volatile listeners too;
    as many messages as they kept together. Reliable, volatile, keep last 10 where nothing is known.
    """
    recorded: list[Sequence[Qos]] = [_offered(connection) for connection in connections]
    profiles = [profile for each in recorded for profile in each]
    reliable = not all(recorded) or any(p.reliability is not QosReliability.BEST_EFFORT for p in profiles)
    latched = any(p.durability is QosDurability.TRANSIENT_LOCAL for p in profiles)
    keep_all = any(p.history is QosHistory.KEEP_ALL for p in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if keep_all else HistoryPolicy.KEEP_LAST,
        depth=min(sum(p.depth for p in profiles), DEEPEST) or 10,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _offered(connection: Connection) -> Sequence[Qos]:
    of_ros2: Any = connection.ext
    profiles: Sequence[Qos] = of_ros2.offered_qos_profiles
    return profiles
