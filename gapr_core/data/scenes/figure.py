"""The picture of docs/scenes.md: what the camera sees in a scene of each protocol.

python -m gapr_core.data.scenes.figure docs/figures/scenes.png
"""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.pair import Pair
from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.data.scenes.camera import upright

Array = NDArray[np.float64]
PANELS = (
    *(("femur", f"scene-{name}") for name in ("C1", "C2", "C3", "packed", "windows")),
    *(("tibia", f"scene-{name}") for name in ("C1", "slit", "hand", "image", "ultrasound")),
    *(("pelvis", f"scene-{name}") for name in ("stereo", "layers", "C3", "table", "drape")),
)
COLUMNS, COLOURS = 5, 64
BONE, OTHER = np.array([0.98, 0.88, 0.66]), np.array([0.80, 0.24, 0.20])
PERSON, SEED = 3, 1
FAR_MM = 1e4  # from where a cloud without a viewpoint is looked at


def main(arguments: list[str] | None = None) -> int:
    """Write the picture."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    draw(parser.parse_args(arguments).out)
    return 0


def draw(out: Path) -> None:
    """One panel a protocol, as the camera sees it; bone is light, all else is red."""
    from matplotlib.figure import Figure
    from PIL import Image

    figure = Figure(figsize=(2.6 * COLUMNS, 2.8 * len(PANELS) // COLUMNS), layout="constrained")
    axes = figure.subplots(len(PANELS) // COLUMNS, COLUMNS)
    for ax, (bone, protocol) in zip(axes.flat, PANELS, strict=True):
        _panel(ax, make_pair(protocol, parametric_specimen(bone, PERSON), SEED))
    figure.savefig(out, dpi=80)
    Image.open(out).convert("RGB").quantize(COLOURS).save(out, optimize=True)


def _panel(ax: Any, pair: Pair) -> None:
    is_bone = np.asarray(pair.metadata["is_bone"])
    paint(ax, pair.source, pair.viewpoint, np.where(is_bone[:, None], BONE, OTHER))
    ax.set_title(f"{pair.protocol}\n{pair.bone}, {is_bone.mean():.0%} bone", fontsize=12)


def paint(axes: Any, points: Array, viewpoint: Array | None, colours: Array) -> None:
    """The image of a cloud, shaded by its normals.

    Args:
        axes: of matplotlib.
        points: (N, 3) mm.
        viewpoint: (3,) mm, where the camera is; None: the cloud is looked at from far away, across its flattest side.
        colours: (N, 3) red, green, blue, 0 to 1, of the lit points.
    """
    image, sight = _image(points, viewpoint)
    light = np.abs((_normals(points) * sight).sum(axis=1))[:, None] ** 0.7
    axes.scatter(*image.T, c=light * colours, s=max(1.5, 12_000.0 / len(image)), linewidths=0)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.set_frame_on(False)


def _image(points: Array, viewpoint: Array | None) -> tuple[Array, Array]:
    """Places (N, 2) in the image and unit lines of sight (N, 3)."""
    middle = points.mean(axis=0)
    up, across = np.linalg.svd(points - middle, full_matrices=False)[2][[0, 2]]
    eye = middle + FAR_MM * across if viewpoint is None else viewpoint
    sight = points - eye
    seen = sight @ upright(middle, eye, up).axes.T
    return seen[:, :2] / seen[:, 2:] * [1.0, -1.0], sight / np.linalg.norm(sight, axis=1, keepdims=True)


def _normals(points: Array) -> Array:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))
    return np.asarray(cloud.normals)


if __name__ == "__main__":
    raise SystemExit(main())
