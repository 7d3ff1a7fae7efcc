"""Points and recordings of tracked tools in files of NDI Track and PLUS."""

import numpy as np
from scipy.spatial.transform import Rotation

from gapr_core.geometry import se3

POINTS = np.array([[10.0, 20.0, 30.0], [-40.0, 5.0, 60.0], [7.0, -8.0, 90.0]])
LPS_RAS = [-1.0, -1.0, 1.0]
TIP = np.array([3.0, -5.0, 150.0])
PIVOT = np.array([100.0, -50.0, -1200.0])
T_REFERENCE_BONE = se3.from_rotation_translation(Rotation.from_rotvec([0.2, -0.5, 0.9]).as_matrix(), [20.0, 5.0, -40.0])


def turned_poses(count=40, noise=0.0, axis=None):
    """Poses of a tool that stands on its tip and is turned."""
    rng = np.random.default_rng(0)
    turns = rng.normal(0.0, 0.4, (count, 3)) if axis is None else rng.normal(0.0, 0.4, (count, 1)) * axis
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    poses[:, :3, 3] = PIVOT - poses[:, :3, :3] @ TIP + noise * rng.normal(size=(count, 3))
    return poses


def ndi_csv(path, poses, lost=()):
    """As NDI Track writes it: the scalar of the quaternion first; a tool that is not seen has no numbers of use."""
    rows = ["Tools,Port,Frame,Face,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error,Markers\n"]
    for i, T in enumerate(poses):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        values = [0.0] * 7 if i in lost else [w, x, y, z, *T[:3, 3]]
        state = "Missing" if i in lost else "OK"
        rows.append(",".join(["1", "A", str(i), "0", state, *map(str, values), "0.1", "4"]) + "\n")
    path.write_text("".join(rows))
    return path


def igs(path, poses, statuses):
    head = "ObjectType = Image\nNDims = 3\nDimSize = 1 1 2\n"
    for i, (T, status) in enumerate(zip(poses, statuses, strict=True)):
        numbers = " ".join(map(str, T.ravel()))
        head += f"Seq_Frame{i:04d}_ProbeToTrackerTransform = {numbers}\n"
        head += f"Seq_Frame{i:04d}_ProbeToTrackerTransformStatus = {status}\n"
    path.write_bytes(head.encode() + b"ElementDataFile = LOCAL\n\x00\x00")
    return path


def slices_with_poses(folder, poses, names=None, file="poses.csv"):
    folder.mkdir()
    names = names or [f"slice_{i:02d}.xyz" for i in range(len(poses))]
    for i, name in enumerate(names):
        np.savetxt(folder / name, POINTS + i)
    np.savetxt(folder / file, [np.ravel(T) for T in poses], delimiter=",")
    return folder


def motions(count, seed, turn=0.4, shift_mm=60.0):
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(rng.normal(0.0, turn, (count, 3))).as_matrix()
    return se3.from_rotation_translation(turns, rng.normal(0.0, shift_mm, (count, 3)))


def csv_of(path, *tools):
    lines = [",".join(["Tools,Port,Frame,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz"] * len(tools))]
    for i in range(len(tools[0][0])):
        words = []
        for poses, lost in tools:
            values = [*np.roll(Rotation.from_matrix(poses[i, :3, :3]).as_quat(), 1), *poses[i, :3, 3]]
            words += [
                "1",
                "A",
                str(i),
                "Missing" if i in lost else "OK",
                *(map(str, [0.0] * 7 if i in lost else values)),
            ]
        lines.append(",".join(words))
    path.write_text("\n".join(lines) + "\n")


def igs_of(path, *tools):
    head = "ObjectType = Image\nNDims = 3\nDimSize = 1 1 2\n"
    for name, (poses, lost) in zip(("ReferenceToTracker", "StylusToTracker"), tools, strict=True):
        for i, T in enumerate(poses):
            head += f"Seq_Frame{i:04d}_{name}Transform = {' '.join(map(str, T.ravel()))}\n"
            head += f"Seq_Frame{i:04d}_{name}TransformStatus = {'INVALID' if i in lost else 'OK'}\n"
    path.write_bytes(head.encode() + b"ElementDataFile = LOCAL\n\x00\x00")
