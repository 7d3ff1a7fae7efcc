"""Mutated PointCloud2 against the node's way of reading them: nothing may die, hang, raise, or be read wrongly.

python test/ros/fuzz.py [--count 100000] [--seed 0] [--keep test/ros/findings]

The messages are read by child processes that are started again when one dies or hangs; the message that did it is kept
as a file, and `test_fuzz.py` reads every kept file from then on. What is read is compared with a decoder of its own,
point by point with `struct`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import psutil
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from gapr_ros.node import cloud as cloud_room
from gapr_ros.node.gate import Gate
from gapr_ros.node.outcome import RefusedError
from gapr_ros.parameters import NodeParameters
from msg_adapters import InvalidMessageError, cloud_to_xyz

FINDINGS = Path(__file__).parent / "findings"
BATCH = 20_000  # messages that one child reads
HANG_S = 5.0
START_S = 30.0  # imports
CODES = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}
EXTREME = (0, 1, 2, 3, 4, 7, 8, 12, 15, 16, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1)
PARAMETERS = NodeParameters()
MODEL_EXTENT_MM = 240.0


def message(rng: np.random.Generator) -> PointCloud2:
    """A legal cloud of a random layout."""
    kinds = rng.choice([7, 8], 3)
    names = list(rng.permutation(["x", "y", "z", "intensity", "ring"]))
    fields, offset = [], int(rng.integers(0, 5))
    for name in names:
        code = int(kinds["xyz".index(name)]) if name in "xyz" else int(rng.integers(1, 9))
        fields.append(PointField(name=name, offset=offset, datatype=code, count=1))
        offset += struct.calcsize(CODES[code]) + int(rng.integers(0, 4))
    height, width = int(rng.integers(0, 4)), int(rng.integers(0, 12))
    row_step = width * offset + int(rng.choice([0, 0, 5]))
    data = rng.normal(scale=0.05, size=(height * row_step + 7) // 8).astype("f8").tobytes()[: height * row_step]
    if rng.random() < 0.3:
        data = rng.bytes(height * row_step)
    header = Header(frame_id=str(rng.choice(["probe", "/probe", "", "bone_preop"])))
    header.stamp.sec, header.stamp.nanosec = int(rng.choice([0, 5, 1_700_000_000])), int(rng.integers(0, 10**9))
    return PointCloud2(header=header, height=height, width=width, fields=fields, is_bigendian=bool(rng.random() < 0.3),
                       point_step=offset, row_step=row_step, data=data, is_dense=True)  # fmt: skip


def mutate(cloud: PointCloud2, rng: np.random.Generator) -> None:
    """One thing of a cloud made wrong."""
    which = rng.integers(0, 9)
    extreme = int(rng.choice(EXTREME))
    if which < 4:
        setattr(cloud, ("height", "width", "point_step", "row_step")[which], extreme)
    elif which == 4:
        cloud.data = cloud.data[: int(rng.integers(0, len(cloud.data) + 1))]
    elif which == 5:
        cloud.data = bytes(cloud.data) + rng.bytes(int(rng.integers(0, 30)))
    elif which == 6:
        cloud.header.stamp.sec = int(rng.choice([-(2**31), -1, 0, 2**31 - 1]))
        cloud.header.stamp.nanosec = int(rng.choice([0, 10**9, 2**32 - 1]))
    else:
        field = cloud.fields[int(rng.integers(0, len(cloud.fields)))]
        name, value = (("offset", extreme), ("datatype", extreme % 256), ("count", extreme),
                       ("name", str(rng.choice(["x", "", "y" * 300]))))[int(rng.integers(0, 4))]  # fmt: skip
        setattr(field, name, value)


def case(seed: int, number: int) -> bytes:
    """The bytes of one mutated message, the same for the same numbers."""
    rng = np.random.default_rng((seed, number))
    cloud = message(rng)
    for _ in range(int(rng.integers(0, 3))):
        mutate(cloud, rng)
    data = bytearray(serialize_message(cloud))
    for _ in range(int(rng.choice([0, 0, 0, 1, 4]))):
        data[int(rng.integers(0, len(data)))] = int(rng.integers(0, 256))
    if rng.random() < 0.1:
        del data[int(rng.integers(0, len(data))) :]
    return bytes(data)


def check(data: bytes) -> str:
    """What becomes of the bytes on the node's way; raises for whatever must not happen."""
    header = cloud_room.read_header(data)
    try:
        if header is not None:
            Gate().admit(header, 0, PARAMETERS)
        points = cloud_room.take_in(cloud_room.read_message(data), MODEL_EXTENT_MM, PARAMETERS).points_mm
    except RefusedError as refusal:
        _compare(data)
        return str(refusal.reason)
    assert points.ndim == 2 and points.shape[1] == 3 and np.isfinite(points).all()
    _compare(data)
    return "read"


