"""The test protocols: each a pure seeded function from one bone surface to one pair with its true pose.

| protocol | view |
|---|---|
| paper, overlap-K, incomplete | section III and the experiments of the paper (arXiv 2606.13488) |
| L1, L2, L3 | one-sided, ever smaller and dirtier, as of a tracked probe |
| L2-region, L3-region; L2-wave and so on | half the size; another smooth bias |
| sweep | the band of a probe along the bone |
| pointer, ultrasound, depth-camera and so on | simulated sensors (see `sensors`) |
| pointer-50, ultrasound-4 | 50 dots, four slices |
| scene-C1 and so on | a bone in a wound before a camera (see `scenes`) |
| scene-C3-looks, scene-C3-look and so on | the same from four places; the first of these alone |
| wrong, scene-wrong and so on | no pose is right |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gapr_core.data import degradation, views
from gapr_core.data.pair import TARGET_POINTS, Pair, place
from gapr_core.data.scenes import derived
from gapr_core.data.scenes.joint import IN_THEATRE, joint_scene
from gapr_core.data.scenes.scene import SCENE_LEVELS, scene
from gapr_core.data.scenes.several_looks import ALONE, LOOKED_AT, several_looks
from gapr_core.data.scenes.table import table_scene
from gapr_core.data.sensors import SENSORS, SPARSE
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.geometry import extent, se3

Array = NDArray[np.float64]
Change = Callable[[Pair, np.random.Generator], Pair]
DEGRADED_AS = ("L1", "L2", "L3", "paper")  # of `wrong`, in turn, each with another bone type and another subject's
ANOTHER_PERSON = {level: 2 * number + 1 for number, level in enumerate(DEGRADED_AS)}  # turns with another subject's


@dataclass(frozen=True)
class Level:
    """Difficulty of a one-sided view.

    `share` is of the whole surface's area: of the visible points ("seen"), or of a band of them ("band"). With "region"
    it is of a region whose far side is then cut away, which leaves about half. `smooth_bias` is a name of
    `smooth_bias.SMOOTH_BIASES`, which defines `bias_mm`.
    """

    share: tuple[float, float]
    share_of: str
    noise_mm: float
    bias_mm: float
    outlier_share: float
    max_points: int
    smooth_bias: str = "waves-peak"


LEVELS = {
    "L1": Level((0.40, 0.70), "region", 1.0, 0.0, 0.0, 5000),
    "L2": Level((0.20, 0.35), "seen", 1.5, 1.0, 0.10, 2000),
    "L3": Level((0.10, 0.20), "seen", 1.5, 1.5, 0.20, 1000),
    "L2-region": Level((0.20, 0.35), "region", 1.5, 1.0, 0.10, 2000),
    "L3-region": Level((0.10, 0.20), "region", 1.5, 1.5, 0.20, 1000),
    "sweep": Level((0.05, 0.20), "band", 1.0, 1.0, 0.05, 2000),
}
for _name, _rms_mm in (("L2", 0.7), ("L3", 1.06)):  # a plane wave of the level's bias as amplitude; others of its rms
    LEVELS[f"{_name}-wave"] = replace(LEVELS[_name], smooth_bias="wave")
    LEVELS[f"{_name}-waves"] = replace(LEVELS[_name], bias_mm=_rms_mm, smooth_bias="waves-rms")
    LEVELS[f"{_name}-gp"] = replace(LEVELS[_name], bias_mm=_rms_mm, smooth_bias="gp-rms")


def make_pair(
    protocol: str, specimen: Specimen, seed: int, others: Sequence[Specimen] = (), turn: int | None = None
) -> Pair:
    """Make one pair of `protocol` from one specimen; the same arguments always give the same pair.

    Args:
        protocol: a name of `PROTOCOLS`.
        specimen: the bone of the target (and of the source, but for `wrong`).
        seed: any non-negative integer.
        others: bones that `wrong` draws its source from, and scenes at a joint their neighbour; not used by others.
        turn: which kind and degradation a `wrong` pair has (it goes through all eight); drawn from the seed if None.

    Raises:
        ConfigError: an unknown protocol, or one of `WITH_OTHERS` without a fitting other bone.
    """
    if protocol not in PROTOCOLS:
        raise ConfigError(f"a protocol of {', '.join(PROTOCOLS)}", repr(protocol), "choose one of these names")
    drawn_as = DERIVED[protocol][0] if protocol in DERIVED else protocol
    rng = np.random.default_rng([seed, crc32(drawn_as.encode()), crc32(f"{specimen.bone} {specimen.person}".encode())])
    make = PROTOCOLS[protocol]
    pair = make(specimen, rng, others, turn) if protocol in WITH_OTHERS else make(specimen, rng)
    name = f"{protocol}_{specimen.bone}_{specimen.person}_{seed}"
    metadata = {"cohort": specimen.cohort, "seed": seed, "family": protocol, **pair.metadata}
    return replace(pair, name=name, protocol=protocol, metadata=metadata)


def _derived(
    specimen: Specimen, rng: np.random.Generator, others: Sequence[Specimen] = (), turn: int | None = None,
    *, base: str, change: Change,
) -> Pair:  # fmt: skip
    make = PROTOCOLS[base]
    return change(make(specimen, rng, others, turn) if base in WITH_OTHERS else make(specimen, rng), rng)


def paper(specimen: Specimen, rng: np.random.Generator, share: tuple[float, float] = (0.40, 0.70)) -> Pair:
    """Section III: a KNN crop of the target's own points, density change, noise, U[0, 180] deg per axis."""
    target, _ = specimen.sample(TARGET_POINTS, rng)
    kept = rng.uniform(*share)
    source = target[views.nearest(target, target[_crop_centre(target, rng)], kept)]
    metadata = {"region_share": kept, "overlap": kept}
    return _finish_like_the_paper(specimen, source, target, metadata, rng)


