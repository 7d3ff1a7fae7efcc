"""Writes clouds and other ROS messages to a rosbag2 bag (mcap or sqlite3) that any rosbag2 player reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from rclpy.serialization import serialize_message
from rclpy.time import Time
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Header

from msg_adapters import xyz_to_cloud

STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
BAG_VERSION: Final = 9
UNLIMITED = QosTime(2147483647, 4294967295)


def offered(*, reliable: bool = True, latched: bool = False, depth: int = 10) -> Qos:
    """Give the QoS with which a topic is recorded and replayed."""
    return Qos(
        QosHistory.KEEP_LAST, depth, QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        UNLIMITED, UNLIMITED, QosLiveliness.AUTOMATIC, UNLIMITED, False,
    )  # fmt: skip


class BagWriter:
    """A new bag, as a context manager.

    Args:
        path: folder of the bag; must not exist.
        storage: "mcap" or "sqlite3".
        qos: how topics are offered on replay.

    Raises:
        ValueError: unknown storage.
        rosbags.rosbag2.WriterError: the folder exists.
    """

    def __init__(self, path: str | Path, storage: str = "mcap", qos: Qos | None = None) -> None:
        if storage not in STORAGES:
            raise ValueError(f"storage must be one of {', '.join(STORAGES)}, got {storage!r}")
        self._writer = Writer(Path(path), version=BAG_VERSION, storage_plugin=STORAGES[storage])
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._qos = qos or offered()
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> BagWriter:
        self._writer.open()
        return self

    def __exit__(self, *error: object) -> None:
        self._writer.close()

    def write_cloud(self, topic: str, points: ArrayLike, frame_id: str, stamp_ns: int) -> None:
        """Points (N, 3) in the unit of the topic (metres in ROS), as float32, seen and received at `stamp_ns`."""
        header = Header(frame_id=frame_id, stamp=Time(nanoseconds=stamp_ns).to_msg())
        self.write(topic, xyz_to_cloud(np.asarray(points, dtype=np.float32), header), stamp_ns)

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Any ROS message, received at `stamp_ns`."""
        self.write_raw(topic, type_name(message), serialize_message(message), stamp_ns)

    def write_raw(self, topic: str, kind: str, data: bytes, stamp_ns: int) -> None:
        """Write the CDR bytes of a message of type `package/msg/Name`."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._types, offered_qos_profiles=[self._qos]
            )
        self._writer.write(self._connections[topic], stamp_ns, data)


def type_name(message: Any) -> str:
    """`package/msg/Name` of a message."""
    package, kind = type(message).__module__.split(".")[:2]
    return f"{package}/{kind}/{type(message).__name__}"
