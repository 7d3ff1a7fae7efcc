"""Draw the pictures of docs/concepts/scenes.md: a scene of each protocol, and one wound from four places.

python -m gapr_core.data.scenes.figure docs/figures/scenes.png --looks docs/figures/looks.png
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
LOOKED_AT = ("tibia", "scene-stereo-looks")
BONE, OTHER = np.array([0.98, 0.88, 0.66]), np.array([0.80, 0.24, 0.20])
PERSON, SEED = 3, 1
FAR_MM = 1e4  # from where a cloud without a viewpoint is looked at


def main(arguments: list[str] | None = None) -> int:
    """Write the picture, and with `--looks` that of the looks."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--looks", type=Path, help="picture of one wound from four places")
    args = parser.parse_args(arguments)
    draw(args.out)
    if args.looks:
        draw_looks(args.looks)
    return 0


def draw(out: Path) -> None:
    """Draw one panel a protocol, as the camera sees it; bone is light, all else is red."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.6 * COLUMNS, 2.8 * len(PANELS) // COLUMNS), layout="constrained")
    axes = figure.subplots(len(PANELS) // COLUMNS, COLUMNS)
    for ax, (bone, protocol) in zip(axes.flat, PANELS, strict=True):
        _panel(ax, make_pair(protocol, parametric_specimen(bone, PERSON), SEED))
    _save(figure, out)


def draw_looks(out: Path) -> None:
    """Draw one panel a look of the same wound, each as the camera sees it from there."""
    from matplotlib.figure import Figure

    bone, protocol = LOOKED_AT
    pair = make_pair(protocol, parametric_specimen(bone, PERSON), SEED)
    look, places = np.asarray(pair.metadata["look"]), pair.viewpoint
    assert places is not None
    figure = Figure(figsize=(2.6 * (look.max() + 1), 2.8), layout="constrained")
    axes = figure.subplots(1, look.max() + 1)
    up = np.linalg.svd(pair.source - pair.source.mean(axis=0), full_matrices=False)[2][0]
    for number, ax in enumerate(axes):
        of_it = look == number
        is_bone = np.asarray(pair.metadata["is_bone"])[of_it]
        paint(ax, pair.source[of_it], places[of_it][0], np.where(is_bone[:, None], BONE, OTHER), up)
        ax.set_title(f"look {number + 1}, {is_bone.mean():.0%} bone", fontsize=12)
    _save(figure, out)


def _save(figure: Any, out: Path) -> None:
    from PIL import Image

    figure.savefig(out, dpi=80)
    Image.open(out).convert("RGB").quantize(COLOURS).save(out, optimize=True)


def _panel(ax: Any, pair: Pair) -> None:
    is_bone = np.asarray(pair.metadata["is_bone"])
    paint(ax, pair.source, pair.viewpoint, np.where(is_bone[:, None], BONE, OTHER))
    ax.set_title(f"{pair.protocol}\n{pair.bone}, {is_bone.mean():.0%} bone", fontsize=12)


def paint(axes: Any, points: Array, viewpoint: Array | None, colours: Array, up: Array | None = None) -> None:
    """Draw the image of a cloud, shaded by its normals.

    Args:
        axes: of matplotlib.
        points: (N, 3) mm.
        viewpoint: (3,) mm, where the camera is; None: the cloud is looked at from far away, across its flattest side.
        colours: (N, 3) red, green, blue, 0 to 1, of the lit points.
        up: (3,) direction that is up in the image; the cloud's longest side where it is not given.
    """
    image, sight = _image(points, viewpoint, up)
    light = np.abs((_normals(points) * sight).sum(axis=1))[:, None] ** 0.7
    axes.scatter(*image.T, c=light * colours, s=max(1.5, 12_000.0 / len(image)), linewidths=0)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.set_frame_on(False)


def _image(points: Array, viewpoint: Array | None, up: Array | None) -> tuple[Array, Array]:
    """Places (N, 2) in the image and unit lines of sight (N, 3)."""
    middle = points.mean(axis=0)
    longest, across = np.linalg.svd(points - middle, full_matrices=False)[2][[0, 2]]
    up = longest if up is None else up
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
