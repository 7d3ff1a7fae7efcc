"""The pairs that the confidence and the precision learn from: subjects, views, and wrong bones.

Each pair is a pure function of the folder, the split, a seed and a number. Its bone is of a subject of the split, a
parametric one, or drawn from the shape models of the subjects of the split. Shares are stated below and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gapr_core.calibration.other_side import on_own_side
from gapr_core.calibration.shapes import SHAPES
from gapr_core.calibration.views import VIEWS
from gapr_core.config import SENSOR_KINDS
from gapr_core.data import anatomy, protocols, scans
from gapr_core.data import pool as bone_pool
from gapr_core.data.pair import TARGET_POINTS, Pair
from gapr_core.data.parametric import BONES as PARAMETRIC
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.training.dataset import People

Array = NDArray[np.float64]
T = TypeVar("T")
Bones = Mapping[str, Sequence[Specimen]]
_KEPT: dict[tuple[str, str], Bones] = {}
BONES = ("femur", "tibia", "pelvis", "thoracic")
LOOK_ALIKES = ("femur", "tibia")  # bones whose patches are much alike in different subjects
LOOK_ALIKE_SEEDS = 500  # added to the seed, so that no pair of the long list comes twice
MADE = ("drawn", "parametric")  # cohorts of artificial bones, easier to distinguish than subjects' bones
SYMMETRIC = ("pelvis",)  # a mirrored one is the other side of the same: judged against that side's pose
PARAMETRIC_PEOPLE = 9  # for each bone, besides the subjects of the folder
DRAWN_PEOPLE, DRAWN_SEED = {True: 40, False: 8}, 9  # new subjects of shape models, or parametric ones without a model
TWINS = ({"llp26_2008_0054", "llp26_2008_0032", "llp26_2008_0103"}, {"jhu_25", "jhu_15"})  # alike to 1 or 2 mm, not 7

SEEN_AS = {
    "clean": {"paper": 3.0, "incomplete": 1.5, "L1": 5.0},
    "L2": {"L2": 7.0, "L2-region": 1.5, "sweep": 3.0},
    "L3": {"L3": 7.0, "L3-region": 1.5, "patch": 3.0},
    "wave": {"L2-wave": 3.0, "L3-wave": 3.0},
    "waves": {"L2-waves": 2.0, "L3-waves": 2.0},
    "gp": {"L2-gp": 2.0, "L3-gp": 2.0},
    "mixed": {"mixed": 3.0, "crop": 2.0},
    "pointer": {"pointer": 6.0},
    "ultrasound": {"ultrasound": 6.0},
    "depth-camera": {"depth-camera": 6.0},
    "laser": {"laser": 4.0},
    "structured-light": {"structured-light": 3.0},
    "stereo": {"stereo": 4.0},
    "photogrammetry": {"photogrammetry": 4.0},
    "thinned": {"thinned": 4.0},
    "covered": {"covered": 4.0},
    "moving": {"moving": 4.0},
    "scene": {"scene-C1": 2.0, "scene-C2": 2.0, "scene-C3": 2.0},
}  # family: views of a bone, and their weights
SCENES = {
    "scene": SEEN_AS["scene"],
    "scene-stereo": {"scene-stereo": 1.0},
    "scene-layers": {"scene-layers": 1.0},
    "scene-joint": {"scene-joint": 1.0},
    "scene-bare": {"depth-camera": 2.0, "stereo": 1.0},
}  # the scenes of `SEEN_AS`, and families of separate lists
AT_A_JOINT, ELSEWHERE = "scene-joint", "scene-C2"  # view of a bone with its neighbour, and its substitute without one
HELD_OUT = ("laser", "structured-light")  # families that are judged, and in no fit
WHAT = {"own": 66.0, "person": 16.0, "bone": 5.0, "mirrored": 7.0, "scaled": 6.0}  # owner of the source's bone
SHAPE_SHARE = 0.02  # of all pairs
TARGETS = {"own": 60.0, "short": 25.0, "scanned": 15.0}  # kinds of targets: the whole bone, an end, another scan
DESCRIBED = 0.5  # share of the sensors' sources with a stated sensor
IN_A_ROW = 4  # pairs that share a target
OWN_TARGET = ("paper", "incomplete")  # views whose source is cut out of its own target
SHORTEST = (0.15, 0.6)  # share of the bone's length that a short scan holds
SCALES = (0.03, 0.07)  # relative error of a bone of a wrong scale: larger than ultrasound's


@dataclass(frozen=True)
class Task:
    """A pair to register: number `number` of the list of a folder, split and seed, or of one family's list.

    With `what` (a key of `WHAT`) the source is of that bone, whatever the shares. With `real` both bones are of
    subjects of the folder, where it has any.
    """

    folder: str
    split: str
    seed: int
    number: int
    family: str = ""
    what: str = ""
    real: bool = False


@dataclass(frozen=True, eq=False)
class Setting:
    """A target that some pairs in a row share, since preparing one costs more than registering to it.

    Attributes:
        specimen: the bone, or one end of it.
        whole: the bone.
        end: (share, upper) of the end in a short scan; None for the whole bone.
        cloud: (8192, 3) mm, centred; of another scan of the bone, if drawn.
        origin_mm: (3,) subtracted centre of the cloud.
    """

    specimen: Specimen
    whole: Specimen
    end: tuple[float, bool] | None
    cloud: Array
    origin_mm: Array


@dataclass(frozen=True, eq=False)
class Drawn:
    """A pair and its origin.

    Attributes:
        pair: source and target; the truth is all NaN where no pose is right.
        family: family of the sensor or level, for the tables of coverage.
        seen_as: protocol or view of the source.
        what: a key of `WHAT`, or "shape".
        people: all subjects whose bones the points are of, the target's first.
        sensor: stated kind of the sensor, or "unknown".
    """

    pair: Pair
    family: str
    seen_as: str
    what: str
    people: tuple[str, ...]
    sensor: str = "unknown"


def scenes(folder: str, split: str, seed: int, count: int) -> list[Task]:
    """List `count` scenes of each family; those at a joint are of subjects with more than one known bone."""
    families = [(family, family == AT_A_JOINT) for family in SCENES for _ in range(count)]
    return [Task(folder, split, seed, i % count, family, real=real) for i, (family, real) in enumerate(families)]


def look_alikes(folder: str, split: str, seed: int, count: int) -> list[Task]:
    """List 3 `count` sources of subjects, half of them against another subject's bone: femora, tibiae, rib cages.

    `count` are seen as at L3, where they are hardest to distinguish, and `count` by all other families in turn. Half of
    `count` are thinned, since another subject's ridges look like noise where neighbours are far apart. Three of ten are
    a camera's clouds, and two of ten rib cages at L3.
    """
    row, turn, whats = IN_A_ROW, IN_A_ROW * len(BONES), ("own", "person")
    bones = {number: BONES[number // row % len(BONES)] for number in range(turn * count)}
    numbers = [number for number, bone in bones.items() if bone in LOOK_ALIKES]
    of_ribs = [number for number, bone in bones.items() if bone == "thoracic"][: 2 * count // 10]
    others = [family for family in SEEN_AS if family not in ("L3", "scene", *HELD_OUT)]
    cameras = [family for family in SCENES if family != AT_A_JOINT]
    thinned, seen_by_a_camera = ["thinned"] * (count // 2), _in_turn(cameras, 3 * count // 10)
    own_list = seed + LOOK_ALIKE_SEEDS
    lists = [
        *zip(numbers[:count], ["L3"] * count, strict=True),
        *zip(numbers[:count], _in_turn(others, count), strict=True),
        *zip(numbers[count:], [*thinned, *seen_by_a_camera], strict=False),
        *zip(of_ribs, ["L3"] * len(of_ribs), strict=True),
    ]
    return [Task(folder, split, own_list, number, family, whats[number % 2], True) for number, family in lists]


def _in_turn(families: Sequence[str], count: int) -> list[str]:
    """Name `count` families, each twice in a row: for the own bone and for another subject's."""
    return [families[number // 2 % len(families)] for number in range(count)]


def draw(task: Task) -> Drawn:
    """Draw the pair of a task; the same task always gives the same pair."""
    rng = np.random.default_rng([task.seed, task.number, 62])
    if rng.random() < SHAPE_SHARE and not task.family:
        shape = sorted(SHAPES)[int(rng.integers(len(SHAPES)))]
        return Drawn(SHAPES[shape](int(rng.integers(2**31))), "shape", shape, "shape", ())
    setting = setting_of(task.folder, task.split, task.seed, task.number // IN_A_ROW, task.real)
    family, seen_as = _choose_view(rng, task.family)
    what, stranger = source_of(task, setting, rng)
    seed = int(rng.integers(2**31))
    around = [bone for group in bones_of(task.folder, task.split).values() for bone in group]
    try:
        pair = view(seen_as, stranger, seed, around)
    except ConfigError:  # no neighbour, or no wound shows enough of both
        if seen_as != AT_A_JOINT:
            raise
        pair = view(seen_as := ELSEWHERE, stranger, seed)
    if what != "own" or seen_as not in OWN_TARGET:
        pair = before(setting, stranger, what, pair)
    sensor = family.replace("-", "_") if rng.random() < DESCRIBED else "unknown"
    people = tuple(dict.fromkeys((setting.whole.person, stranger.person)))
    return Drawn(pair, family, seen_as, what, people, sensor if sensor in SENSOR_KINDS else "unknown")


@lru_cache(maxsize=2)
def setting_of(folder: str, split: str, seed: int, number: int, real: bool = False) -> Setting:
    """Draw target `number` of the list; bones come in turn, so that each has its share."""
    rng = np.random.default_rng([seed, number, 61])
    bones = bones_of(folder, split)[BONES[number % len(BONES)]]
    whole = _one_of(of_subjects(bones) if real else bones, rng)
    kind = _choose(TARGETS, rng)
    end = (rng.uniform(*SHORTEST), bool(rng.random() < 0.5)) if kind == "short" else None
    specimen = whole.end(*end) if end else whole
    scan = replace(specimen, surface=scans.drawn(rng)(specimen.surface)) if kind == "scanned" else specimen
    cloud, _ = scan.sample(TARGET_POINTS, rng)
    origin_mm = cloud.mean(axis=0)
    return Setting(specimen, whole, end, cloud - origin_mm, origin_mm)


def source_of(task: Task, setting: Setting, rng: np.random.Generator) -> tuple[str, Specimen]:
    """Draw (key of `WHAT`, bone of the source); only one end of it where the target is short."""
    what = task.what or _choose(WHAT, rng)
    if what == "mirrored" and (setting.whole.bone == "thoracic" or setting.whole.bone in SYMMETRIC and setting.end):
        what = "own"  # a rib cage's other side differs by 2 to 4 mm, and half of a pelvis has none: no pose is known
    bones = bones_of(task.folder, task.split).values()
    everybody = [each for group in bones for each in (of_subjects(group) if task.real else group)]
    others = without_twins(setting.whole, everybody)
    stranger = STRANGERS[what](setting.specimen, others, rng)
    return what, stranger.end(*setting.end) if setting.end and what in ("person", "bone") else stranger


def of_subjects(bones: Sequence[Specimen]) -> Sequence[Specimen]:
    """Select the bones of subjects; all where there are none."""
    return [each for each in bones if each.cohort not in MADE] or bones


def without_twins(specimen: Specimen, others: Sequence[Specimen]) -> list[Specimen]:
    """Remove subjects so nearly the same that their bone is no wrong answer."""
    own, person = first_of_twins(specimen.person), specimen.person
    return [other for other in others if other.person == person or first_of_twins(other.person) != own]


def first_of_twins(person: str) -> str:
    """Give subjects that are alike one name: no judged subject may be in the fit under another name."""
    return next((min(group) for group in TWINS if person in group), person)


def view(seen_as: str, specimen: Specimen, seed: int, around: Sequence[Specimen] = ()) -> Pair:
    """Pair a bone with its view by a protocol or one of `VIEWS`; at a joint with a neighbour."""
    if seen_as in VIEWS:
        return replace(VIEWS[seen_as](specimen, np.random.default_rng([seed, 11])), protocol=seen_as)
    return protocols.make_pair(seen_as, specimen, seed, around)


def before(setting: Setting, stranger: Specimen, what: str, pair: Pair) -> Pair:
    """Pair a source with the setting's target; of another subject's bone no pose is right."""
    truth = np.full((4, 4), np.nan)
    if what == "own" or (what == "mirrored" and setting.whole.bone in SYMMETRIC):
        truth = pair.T_target_source.copy()
        truth[:3, 3] += pair.metadata["origin_mm"]
        truth = truth if what == "own" else on_own_side(stranger, setting.whole) @ truth
        truth[:3, 3] -= setting.origin_mm
    metadata = pair.metadata | {"origin_mm": setting.origin_mm}
    return replace(pair, target=setting.cloud, T_target_source=truth, person=setting.whole.person,
                   bone=setting.whole.bone, metadata=metadata)  # fmt: skip


def _another_person(specimen: Specimen, others: Sequence[Specimen], rng: np.random.Generator) -> Specimen:
    return _one_of([o for o in others if o.bone == specimen.bone and o.person != specimen.person], rng)


def _another_bone(specimen: Specimen, others: Sequence[Specimen], rng: np.random.Generator) -> Specimen:
    return _one_of([o for o in others if o.bone != specimen.bone], rng)


def _scaled(specimen: Specimen, others: Sequence[Specimen], rng: np.random.Generator) -> Specimen:
    factor = 1.0 + rng.uniform(*SCALES) * rng.choice([-1.0, 1.0])
    return replace(specimen, surface=scans.of_size(factor)(specimen.surface))


def _one_of(specimens: Sequence[Specimen], rng: np.random.Generator) -> Specimen:
    return specimens[int(rng.integers(len(specimens)))]


def _choose_view(rng: np.random.Generator, only: str) -> tuple[str, str]:
    """Draw (family, view of the bone); of one family where that is named."""
    families = {only: (SEEN_AS | SCENES)[only]} if only else SEEN_AS
    shares = {(family, name): share for family, views in families.items() for name, share in views.items()}
    return _choose(shares, rng)


def _choose(shares: Mapping[T, float], rng: np.random.Generator) -> T:
    weights = np.array(list(shares.values()))
    return list(shares)[int(rng.choice(len(weights), p=weights / weights.sum()))]


def bones_of(folder: str, split: str) -> Bones:
    """Return every bone for the pairs: of the split's subjects, parametric, and new ones of shape models."""
    if (folder, split) not in _KEPT:
        _KEPT[folder, split] = {bone: _made(bone, folder, split) for bone in BONES}
    return _KEPT[folder, split]


def keep(folder: str, split: str, bones: Bones) -> None:
    """Use these bones from now on, as worker processes do: making the bones takes minutes."""
    _KEPT[folder, split] = bones


def _made(bone: str, folder: str, split: str) -> list[Specimen]:
    drawn = People(bone, Path(folder), split)
    new = [drawn.draw(number, 1.0, DRAWN_SEED) for number in range(DRAWN_PEOPLE[bool(drawn.real)])]
    parametric = bone_pool.specimens(bone, split, PARAMETRIC_PEOPLE) if bone in PARAMETRIC else []
    return anatomy.surfaces(folder, bone, split) + parametric + new


STRANGERS: dict[str, Callable[[Specimen, Sequence[Specimen], np.random.Generator], Specimen]] = {
    "own": lambda specimen, others, rng: specimen,
    "person": _another_person,
    "bone": _another_bone,
    "mirrored": lambda specimen, others, rng: anatomy.mirrored(specimen),
    "scaled": _scaled,
}
