"""Which segment is meant: names out of headers, numbers with their meaning."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from gapr_core.errors import InvalidPointCloudError

MOST_LISTED = 12
SIDES = ("left", "right")
SPINE = [f"vertebrae_{name}" for name in (*(f"L{n}" for n in range(5, 0, -1)), *(f"T{n}" for n in range(12, 0, -1)),
                                          *(f"C{n}" for n in range(7, 0, -1)))]  # fmt: skip
LIMBS = [f"{bone}_{side}" for bone in ("humerus", "scapula", "clavicula", "femur", "hip") for side in SIDES]
RIBS = [f"rib_{side}_{n}" for side in SIDES for n in range(1, 13)]
TOTALSEGMENTATOR = {  # its bones: totalsegmentator/map_to_binary.py
    "TotalSegmentator v1": {
        **dict(enumerate(SPINE, 18)), **dict(enumerate(RIBS, 58)), **dict(enumerate(LIMBS, 82)), 92: "sacrum"
    },
    "TotalSegmentator v2 total": {
        25: "sacrum", 26: "vertebrae_S1", **dict(enumerate(SPINE, 27)), **dict(enumerate(LIMBS, 69)), 91: "skull",
        **dict(enumerate(RIBS, 92)), 116: "sternum", 117: "costal_cartilages"
    },
    "TotalSegmentator v2 total_mr": {18: "sacrum", 19: "vertebrae", **dict(enumerate(LIMBS, 30))},
    "TotalSegmentator v2 appendicular_bones": dict(
        enumerate(("patella", "tibia", "fibula", "tarsal", "metatarsal", "phalanges_feet", "ulna", "radius"), 1)
    ),
}  # fmt: skip

Present = Mapping[int, set[int]]  # of each layer, the numbers that some voxel has


@dataclass(frozen=True)
class Segment:
    """One segment: its name (empty where the file has none), the number of its voxels, and its layer."""

    name: str
    value: int
    layer: int = 0


def of_seg_nrrd(metadata: Mapping[str, str], layers: int = 1) -> list[Segment]:
    """Segments of 3D Slicer's .seg.nrrd: keys Segment0_Name, Segment0_LabelValue, Segment0_Layer.

    Older files have neither value nor layer: segment N of several layers is number 1 of layer N, as 3D Slicer reads it.
    """
    segments = []
    for key, name in metadata.items():
        if found := re.fullmatch(r"Segment(\d+)_Name", key):
            segment = f"Segment{found[1]}"
            layer = int(metadata.get(f"{segment}_Layer", found[1] if layers > 1 else 0))
            segments.append(Segment(name.strip(), int(metadata.get(f"{segment}_LabelValue", 1)), layer))
    return segments


def choose(wanted: Iterable[str], named: list[Segment], present: Present) -> tuple[list[Segment], list[str]]:
    """Choose segments by name or number, with notes on how numbers were read.

    Args:
        wanted: names or numbers; none for the only segment of a file.
        named: what the file's header lists.
        present: of each layer, the numbers that some voxel has.

    Raises:
        InvalidPointCloudError: a name or number that is not there, or a choice that was not made.
    """
    wanted = tuple(wanted)
    if not wanted:
        return [_only(named, present)], []
    chosen, notes = [], []
    for label in wanted:
        segment = _by_digits(label, named, present) if label.isdecimal() else _by_name(label, named, present)
        if segment.value not in present.get(segment.layer, ()):
            there = _present(named, present)
            how = "choose one of these" if there else "check the segmentation"
            raise InvalidPointCloudError(f"voxels of {label}", f"none, but {there or 'zeros only'}", how)
        chosen.append(segment)
        if label.isdecimal() and _key(segment.name) != _key(label):
            notes.append(f"label {label} {_meaning(segment, present)}")
    return chosen, notes


def _only(named: list[Segment], present: Present) -> Segment:
    segments = _segments(named, present)
    if len(segments) == 1:
        return segments[0]
    if not segments:
        raise InvalidPointCloudError("a label map with a segment", "zeros only", "check the segmentation")
    given = f"{len(segments)} of them ({_present(named, present)})"
    how = "name one: --label (--source-label of the source), ReadOptions(labels=...) of load, model_label of the node"
    raise InvalidPointCloudError("one label", given, how)


def _segments(named: list[Segment], present: Present) -> list[Segment]:
    return [_by_number(value, named, {layer: {value}}) for layer in present for value in sorted(present[layer])]


def _present(named: list[Segment], present: Present) -> str:
    """List the segments with voxels, by name if they have one."""
    return _listed([s.name or str(s.value) for s in _segments(named, present)])


def _by_number(value: int, named: list[Segment], present: Present) -> Segment:
    layers = [layer for layer in present if value in present[layer]]
    if len(layers) > 1:
        raise InvalidPointCloudError("one segment", f"{value} in {len(layers)} layers", "choose it by its name")
    layer = layers[0] if layers else 0
    return next((s for s in named if (s.value, s.layer) == (value, layer)), Segment("", value, layer))


def _by_digits(label: str, named: list[Segment], present: Present) -> Segment:
    """Find the segment of a number, or the one with these digits for a name.

    Raises:
        InvalidPointCloudError: these are two.
    """
    of_name = [segment for segment in named if _key(segment.name) == _key(label)]
    if not of_name:
        return _by_number(int(label), named, present)
    others = [s for s in _segments(named, present) if s.value == int(label) and s not in of_name]
    if others:
        other = f'the segment "{others[0].name}"' if others[0].name else "one without a name"
        given = f"the name of the segment of number {of_name[0].value}, and the number of {other}"
        raise InvalidPointCloudError(f"one segment {label}", given, "rename the first in 3D Slicer")
    return _by_name(label, named, present)


def _by_name(label: str, named: list[Segment], present: Present) -> Segment:
    found = [segment for segment in named if _key(segment.name) == _key(label)]
    if len(found) == 1:
        _check_alone(found[0], named)
        return found[0]
    if found:
        given = f"{len(found)} of the name {label}"
        raise InvalidPointCloudError("one segment", given, "rename one, or give its number")
    if named:
        raise InvalidPointCloudError(f"a segment {label}", _listed(_nearest(label, named)), "choose one of these")
    raise _nameless(label, present)


def _check_alone(segment: Segment, named: list[Segment]) -> None:
    """Raise where the header gives the same voxels several names: which of them they are is a guess."""
    names = [other.name for other in named if (other.value, other.layer) == (segment.value, segment.layer)]
    if len(names) > 1:
        given = f"{_listed(names)}, all of number {segment.value}"
        raise InvalidPointCloudError("a number for each segment", given, "save it again from 3D Slicer")


def _nearest(label: str, named: list[Segment]) -> list[str]:
    """Names like the one that is not there, or all."""
    names = {_key(segment.name): segment.name for segment in named}
    return [names[key] for key in difflib.get_close_matches(_key(label), names, n=3) or names]


def _nameless(label: str, present: Present) -> InvalidPointCloudError:
    """Build the error for a name without names in the file, with TotalSegmentator's numbers."""
    entries = [(version, item) for version, table in TOTALSEGMENTATOR.items() for item in table.items()]
    numbers = [f"{value} in {version}" for version, (value, name) in entries if _key(name) == _key(label)]
    known = f" ({', '.join(numbers)}; TotalSegmentator writes names with --ml)" if numbers else ""
    values = _listed([str(value) for layer in present.values() for value in sorted(layer)])
    given = f"a file without names, with {values}"
    return InvalidPointCloudError(f"a segment {label}", given, f"give its number{known}")


def _meaning(segment: Segment, present: Present) -> str:
    if segment.name:
        return f"is {segment.name}, says the file"
    numbers = set().union(*present.values())
    if len(numbers) == 1 or numbers == {1, 2}:  # any mask, and not TotalSegmentator's
        return "has no name in the file"
    tables = [(version, table) for version, table in TOTALSEGMENTATOR.items() if segment.value in table]
    names = [f"{table[segment.value]} in {version}" for version, table in tables]
    return "has no name in the file" + (f"; it would be {', '.join(names)}" if names else "")


def _key(name: str) -> str:
    return re.sub(r"[\s_-]+", "_", name.strip().lower())


def _listed(names: list[str]) -> str:
    names = [f'"{name}"' if "," in name else name for name in names]
    return ", ".join(names[:MOST_LISTED]) + (" ..." if len(names) > MOST_LISTED else "")
