"""What the demo registers: a bone, clouds of it with the truth, and the bag that the clouds travel in."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from gapr_core.data.pair import Pair
    from gapr_core.data.specimen import Specimen
    from gapr_core.surface import Surface

Array = NDArray[np.float64]
FIRST_STAMP_S = 1_700_000_000.0
OWN_BAG = ".written_by_gapr_demo"  # in the folder of a bag that a later demo may replace


class DemoError(RuntimeError):
    """The demo could not be run to its end; the text says why."""


@dataclass(frozen=True)
class Act:
    """One act of the demo.

    Attributes:
        name: of the bone.
        bone: the pre-operative bone, mm.
        path: its file.
        clouds: (N, 3) mm each, in the frame of the sensor.
        truths: (4, 4) T_target_source of each, which only the simulation knows.
        period_s: time between two clouds.
        title, lead: of the report.
        frame_id: of the clouds.
        parameters: of the node, besides the bone.
        is_bone: (N,) for each cloud which of its points are on the bone; empty where nothing else is seen.
    """

    name: str
    bone: Surface
    path: Path
    clouds: tuple[Array, ...]
    truths: tuple[Array, ...]
    period_s: float
    title: str
    lead: str
    frame_id: str = "tracker"
    parameters: Mapping[str, Any] = field(default_factory=dict)
    is_bone: tuple[NDArray[np.bool_], ...] = ()

    @property
    def node_parameters(self) -> dict[str, Any]:
        """Everything that the node is started with."""
        return {"model_path": self.path.resolve(), "model_unit": "mm", **self.parameters}

    def stamp_ms(self, frame: int) -> int:
        """Time stamp of a frame's cloud, ms."""
        return round(1e3 * (FIRST_STAMP_S + frame * self.period_s))


def probe_sweep(bone: str, seed: int, frames: int, period_s: float, folder: Path) -> Act:
    """Make a probe that sweeps along a parametric bone; each cloud holds all points so far."""
    from gapr_core.data import sweep

    specimen, path = _specimen(bone, seed, folder)
    swept = sweep.simulate(specimen, seed, sweep.Acquisition(frames=frames))
    lead = (
        f"A tracked probe sweeps along a {bone}; the one-sided cloud of all it has seen so far goes from a bag "
        "through register_node, a ROS 2 process of its own, to a pose of the pre-operative bone, or to a refusal."
    )
    truths, title = (swept.T_target_source,) * frames, "From a bag to a trusted pose"
    return Act(bone, specimen.surface, path, swept.clouds, truths, period_s, title, lead)


def camera_round(bone: str, seed: int, frames: int, period_s: float, folder: Path) -> Act:
    """Make a camera that circles a wound while the bone moves; each cloud is one image, in the camera's frame."""
    from gapr_core.data.scenes.stream import SceneMotion, simulate

    specimen, path = _specimen(bone, seed, folder)
    return act_of_pairs(specimen, path, list(simulate(specimen, seed, SceneMotion(frames=frames))), period_s)


def act_of_pairs(specimen: Specimen, path: Path, pairs: Sequence[Pair], period_s: float) -> Act:
    """Make an act of the camera's frames of `gapr_core.data.scenes.stream`; `path` is the file of the bone."""
    from gapr_core.geometry import se3

    lead = (
        f"A depth camera circles a wound with a {specimen.bone} at its bottom, while the bone moves. No point is known "
        "to be bone: the node knows where the camera is (viewpoint) and finds out from its lines of sight what can be "
        "bone."
    )
    shifts = (se3.from_rotation_translation(np.eye(3), pair.metadata["origin_mm"]) for pair in pairs)
    return Act(
        specimen.bone, specimen.surface, path, tuple(pair.source for pair in pairs),
        tuple(shift @ pair.T_target_source for shift, pair in zip(shifts, pairs, strict=True)),
        period_s, "A camera looks into a wound", lead, "camera",
        {"viewpoint": "origin"},
        tuple(pair.metadata["is_bone"] for pair in pairs),
    )  # fmt: skip


def _specimen(bone: str, seed: int, folder: Path) -> tuple[Specimen, Path]:
    """Make a parametric bone, and write its file."""
    from gapr_core.data.pool import parametric_specimen

    specimen = parametric_specimen(bone, seed)
    return specimen, write_bone(specimen, folder)


def write_bone(specimen: Specimen, folder: Path) -> Path:
    """Write the bone as STL (mm), as a segmented CT would be, and return its path. No user's bone has its name."""
    path = folder / f"demo_{specimen.bone}.stl"
    write_stl(specimen.surface, path)
    return path


def write_stl(surface: Surface, path: Path) -> None:
    """Write a mesh as binary STL."""
    import open3d as o3d

    mesh = surface.to_open3d()
    mesh.compute_triangle_normals()
    if not o3d.io.write_triangle_mesh(str(path), mesh):
        raise DemoError(f"{path} could not be written")


def write_bag(act: Act, path: Path, storage: str) -> None:
    """Write the clouds as a rosbag2 bag: one PointCloud2 a frame, metres, in the frame of the sensor.

    Raises:
        DemoError: something is there that no demo has written.
    """
    from gapr_ros.bags.writing import BagWriter
    from gapr_ros.node import units

    if path.exists():
        if not (path / OWN_BAG).is_file():
            raise DemoError(f"expected a free place for the bag; got {path}, which no demo wrote; choose another --out")
        shutil.rmtree(path)
    with BagWriter(path, storage) as bag:
        (path / OWN_BAG).touch()
        for frame, cloud in enumerate(act.clouds):
            bag.write_cloud("/points", units.to_metres(cloud), act.frame_id, act.stamp_ms(frame) * 1_000_000)