def _compare(data: bytes) -> None:
    """The adapter's points are those of the decoder below, or it refuses what that one cannot read."""
    try:
        cloud = deserialize_message(data, PointCloud2)
    except Exception:  # no message at all
        return
    if cloud.width * cloud.height > 2000:
        return
    try:
        read = cloud_to_xyz(cloud, keep_nan=True)
    except InvalidMessageError:
        return
    np.testing.assert_array_equal(read, decoded(cloud))


def decoded(cloud: PointCloud2) -> np.ndarray:
    """(N, 3) of a cloud, value by value."""
    if not cloud.width * cloud.height:
        return np.empty((0, 3))
    order = ">" if cloud.is_bigendian else "<"
    packed = cloud.width * cloud.point_step
    whole = cloud.row_step == packed * cloud.height == len(cloud.data)  # a slip of drivers that is read as meant
    row_step = cloud.row_step if cloud.row_step and not whole else packed
    fields = {field.name: field for field in reversed(cloud.fields)}
    data, rows = bytes(cloud.data), []
    for row in range(cloud.height):
        for column in range(cloud.width):
            start = row * row_step + column * cloud.point_step
            rows.append([_value(order + CODES[fields[n].datatype], data, start + fields[n].offset) for n in "xyz"])
    return np.array(rows)


def _value(code: str, data: bytes, offset: int) -> float:
    return float(struct.unpack_from(code, data, offset)[0])


def child(seed: int, first: int, last: int, current: Path) -> int:
    """Read cases; the one in hand is always in the file, so that a dead process can be asked what it read."""
    outcomes: Counter[str] = Counter()
    with current.open("r+b") as file:
        for number in range(first, last):
            file.seek(0)
            file.write(struct.pack("<q", number))
            file.flush()
            try:
                outcomes[check(case(seed, number))] += 1
            except Exception as error:
                outcomes[f"raised:{number}:{' '.join(str(error).split())[:200]}"] += 1
    json.dump(outcomes, sys.stdout)
    return 0


def run(count: int, seed: int, keep: Path | None, first: int = 0) -> tuple[Counter[str], list[str]]:
    """What became of the cases `first` to `count`, and a line for each finding."""
    outcomes: Counter[str] = Counter()
    findings, number = [], first
    with tempfile.TemporaryDirectory() as folder:
        current, said, complained = (Path(folder) / name for name in ("current", "said", "complained"))
        while number < count:
            current.write_bytes(struct.pack("<q", number))
            end = min(number + BATCH, count)
            process = subprocess.Popen(
                [sys.executable, __file__, "--child", str(seed), str(number), str(end), str(current)],
                stdout=said.open("w"), stderr=complained.open("w"),
            )  # fmt: skip
            why = _wait(process, current, complained)
            found = {} if why else json.loads(said.read_text())
            raised = [name.split(":", 2) for name in found if name.startswith("raised:")]
            guilty = {int(index): text for _, index, text in raised}
            outcomes.update({name: count for name, count in found.items() if not name.startswith("raised:")})
            number = end
            if why:
                number = _number(current) + 1
                guilty[number - 1] = why
            findings += [f"case {seed}/{index}: {text}" for index, text in guilty.items()]
            for index in guilty if keep is not None else ():
                _keep(case(seed, index), keep)
    return outcomes, findings


def _number(current: Path) -> int:
    return int(struct.unpack("<q", current.read_bytes()[:8])[0])


def _wait(process: subprocess.Popen[bytes], current: Path, complained: Path) -> str:
    """Why the child did not come to its end. Its own CPU time counts: the machine may be busy."""
    seen, since_s = -1, 0.0
    while process.poll() is None:
        number, spent_s = _number(current), _cpu_s(process)
        if number != seen:
            seen, since_s = number, spent_s + (START_S if seen < 0 else 0.0)
        if spent_s > since_s + HANG_S:
            process.kill()
            process.wait()
            return f"no answer after {HANG_S:g} s of CPU time"
        time.sleep(0.05)
    lines = complained.read_text(errors="replace").strip().splitlines() or ["no word"]
    return f"exit code {process.returncode}: {lines[-1]}" if process.returncode else ""


def _cpu_s(process: subprocess.Popen[bytes]) -> float:
    try:
        times = psutil.Process(process.pid).cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    return float(times.user + times.system)


def _keep(data: bytes, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"cloud-{hashlib.sha256(data).hexdigest()[:12]}.cdr").write_bytes(data)


def main() -> int:
    """Run and say what came out."""
    if sys.argv[1:2] == ["--child"]:
        seed, first, last, current = sys.argv[2:]
        return child(int(seed), int(first), int(last), Path(current))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=FINDINGS, help="folder for messages that did harm")
    given = parser.parse_args()
    start = time.monotonic()
    outcomes, findings = run(given.count, given.seed, given.keep)
    for line in findings:
        sys.stdout.write(f"FOUND {line}\n")
    said = "  ".join(f"{name} {count}" for name, count in outcomes.most_common())
    sys.stdout.write(f"{given.count} messages in {time.monotonic() - start:.0f} s, {len(findings)} findings: {said}\n")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