def incomplete(specimen: Specimen, rng: np.random.Generator) -> Pair:
    """Table III of the paper: 50 % of the points around one point, 90 % around the point farthest from it."""
    cloud, _ = specimen.sample(TARGET_POINTS, rng)
    first = cloud[_crop_centre(cloud, rng)]
    second = cloud[((cloud - first) ** 2).sum(axis=1).argmax()]
    in_source, in_target = views.nearest(cloud, first, 0.5), views.nearest(cloud, second, 0.9)
    overlap = len(np.intersect1d(in_source, in_target)) / len(in_target)
    metadata = {"region_share": 0.5, "target_share": 0.9, "overlap": overlap}
    return _finish_like_the_paper(specimen, cloud[in_source], cloud[in_target], metadata, rng)


def one_sided(specimen: Specimen, rng: np.random.Generator, level: Level) -> Pair:
    """Draw a probe's view of a region: sampled from the surface, with noise, smooth bias and outliers."""
    target, _ = specimen.sample(TARGET_POINTS, rng)
    points, normals, metadata = views.best_view(specimen, level.share, level.share_of, rng)
    chosen = rng.permutation(len(points))[: level.max_points]
    points, normals = points[chosen], normals[chosen]
    dirty = degradation.measured(
        specimen, points, normals, level.noise_mm, level.bias_mm, level.outlier_share, rng, level.smooth_bias
    )
    metadata |= {"noise_mm": level.noise_mm, "bias_mm": level.bias_mm, "outlier_share": level.outlier_share}
    metadata["bias"] = level.smooth_bias
    rotation = se3.random_rotation(rng)
    return place(specimen, rng.permutation(dirty), target, rotation, metadata, rng)


def acquired(specimen: Specimen, rng: np.random.Generator, sensor: str) -> Pair:
    """Measure the bone with a simulated sensor of `data.sensors`; a camera's viewpoint is in the source's frame."""
    target, _ = specimen.sample(TARGET_POINTS, rng)
    found = (SENSORS | SPARSE)[sensor](specimen, rng)
    rotation = se3.random_rotation(rng)
    return place(specimen, rng.permutation(found.points), target, rotation, found.parameters, rng, found.viewpoint)


