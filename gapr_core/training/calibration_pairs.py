"""The pairs that the confidence models learn from: every protocol, and what no protocol has.

People of the split, parametric ones and ones drawn from the shape models of the people of the split; whole bones, and
with a prefix scans of one end of them ("short-") or models as another scanner would give them ("scanned-").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapr_core.clouds import Surface
from gapr_core.data import anatomy, protocols, scans
from gapr_core.data import pool as bone_pool
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3
from gapr_core.training.dataset import People

Array = NDArray[np.float64]
BONES = ("femur", "tibia", "pelvis", "thoracic")
PARAMETRIC_PEOPLE = 9  # for each bone, beside the people of the folder
BOX_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip
DRAWN_PEOPLE, DRAWN_SEED = 40, 9  # and new ones from their shape models
OF_THE_LISTS = (
    "paper", "incomplete", "L1", "L2", "L3", "L2-region", "L3-region", "sweep", "mixed",
    "wrong", "wrong_person", "wrong_sweep", "turned", "box", "patch", "wrong_patch",
)  # fmt: skip
SHORT = "short-"  # before a protocol: the scan holds one end of the bone only
SCANNED = "scanned-"  # before a protocol: the target's points are of the bone as another scanner gives it
PROTOCOLS = (
    *OF_THE_LISTS,
    *(SHORT + name for name in ("paper", "L1", "L2", "L3", "sweep", "mixed", "wrong", "wrong_person", "wrong_sweep")),
    *(SCANNED + name for name in ("paper", "L1", "L2", "L3", "sweep", "wrong_person")),
)
TWINS = ({"llp26_2008_0054", "llp26_2008_0032", "llp26_2008_0103"}, {"jhu_25", "jhu_15"})  # alike to 1 or 2 mm, not 7
Task = tuple[str, str, str, str, int]  # folder, split, protocol, bone, seed


def pair_of(task: Task) -> protocols.Pair:
    """The pair of a task; the same task always gives the same pair."""
    folder, split, protocol, bone, seed = task
    if protocol in NO_BONES:
        return NO_BONES[protocol](len(BONES) * seed + BONES.index(bone))
    bones = _bones(folder, split)
    specimen = bones[bone][seed % len(bones[bone])]
    others = without_twins(specimen, [s for group in bones.values() for s in group])
    if protocol.startswith(SHORT):
        return _pair(protocol.removeprefix(SHORT), *shortened(specimen, others, seed), seed=seed)
    if protocol.startswith(SCANNED):
        return scanned(_pair(protocol.removeprefix(SCANNED), specimen, *others, seed=seed), specimen, seed)
    return _pair(protocol, specimen, *others, seed=seed)


def _pair(protocol: str, specimen: Specimen, *others: Specimen, seed: int) -> protocols.Pair:
    match protocol:
        case "mixed":
            return mixed_pair(specimen, seed)
        case "wrong_person":
            return wrong_person_pair(specimen, others, seed)
        case "wrong_sweep":
            return wrong_sweep_pair(specimen, others, seed)
        case "patch":
            return patch_pair(specimen, (), seed)
        case "wrong_patch":
            return patch_pair(specimen, others, seed)
        case _:
            return protocols.make_pair(protocol, specimen, seed, others)


@cache
def _bones(folder: str, split: str) -> dict[str, list[Specimen]]:
    def of(bone: str) -> list[Specimen]:
        drawn = People(bone, Path(folder), split)
        new = [drawn.draw(number, 1.0, DRAWN_SEED) for number in range(DRAWN_PEOPLE)]
        return anatomy.surfaces(folder, bone, split) + bone_pool.specimens(bone, split, PARAMETRIC_PEOPLE) + new

    return {bone: of(bone) for bone in BONES}


def without_twins(specimen: Specimen, others: Sequence[Specimen]) -> list[Specimen]:
    """The others less those who are so nearly the same person that their bone is no wrong answer."""
    alike = {person for group in TWINS if specimen.person in group for person in group} - {specimen.person}
    return [other for other in others if other.person not in alike]


def scanned(pair: protocols.Pair, specimen: Specimen, seed: int) -> protocols.Pair:
    """The same pair with the target's points drawn from a scan of the bone, which its source knows nothing of."""
    rng = np.random.default_rng([seed, 41])
    scan = replace(specimen, surface=scans.drawn(rng)(specimen.surface))
    cloud, _ = scan.sample(protocols.TARGET_POINTS, rng)
    return replace(pair, target=cloud - pair.metadata["origin_mm"])


