"""A registration as a recording (.rrd) for the viewer of rerun: the bone, the points on it, rivals, planned targets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import ConfigError, MethodUnavailableError
from gapr_core.formats.scene import GREY, colours_of
from gapr_core.results import RegistrationResult, TargetError
from gapr_core.runtime import files
from gapr_core.surface import Surface

Array = NDArray[np.float64]

ENDING = ".rrd"
APPLICATION = "gapr"
TIMELINE = "hypothesis"  # 1 is the best one
MOST_HYPOTHESES = 5
BONE_COLOUR, TARGET_COLOUR = (234, 223, 200), (209, 73, 91)
POINT_MM, TARGET_MM = 0.7, 2.5  # radii


def check(path: Path) -> None:
    """Raise before the work if a recording cannot be written.

    Raises:
        ConfigError: another ending than .rrd.
        MethodUnavailableError: rerun is not installed.
    """
    if path.suffix.lower() != ENDING:
        raise ConfigError(f"a recording as {ENDING}", path.name, f"let its name end with {ENDING}")
    _rerun()


def write(path: Path, result: RegistrationResult) -> None:
    """Write one .rrd file, for an accepted pose and for a refusal. Its timeline goes through the hypotheses.

    Args:
        path: ends with .rrd; open it with `rerun PATH`.
        result: of registering a source to a bone, which it knows.

    Raises:
        ConfigError: another ending, or a path that cannot be written.
        MethodUnavailableError: rerun is not installed.
    """
    check(path)
    if result.bone is None or result.source is None:
        raise ValueError("a recording needs a result that knows its bone and its source")
    rr = _rerun()
    stream = rr.RecordingStream(APPLICATION)
    stream.log("/", rr.ViewCoordinates.LBU, static=True)  # left, back, up: LPS
    stream.log("target", _bone(rr, result.bone), static=True)
    stream.log("answer", rr.TextDocument(_words(result)), static=True)
    if result.targets:
        stream.log("planned", _planned(rr, result.targets), static=True)
    for number, (T, probability) in enumerate(_poses(result), 1):
        stream.set_time(TIMELINE, sequence=number)
        stream.log("source", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        stream.log("source", _points(rr, result.source, result, number))
        stream.log("probability", rr.Scalars(probability))
    with files.replacing(path) as scratch:
        stream.save(scratch)
        stream.disconnect()


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise MethodUnavailableError(f"{ENDING} files", "no rerun", "pip install 'gapr_ros[rerun]'") from error
    return rerun


def _bone(rr: Any, target: Surface) -> Any:
    if target.faces is None:
        return rr.Points3D(target.points, colors=BONE_COLOUR, radii=POINT_MM)
    return rr.Mesh3D(vertex_positions=target.points, triangle_indices=target.faces, albedo_factor=BONE_COLOUR)


def _words(result: RegistrationResult) -> str:
    """Return the answer as text; for a refusal, state that no pose may be used."""
    text = str(result) if result.ok else f"{result}\nRefused: what is shown is the best hypothesis, to look at only."
    return f"{text}\n{TIMELINE} 1 is the best; blue points are inside the bone, red ones outside."


def _poses(result: RegistrationResult) -> list[tuple[Array, float]]:
    """Show the best pose and its rivals, each with its probability."""
    ranked = [(h.T_target_source, h.probability) for h in result.hypotheses[:MOST_HYPOTHESES]]
    return ranked or ([] if result.best is None else [(result.best, result.confidence)])


def _points(rr: Any, source: Array, result: RegistrationResult, number: int) -> Any:
    """Show the source, coloured by distance under the best pose; grey under its rivals."""
    if result.residuals is None:
        return rr.Points3D(source, colors=GREY, radii=POINT_MM)
    colours = colours_of(result.residuals.distance_mm) if number == 1 else GREY
    return rr.Points3D(result.residuals.points, colors=colours, radii=POINT_MM)


def _planned(rr: Any, errors: Sequence[TargetError]) -> Any:
    labels = [f"{error.label}: {error.expected_mm:.2f} mm (95 %: {error.bound95_mm:.2f} mm)" for error in errors]
    places = [error.position_mm for error in errors]
    return rr.Points3D(places, labels=labels, colors=TARGET_COLOUR, radii=TARGET_MM)
