"""One small bone-sized body in every format of patient data: label maps, markups, recordings, text clouds, bags."""

import json
import sys
import tempfile
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from mesh_samples import body
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

SPACING = (4.0, 4.0, 5.0)


@cache
def text_samples():
    """Bytes of the files that Python alone reads, by their names."""
    points, _ = body()
    rows = [f"{x:.2f} {y:.2f} {z:.2f}\n" for x, y, z in points]
    made = {"cloud.xyz": "".join(rows), "cloud.txt": "# of a probe\nx;y;z\n" + "".join(rows).replace(" ", ";")}
    made["cloud.csv"] = "Time,X,Y,Z\n" + "".join(f"{i},{row.replace(' ', ',')}" for i, row in enumerate(rows))
    made |= _markups(points) | _recordings(points)
    return {name: text.encode() for name, text in made.items()}


@cache
def native_samples():
    """Bytes of the files whose readers use native code, by their names; those whose libraries are installed."""
    made = _label_maps() if find_spec("SimpleITK") else {}
    made |= _dicom() if find_spec("highdicom") else {}
    return made | (_bags() if find_spec("rosbags") and find_spec("rclpy") else {})


def _markups(points):
    controls = [{"id": str(i), "label": f"F-{i}", "position": p.tolist()} for i, p in enumerate(points[:20])]
    node = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": controls}
    rows = "".join(f"p{i},{x:.2f},{y:.2f},{z:.2f},0,0,0,1,1,1,0,F-{i},,\n" for i, (x, y, z) in enumerate(points[:20]))
    head = "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n"
    head += "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    return {"points.mrk.json": json.dumps({"markups": [node]}, indent=1), "points.fcsv": head + rows}


def _recordings(points):
    """Poses of a tool whose tip, at (0, 0, 100), goes over the body."""
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(0.0, 0.3, (20, 3)))
    origins = points[:20] - turns.apply([0.0, 0.0, 100.0])
    rows, head = ["Tools,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error\n"], "ObjectType = Image\nNDims = 3\nDimSize = 2 2 20\n"
    for i, (turn, origin) in enumerate(zip(turns, origins, strict=True)):
        x, y, z, w = turn.as_quat()
        rows.append(",".join(["1", "OK", *(f"{v:.6f}" for v in (w, x, y, z, *origin)), "0.1"]) + "\n")
        T = np.vstack([np.column_stack([turn.as_matrix(), origin]), [0, 0, 0, 1]])
        head += f"Seq_Frame{i:04d}_ProbeToTrackerTransform = {' '.join(f'{v:.6f}' for v in T.ravel())}\n"
        head += f"Seq_Frame{i:04d}_ProbeToTrackerTransformStatus = OK\n"
    return {"tool.csv": "".join(rows), "tool.igs.mha": head + "ElementDataFile = LOCAL\n" + 80 * "."}


def _label_maps():
    import SimpleITK
    from label_map_files import affine_of, image_of, voxels_of

    affine, size = affine_of(SPACING, turn=(0.1, 0.2, 0.3))
    image, made = image_of(voxels_of(affine, size), affine), {}
    image.SetMetaData("Segment0_Name", "Femur")
    image.SetMetaData("Segment0_LabelValue", "1")
    with tempfile.TemporaryDirectory() as folder:
        for name, packed in (("a.nii", False), ("a.nii.gz", True), ("raw.nrrd", False), ("packed.seg.nrrd", True),
                             ("raw.mha", False), ("packed.mha", True)):  # fmt: skip
            SimpleITK.WriteImage(image, str(Path(folder) / name), packed)
            made[name] = (Path(folder) / name).read_bytes()
    return made


def _dicom():
    from label_map_files import dicom_seg

    with tempfile.TemporaryDirectory() as folder:
        return {"one.dcm": dicom_seg(Path(folder), SPACING, ("femur",)).read_bytes()}


def _bags():
    from gapr_ros.bags.writing import BagWriter

    points, made = body()[0] / 1000.0, {}
    for storage, ending in (("mcap", "mcap"), ("sqlite3", "db3")):
        with tempfile.TemporaryDirectory() as folder:
            with BagWriter(Path(folder) / "bag", storage) as writer:
                for i, part in enumerate(np.array_split(points, 3)):
                    writer.write_cloud("/points", part, "probe", 1_700_000_000_000_000_000 + i)
            made[f"bag.{ending}"] = next((Path(folder) / "bag").glob(f"*.{ending}")).read_bytes()
    return made