def shortened(specimen: Specimen, others: Sequence[Specimen], seed: int) -> list[Specimen]:
    """What scans of one end of the bone hold, 15 to 60 % of it; of two other people and two other bones, too."""
    rng = np.random.default_rng([seed, 29])
    share, upper = rng.uniform(0.15, 0.6), bool(rng.random() < 0.5)
    same, other = ([o for o in others if (o.bone == specimen.bone) == is_same] for is_same in (True, False))
    strangers = [o for o in same if o.person != specimen.person]
    some = [group[i] for group in (strangers, other) for i in rng.permutation(len(group))[:2]]
    return [each.end(share, upper) for each in (specimen, *some)]


def turned_pair(seed: int) -> protocols.Pair:
    """A solid of revolution, seen from one side: the spin about its axis cannot be known, so no pose is right."""
    rng = np.random.default_rng([seed, 7])
    length, radius, waist = rng.uniform(40.0, 300.0), rng.uniform(8.0, 35.0), rng.uniform(0.0, 0.4)
    phase = rng.uniform(0.0, 2.0 * np.pi)

    def draw(count: int) -> Array:
        z, angle = rng.uniform(-0.5, 0.5, count), rng.uniform(0.0, 2.0 * np.pi, count)
        r = radius * np.sqrt(1.0 - (1.98 * z) ** 2) * (1.0 - waist * np.cos(7.0 * z + phase))
        return np.stack([r * np.cos(angle), r * np.sin(angle), length * z], axis=1)

    seen = draw(6000)
    seen = seen[(seen[:, 0] > 0.0) & (np.abs(seen[:, 2]) < rng.uniform(0.2, 0.5) * length)]
    source = seen + rng.normal(0.0, rng.uniform(0.1, 1.5), seen.shape)
    nowhere = np.full((4, 4), np.nan)
    return protocols.Pair(
        source[: rng.integers(500, 3000)], draw(8192), nowhere, f"turned-{seed}", "none", "none", "turned"
    )


def box_pair(seed: int) -> protocols.Pair:
    """A side or a corner of a box, smooth or of voxels: flat, straight, and alike in four poses: none is right."""
    rng = np.random.default_rng([seed, 43])
    sides_mm, turn = np.exp(rng.uniform(np.log(20.0), np.log(250.0), 3)), se3.random_rotation(rng)
    corners = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * sides_mm @ turn.T
    box = Specimen(Surface(corners, BOX_FACES), "box", "none")
    if rng.random() < 0.5:
        box = replace(box, surface=scans.drawn(rng)(box.surface))
    noise_mm, bias_mm, outliers = rng.uniform(0.05, 1.0), rng.uniform(0.0, 1.0) * (rng.random() < 0.5), 0.0
    share, points = (float(np.exp(rng.uniform(*np.log(limits)))) for limits in ((0.02, 0.4), (300.0, 4000.0)))
    level = protocols.Level((share, share), "seen", noise_mm, bias_mm, outliers, int(points))
    pair = protocols.one_sided(box, rng, level)
    return replace(pair, T_target_source=np.full((4, 4), np.nan), name=f"box-{seed}", protocol="box", bone="none")