def wrong(specimen: Specimen, rng: np.random.Generator, others: Sequence[Specimen], turn: int | None = None) -> Pair:
    """Draw a source of another bone type or another subject in turn; each as L1, L2, L3 and paper."""
    turn = int(rng.integers(8)) if turn is None else turn
    source_of = _another(specimen, others, turn % 2, rng)
    degraded_as = DEGRADED_AS[turn // 2 % len(DEGRADED_AS)]
    other, own = (PROTOCOLS[degraded_as](who, rng) for who in (source_of, specimen))
    metadata = _facts_of_wrong(specimen, source_of, other, degraded_as, own.metadata["origin_mm"]) | {"overlap": 0.0}
    return replace(own, source=other.source, T_target_source=np.full((4, 4), np.nan), metadata=metadata)


def wrong_scene(
    specimen: Specimen,
    rng: np.random.Generator,
    others: Sequence[Specimen],
    turn: int | None = None,
    levels: Sequence[str] = ("scene-C1", "scene-C2", "scene-C3"),
) -> Pair:
    """Draw a scene of another bone type or another subject in turn; each of the levels."""
    turn = int(rng.integers(2 * len(levels))) if turn is None else turn
    source_of = _another(specimen, others, turn % 2, rng)
    level = levels[turn // 2 % len(levels)]
    pair = PROTOCOLS[level](source_of, rng)
    target, _ = specimen.sample(TARGET_POINTS, rng)
    origin_mm = target.mean(axis=0)
    metadata = _facts_of_wrong(specimen, source_of, pair, level, origin_mm)
    own = {"target": target - origin_mm, "bone": specimen.bone, "person": specimen.person}
    return replace(pair, **own, T_target_source=np.full((4, 4), np.nan), metadata=metadata)


def _facts_of_wrong(
    specimen: Specimen, source_of: Specimen, pair: Pair, degraded_as: str, origin_mm: Array
) -> dict[str, Any]:
    """Collect the metadata of a pair with the target of one bone and the source of another."""
    return {
        **pair.metadata,
        "origin_mm": origin_mm,
        "wrong_kind": "other_person" if source_of.bone == specimen.bone else "other_bone",
        "degraded_as": degraded_as,
        "source_bone": source_of.bone,
        "source_person": source_of.person,
    }


def _another(specimen: Specimen, others: Sequence[Specimen], kind: int, rng: np.random.Generator) -> Specimen:
    """Another bone type (kind 0) or another subject's (kind 1); the other kind where there is none."""
    other_bone = [o for o in others if o.bone != specimen.bone]
    other_person = [o for o in others if o.bone == specimen.bone and o.person != specimen.person]
    candidates = (other_bone or other_person, other_person or other_bone)[kind]
    if not candidates:
        raise ConfigError(
            f"another bone or another subject than {specimen.bone} of {specimen.person}",
            f"{len(others)} other specimens, none fitting",
            "name more bones or more subjects",
        )
    return candidates[rng.integers(len(candidates))]


def _finish_like_the_paper(
    specimen: Specimen, source: Array, target: Array, metadata: dict[str, Any], rng: np.random.Generator
) -> Pair:
    scale = degradation.half_edge_mm(source)
    source = degradation.vary_density(source, scale, rng)
    noise_mm = 0.01 * scale  # sigma 0.01 on the cloud scaled to [-1, 1]
    source = source + rng.normal(0.0, noise_mm, source.shape)
    metadata |= {"noise_mm": noise_mm, "bias_mm": 0.0, "outlier_share": 0.0}
    rotation = Rotation.from_euler("xyz", rng.uniform(0.0, 180.0, 3), degrees=True).as_matrix()
    return place(specimen, rng.permutation(source), target, rotation, metadata, rng)


def _crop_centre(cloud: Array, rng: np.random.Generator) -> int:
    """Choose a random point; of a long bone (twice as long as wide) one at either end."""
    centred = cloud - cloud.mean(axis=0)
    axes, variances = extent.principal(cloud)
    if variances[0] < 4.0 * variances[1]:
        return int(rng.integers(len(cloud)))
    along = centred @ axes[0]
    low, high = along.min(), along.max()
    margin = 0.05 * (high - low)
    end = along < low + margin if rng.random() < 0.5 else along > high - margin
    return int(rng.choice(np.flatnonzero(end)))


NO_RIGHT_POSE: dict[str, Callable[..., Pair]] = {  # no pose is right
    "wrong": wrong,
    "scene-wrong": wrong_scene,
    "scene-wrong-stereo": partial(wrong_scene, levels=("scene-stereo", "scene-layers")),
    "scene-wrong-looks": partial(wrong_scene, levels=[f"{name}-looks" for name in ALONE]),
}
DERIVED: dict[str, tuple[str, Change]] = {  # of the base's pair of the same seed
    **{f"scene-{level}-bone": (f"scene-{level}", derived.bone_alone) for level in ("C1", "C2", "C3")},
    **{
        f"{level}-far{percent}": (level, partial(derived.far_clutter, share=percent / 100.0))
        for level in ("L1", "L2")
        for percent in (10, 30)
    },
    "scene-ultrasound": ("ultrasound", derived.echoes),
    **{f"{name}-look": (f"{name}-looks", derived.first_look) for name in LOOKED_AT},
}
WITH_OTHERS: dict[str, Callable[..., Pair]] = {  # made with other bones
    **NO_RIGHT_POSE,
    "scene-joint": joint_scene,
    "scene-theatre": partial(joint_scene, level=IN_THEATRE),
    **{f"{name}-looks": partial(several_looks, kind=kind) for name, kind in LOOKED_AT.items()},
    **{f"{name}-look": partial(_derived, base=f"{name}-looks", change=derived.first_look) for name in LOOKED_AT},
}
PROTOCOLS: dict[str, Callable[..., Pair]] = {
    "paper": paper,
    **{f"overlap-{k}": partial(paper, share=(k / 100.0, k / 100.0)) for k in (40, 50, 60, 70)},
    "incomplete": incomplete,
    **{name: partial(one_sided, level=level) for name, level in LEVELS.items()},
    **{name.replace("_", "-"): partial(acquired, sensor=name) for name in SENSORS | SPARSE},
    **{name: partial(scene, level=level) for name, level in SCENE_LEVELS.items()},
    "scene-table": table_scene,
    **{name: partial(_derived, base=base, change=change) for name, (base, change) in DERIVED.items()},
    **WITH_OTHERS,
}
