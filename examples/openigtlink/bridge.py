"""OpenIGTLink bridge: points of a tracked pointer in, the pose of the bone out, for 3D Slicer and PLUS.

python examples/openigtlink/bridge.py --target knee.seg.nrrd --label Femur --tracker 127.0.0.1:18944

It is a client of the tracker's server (PLUS), whose TRANSFORM gives the tip of the pointer, and a server on port 18945
to which 3D Slicer connects (module OpenIGTLinkIF, a client connector). It sends TRANSFORM `TrackerToCT` with every
accepted pose, and STATUS `Registration` with every answer: after a refusal the last transform is an old one. The bone
must rest in the frame of the tracker, as in that of a reference on it; points that lie off it are left out, and after
three groups of them the collection restarts.

OpenIGTLink is in mm, a TRANSFORM takes the node to its parent, and patient coordinates are RAS: what goes to Slicer is
the pose with x and y negated on the side of the CT. Points of the tracker stay as they are.
"""

from __future__ import annotations

import argparse
import logging
import struct
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyigtl
from pyigtl.messages import MessageBase, message_type_to_class_constructor

from gapr_core import Accumulator, Registrar, RegistrarConfig, Tracker, load
from gapr_core.config import SensorConfig
from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats.options import ReadOptions

log = logging.getLogger(__name__)

LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
OK, NOT_FOUND = 1, 4  # codes of STATUS in the specification of OpenIGTLink
STEP_MM = 1.0  # a pointer that rests sends the same point again and again
GROUPS = 40  # of points, that are registered together


class StatusMessage(MessageBase):
    """STATUS of OpenIGTLink, which pyigtl does not have: code, sub-code, name of the error, text."""

    HEAD = struct.Struct("> H q 20s")

    def __init__(self, code: int = OK, text: str = "", **header: Any) -> None:
        super().__init__(**header)
        self._message_type, self._valid_message = "STATUS", True
        self.code, self.text = code, text

    def content_asstring(self) -> str:
        return f"Status {self.code}: {self.text}"

    def _pack_content(self) -> bytes:
        return self.HEAD.pack(self.code, 0, b"" if self.code == OK else b"refused") + self.text.encode() + b"\0"

    def _unpack_content(self, content: bytes) -> None:
        self.code = self.HEAD.unpack(content[: self.HEAD.size])[0]
        self.text = content[self.HEAD.size :].rstrip(b"\0").decode()


message_type_to_class_constructor["STATUS"] = StatusMessage


class Bridge:
    """Groups the points of one pointer and answers after every so many new ones.

    Args:
        registrar: registers each group together with those before, as `Accumulator` does.
        target: prepared by it, in LPS.
        tracker: a pyigtl client or server that receives the pointer's TRANSFORM.
        slicer: a pyigtl server or client that the answers are sent with.
        device: name of the TRANSFORM from the pointer's tip to the tracker.
        every: new points between two registrations.
    """

    def __init__(self, registrar: Any, target: Any, tracker: Any, slicer: Any, device: str, every: int = 50) -> None:
        self.registrar, self.target, self.tracker, self.slicer = registrar, target, tracker, slicer
        self.device, self.every = device, every
        self.points: list[np.ndarray] = []  # since the last registration
        self._last_tip = np.full(3, np.inf)

    def step(self, timeout_s: float = 1.0) -> Any:
        """Take in one message of the pointer; the result when this led to a registration, else None.

        Points that cannot be of one bone, as with a tip metres away, are left out, and the STATUS says why.
        """
        message = self.tracker.wait_for_message(self.device, timeout=timeout_s)
        if message is None or not np.isfinite(message.matrix).all():
            return None
        tip = np.array(message.matrix[:3, 3], dtype=np.float64)
        if np.linalg.norm(tip - self._last_tip) >= STEP_MM:
            self.points.append(tip)
            self._last_tip = tip
        if len(self.points) < self.every:
            return None
        group, self.points = np.array(self.points), []
        try:
            result = self.registrar.register(group, self.target)
        except InvalidPointCloudError as error:
            log.warning("%d points are left out: %s", len(group), error)
            self._send_status(NOT_FOUND, str(error))
            return None
        self.send(result)
        return result

    def send(self, result: Any) -> None:
        """TRANSFORM for an accepted pose, STATUS always."""
        if result.ok:
            matrix = LPS_TO_RAS @ result.T_target_source  # tracker to CT, RAS
            self.slicer.send_message(pyigtl.TransformMessage(matrix, device_name="TrackerToCT"), wait=False)
        self._send_status(OK if result.ok else NOT_FOUND, str(result))

    def _send_status(self, code: int, text: str) -> None:
        self.slicer.send_message(StatusMessage(code, text, device_name="Registration"), wait=False)


def main() -> int:
    """Run until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--target", type=Path, required=True, help="the bone: mesh (LPS) or label map")
    parser.add_argument("--label", action="append", default=[], help="name or number in a label map")
    parser.add_argument("--tracker", default="127.0.0.1:18944", help="HOST:PORT of the server that tracks the pointer")
    parser.add_argument("--device", default="StylusTipToTracker", help="its TRANSFORM of the pointer's tip")
    parser.add_argument("--port", type=int, default=18945, help="where 3D Slicer connects, on this machine")
    parser.add_argument("--every", type=int, default=50, help="new points between two registrations")
    args = parser.parse_args()
    pointer = RegistrarConfig(sensor=SensorConfig(kind="pointer"))
    registrar = Accumulator(Tracker(Registrar.from_pretrained(pointer)), most=GROUPS)
    target = registrar.prepare(load(args.target, options=ReadOptions(labels=tuple(args.label))))
    host, port = args.tracker.rsplit(":", 1)
    tracker, slicer = pyigtl.OpenIGTLinkClient(host, int(port)), pyigtl.OpenIGTLinkServer(args.port)
    bridge = Bridge(registrar, target, tracker, slicer, args.device, args.every)
    try:
        while True:
            if (result := bridge.step()) is not None:
                sys.stdout.write(f"{time.strftime('%H:%M:%S')} {len(registrar.collected)} points: {result}\n")
    except KeyboardInterrupt:
        return 0
    finally:
        tracker.stop()
        slicer.stop()


if __name__ == "__main__":
    raise SystemExit(main())