def wrong_person_pair(specimen: Specimen, others: Sequence[Specimen], seed: int) -> protocols.Pair:
    """The same bone of somebody else, seen as at L2 or L3: the hardest to refuse. No pose is right."""
    strangers = [o for o in others if o.bone == specimen.bone]
    seen_as = ("L2", "L3")[int(np.random.default_rng([seed, 37]).integers(2))]
    pair = protocols.make_pair("wrong", specimen, seed, strangers, protocols.ANOTHER_PERSON[seen_as])
    return replace(pair, name=f"wrong_person-{seed}", protocol="wrong_person")


def wrong_sweep_pair(specimen: Specimen, others: Sequence[Specimen], seed: int) -> protocols.Pair:
    """A probe's sweep along another bone, or along the same bone of somebody else; no pose is right."""
    rng = np.random.default_rng([seed, 13])
    same_bone = rng.random() < 0.5
    same, other = ([o for o in others if (o.bone == specimen.bone) == is_same] for is_same in (True, False))
    strangers = [o for o in same if o.person != specimen.person] if same_bone else other
    stranger = strangers[int(rng.integers(len(strangers)))]
    pair = protocols.make_pair("sweep", specimen, seed)
    swept = protocols.make_pair("sweep", stranger, seed).source
    nowhere = np.full((4, 4), np.nan)
    return replace(pair, source=swept, T_target_source=nowhere, name=f"wrong_sweep-{seed}", protocol="wrong_sweep")


def patch_pair(specimen: Specimen, others: Sequence[Specimen], seed: int) -> protocols.Pair:
    """A one-sided view of 1 to 12 % of the bone, of few points; with `others`, of one of them: no pose is right then.

    Two of three strangers are the same bone of somebody else: on so small a patch it fits nearly as well.
    """
    rng = np.random.default_rng([seed, 31])
    share, points = (float(np.exp(rng.uniform(*np.log(limits)))) for limits in ((0.01, 0.12), (60.0, 1500.0)))
    noise_mm, bias_mm, outliers = rng.uniform(0.2, 1.5), rng.uniform(0.0, 1.5), rng.uniform(0.0, 0.2)
    level = protocols.Level((share, share), "seen", noise_mm, bias_mm, outliers, int(points))
    pair = replace(protocols.one_sided(specimen, rng, level), name=f"patch-{seed}", protocol="patch")
    if not others:
        return pair
    is_same = rng.random() < 0.67
    strangers = [o for o in others if (o.bone == specimen.bone) == is_same and o.person != specimen.person]
    seen = protocols.one_sided(strangers[int(rng.integers(len(strangers)))], rng, level).source
    return replace(pair, source=seen, T_target_source=np.full((4, 4), np.nan), protocol="wrong_patch")


def mixed_pair(specimen: Specimen, seed: int) -> protocols.Pair:
    """Between and beyond the protocols: from clean points of the target itself to tiny, noisy, biased, dirty views."""
    rng = np.random.default_rng([seed, 11])
    share = rng.uniform(0.1, 0.9)
    if rng.random() < 0.25:
        target, _ = specimen.sample(protocols.TARGET_POINTS, rng)
        distance = ((target - target[rng.integers(len(target))]) ** 2).sum(axis=1)
        source = target[distance <= np.quantile(distance, share)]
        source = source[rng.permutation(len(source))[: rng.integers(300, 6000)]]
        return protocols.Pair(source, target, np.eye(4), f"mixed-{seed}", specimen.bone, specimen.person, "mixed")
    noise_mm, bias_mm, outliers = (rng.uniform(0.0, most) * (rng.random() < 0.7) for most in (2.0, 1.5, 0.25))
    share_of = str(rng.choice(["seen", "region"]))
    points = int(np.exp(rng.uniform(np.log(300), np.log(6000))))
    level = protocols.Level((share, share), share_of, noise_mm, bias_mm, outliers, points)
    pair = protocols.one_sided(specimen, rng, level)
    return replace(pair, name=f"mixed-{seed}", protocol="mixed")


NO_BONES = {"turned": turned_pair, "box": box_pair}  # shapes of which no pose can be known
