"""Files of a registration for the eye: residuals of every point, and a folder that 3D Slicer opens."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import ConfigError
from gapr_core.formats import planning, signatures, transforms
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, Residuals, TargetError
from gapr_core.runtime import files
from gapr_core.surface import Surface

Array = NDArray[np.float64]

TARGETS, OFF_BONE = "targets.mrk.json", "off_bone.vtk"
FILES = ("target.vtk", "source.vtk", OFF_BONE, "registered.ply", "pose.tfm", TARGETS, "scene.mrml")  # of `write_slicer`
WRITTEN_BY = "written by GAPR"  # a comment of the scene; 3D Slicer keeps none when it saves one
FULL_COLOUR_MM = 3.0
BLUE_TO_RED = "vtkMRMLColorTableNodeFileDivergingBlueRed.txt"  # of 3D Slicer; without one VTK's goes from red to blue
GREY = np.array([150, 150, 150])


def residuals_json(residuals: Residuals) -> dict[str, object]:
    """Points (source frame, mm), signed distances (mm; null where no surface is near) and who counts for the pose."""
    near = np.isfinite(residuals.distance_mm)
    distances = [float(d) if ok else None for d, ok in zip(residuals.distance_mm, near, strict=True)]
    return {"points": residuals.points.tolist(), "distance_mm": distances, "inlier": residuals.inlier.tolist()}


def write_coloured(path: Path, points: Array, residuals: Residuals) -> None:
    """Write a PLY of points (N, 3): blue inside, white on the bone, red outside, grey far away."""
    from plyfile import PlyData, PlyElement

    kinds = [(axis, "f4") for axis in "xyz"] + [(colour, "u1") for colour in ("red", "green", "blue")]
    rows = np.empty(len(points), dtype=[*kinds, ("distance_mm", "f4")])
    colours = colours_of(residuals.distance_mm)
    for i, (axis, colour) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        rows[axis], rows[colour] = points[:, i], colours[:, i]
    rows["distance_mm"] = residuals.distance_mm
    with files.replacing(path) as scratch:
        PlyData([PlyElement.describe(rows, "vertex")], comments=["SPACE=LPS"]).write(str(scratch))


def colours_of(distance_mm: Array) -> NDArray[np.int64]:
    """(N, 3) red, green, blue of signed distances (N,) mm: blue inside, white on the bone, red outside; NaN is grey."""
    share = np.clip(np.nan_to_num(distance_mm) / FULL_COLOUR_MM, -1.0, 1.0)
    red, blue = 1.0 - np.maximum(-share, 0.0), 1.0 - np.maximum(share, 0.0)
    colours = (255 * np.stack([red, np.minimum(red, blue), blue], axis=1)).round().astype(np.int64)
    colours[~np.isfinite(distance_mm)] = GREY
    return colours


def check_slicer(folder: Path) -> None:
    """Raise for a folder with files of others: all may be replaced where the scene in it is one of GAPR.

    Args:
        folder: for `write_slicer`; may be missing.

    Raises:
        ConfigError: one of these files is there and not known to be of GAPR, or the folder holds DICOM files.
    """
    if not folder.is_dir() or _is_own(folder / "scene.mrml"):
        return
    how = "name another folder, or a new one"
    if taken := [name for name in FILES if (folder / name).exists()]:
        given = f"{folder} with {', '.join(taken)}, not known to be written by GAPR"
        raise ConfigError("a folder for --slicer without files of others", given, how)
    if any(map(signatures.is_dicom, folder.iterdir())):
        raise ConfigError("a folder for --slicer without files of others", f"{folder} with DICOM files", how)


def _is_own(path: Path) -> bool:
    """Tell whether a scene is there as `write_slicer` left it."""
    return path.is_file() and f"<!-- {WRITTEN_BY} -->".encode() in path.read_bytes()


def write_slicer(folder: Path, result: RegistrationResult) -> None:
    """Write a folder: target, source, transform, planned targets, and a scene.mrml for all.

    Points of the source near which no surface is have no distance: they are a grey model of their own, `off_bone`.

    Args:
        folder: made if it is not there; files of other names in it stay.
        result: an accepted pose with residuals, and the bone, LPS mm.
    """
    if result.T_target_source is None or result.residuals is None or result.bone is None:
        raise ValueError("a scene needs a bone, a pose and its residuals")
    with files.together():
        _write_scene(folder, result.bone, result.T_target_source, result.residuals, result.targets)


def remove(folder: Path) -> None:
    """Remove the files of an earlier scene, which would contradict what is written now."""
    for name in FILES:
        files.remove(folder / name)


def _write_scene(
    folder: Path, target: Surface, T_target_source: Array, residuals: Residuals, errors: Sequence[TargetError]
) -> None:
    near = np.isfinite(residuals.distance_mm)
    # first: after an interrupted run the folder is known as one of GAPR
    files.write_text(folder / "scene.mrml", _mrml(not near.all(), bool(errors)))
    files.write_text(folder / "target.vtk", _vtk(target.points, target.faces))
    files.write_text(folder / "source.vtk", _vtk(residuals.points[near], None, residuals.distance_mm[near]))
    if near.all():
        files.remove(folder / OFF_BONE)
    else:
        files.write_text(folder / OFF_BONE, _vtk(residuals.points[~near], None))
    write_coloured(folder / "registered.ply", se3.apply(T_target_source, residuals.points), residuals)
    transforms.write(folder / "pose.tfm", T_target_source)
    if errors:
        planning.save_targets(folder / TARGETS, errors)
    else:
        files.remove(folder / TARGETS)


def _vtk(points: Array, faces: NDArray[np.int64] | None, distances: Array | None = None) -> str:
    """Legacy VTK text, which 3D Slicer colours by its scalars; a cloud has its points as cells."""
    cells = np.arange(len(points))[:, None] if faces is None or len(faces) == 0 else faces
    name, size = ("VERTICES", 1) if cells.shape[1] == 1 else ("POLYGONS", 3)
    lines = ["# vtk DataFile Version 3.0", "SPACE=LPS", "ASCII", "DATASET POLYDATA", f"POINTS {len(points)} float"]
    lines += ["{:.4f} {:.4f} {:.4f}".format(*point) for point in points]
    lines += [f"{name} {len(cells)} {len(cells) * (size + 1)}"]
    lines += [" ".join(map(str, (size, *cell))) for cell in cells.tolist()]
    if distances is not None:
        lines += [f"POINT_DATA {len(points)}", "SCALARS distance_mm float 1", "LOOKUP_TABLE default"]
        lines += [f"{distance:.4f}" for distance in distances]
    return "\n".join(lines) + "\n"


def _mrml(with_off_bone: bool, with_targets: bool) -> str:
    """Write the scene: each node with its storage, and the source under the transform."""
    moved = {"transformNodeRef": "vtkMRMLLinearTransformNodepose"}
    scene = ElementTree.Element("MRML", version="Slicer4.4.0", userTags="")
    scene.append(ElementTree.Comment(f" {WRITTEN_BY} "))
    _node(scene, "LinearTransform", "Transform", "pose", "pose.tfm", {})
    _model(scene, "target", "0.9 0.85 0.75", {"opacity": "0.6"}, {})
    shown = {
        "scalarVisibility": "true", "activeScalarName": "distance_mm", "pointSize": "4", "colorNodeID": BLUE_TO_RED,
        "scalarRangeFlag": "UseManual", "scalarRange": f"{-FULL_COLOUR_MM:g} {FULL_COLOUR_MM:g}",
    }  # fmt: skip
    _model(scene, "source", "0.9 0.2 0.2", shown, moved)
    if with_off_bone:
        _model(scene, "off_bone", "{:.2f} {:.2f} {:.2f}".format(*GREY / 255), {"pointSize": "4"}, moved)
    if with_targets:
        display = "vtkMRMLMarkupsFiducialDisplayNodetargets"  # a scene that is loaded makes none of its own
        ElementTree.SubElement(scene, "MarkupsFiducialDisplay", id=display, name="targets display")
        _node(scene, "MarkupsFiducial", "MarkupsJson", "targets", TARGETS, {"displayNodeRef": display})
    return ElementTree.tostring(scene, encoding="unicode", xml_declaration=False) + "\n"


def _model(
    scene: ElementTree.Element, name: str, colour: str, display: dict[str, str], references: dict[str, str]
) -> None:
    shown = f"vtkMRMLModelDisplayNode{name}"
    ElementTree.SubElement(scene, "ModelDisplay", {"id": shown, "name": f"{name} display", "color": colour} | display)
    _node(scene, "Model", "Model", name, f"{name}.vtk", {"displayNodeRef": shown} | references)


def _node(
    scene: ElementTree.Element, kind: str, storage: str, name: str, file: str, references: dict[str, str]
) -> None:
    place = f"vtkMRML{storage}StorageNode{name}"
    ElementTree.SubElement(scene, f"{storage}Storage", id=place, name=f"{name} storage", fileName=file)
    wanted = {"storageNodeRef": place} | references
    ElementTree.SubElement(scene, kind, {"id": f"vtkMRML{kind}Node{name}", "name": name} | wanted)
