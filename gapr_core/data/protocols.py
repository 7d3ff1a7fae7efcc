"""The test protocols: each a pure seeded function from one bone surface to one pair with its true pose.

paper, overlap-40/50/60/70 and incomplete follow section III and the experiments of the paper (arXiv 2606.13488);
L1, L2 and L3 are one-sided, small, biased and dirty views as a tracked probe gives them, and L2-region and L3-region
the same of about half the size; sweep is the band that a probe covers on its way; wrong pairs have no pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gapr_core.data import degradation
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.geometry import se3

Array = NDArray[np.float64]
TARGET_POINTS = 8192
ANOTHER_PERSON = {
    "L1": 1,
    "L2": 3,
    "L3": 5,
    "paper": 7,
}  # of the turns of `wrong`: somebody else's, as which level
TRANSLATION_MM = 150.0


@dataclass(frozen=True)
class Pair:
    """A source and a target cloud, and the motion that takes one to the other.

    Attributes:
        source: (N, 3) mm, in its own frame.
        target: (M, 3) mm, centred on its mean: surface coordinates minus metadata["origin_mm"].
        T_target_source: (4, 4) truth; all NaN where no pose is right (protocol `wrong`).
        metadata: how the pair was made: region share, overlap, noise_mm, bias_mm, outlier_share, ...
    """

    source: Array
    target: Array
    T_target_source: Array
    name: str
    bone: str
    person: str
    protocol: str
    metadata: dict[str, Any] = field(default_factory=dict)

    @property
    def has_truth(self) -> bool:
        """False where the right answer is a refusal."""
        return bool(np.isfinite(self.T_target_source).all())


@dataclass(frozen=True)
class Level:
    """How hard a one-sided view is.

    `share` is of the whole surface's area: of what the probe sees (`seen`), of a band of that along its longest
    direction ("band"), or of a region around the point that it looks at, whose far side is then cut away ("region"),
    which leaves about half.
    """

    share: tuple[float, float]
    share_of: str
    noise_mm: float
    bias_mm: float
    outlier_share: float
    max_points: int


LEVELS = {
    "L1": Level((0.40, 0.70), "region", 1.0, 0.0, 0.0, 5000),
    "L2": Level((0.20, 0.35), "seen", 1.5, 1.0, 0.10, 2000),
    "L3": Level((0.10, 0.20), "seen", 1.5, 1.5, 0.20, 1000),
    "L2-region": Level((0.20, 0.35), "region", 1.5, 1.0, 0.10, 2000),
    "L3-region": Level((0.10, 0.20), "region", 1.5, 1.5, 0.20, 1000),
    "sweep": Level((0.05, 0.20), "band", 1.0, 1.0, 0.05, 2000),
}


def make_pair(
    protocol: str, specimen: Specimen, seed: int, others: Sequence[Specimen] = (), turn: int | None = None
) -> Pair:
    """One pair of `protocol` from one specimen; the same arguments always give the same pair.

    Args:
        protocol: a name of `PROTOCOLS`.
        specimen: the bone of the target (and of the source, but for `wrong`).
        seed: any non-negative integer.
        others: bones that `wrong` draws its source from; other protocols ignore it.
        turn: which kind and degradation a `wrong` pair has (it goes through all eight); drawn from the seed if None.

    Raises:
        ConfigError: an unknown protocol, or `wrong` without a fitting other bone.
    """
    if protocol not in PROTOCOLS:
        raise ConfigError(f"a protocol of {', '.join(PROTOCOLS)}", repr(protocol), "choose one of these names")
    rng = np.random.default_rng([seed, crc32(protocol.encode()), crc32(f"{specimen.bone} {specimen.person}".encode())])
    pair = wrong(specimen, rng, others, turn) if protocol == "wrong" else PROTOCOLS[protocol](specimen, rng)
    name = f"{protocol}_{specimen.bone}_{specimen.person}_{seed}"
    metadata = {"cohort": specimen.cohort, "seed": seed, **pair.metadata}
    return replace(pair, name=name, protocol=protocol, metadata=metadata)


def paper(specimen: Specimen, rng: np.random.Generator, share: tuple[float, float] = (0.40, 0.70)) -> Pair:
    """Section III: a KNN crop of the target's own points, density change, noise, U[0, 180] deg per axis."""
    target, _ = specimen.sample(TARGET_POINTS, rng)
    kept = rng.uniform(*share)
    source = target[_nearest(target, target[_crop_centre(target, rng)], kept)]
    metadata = {"region_share": kept, "overlap": kept}
    return _finish_like_the_paper(specimen, source, target, metadata, rng)


def incomplete(specimen: Specimen, rng: np.random.Generator) -> Pair:
    """Table III of the paper: 50 % of the points around one point, 90 % around the point farthest from it."""
    cloud, _ = specimen.sample(TARGET_POINTS, rng)
    first = cloud[_crop_centre(cloud, rng)]
    second = cloud[((cloud - first) ** 2).sum(axis=1).argmax()]
    in_source, in_target = _nearest(cloud, first, 0.5), _nearest(cloud, second, 0.9)
    overlap = len(np.intersect1d(in_source, in_target)) / len(in_target)
    metadata = {"region_share": 0.5, "target_share": 0.9, "overlap": overlap}
    return _finish_like_the_paper(specimen, cloud[in_source], cloud[in_target], metadata, rng)


def one_sided(specimen: Specimen, rng: np.random.Generator, level: Level) -> Pair:
    """What a probe sees of a region: drawn anew from the surface, with noise, smooth bias and outliers."""
    target, _ = specimen.sample(TARGET_POINTS, rng)
    points, normals, metadata = _best_view(specimen, level, rng)
    chosen = rng.permutation(len(points))[: level.max_points]
    points, normals = points[chosen], normals[chosen]
    dirty = degradation.measured(specimen, points, normals, level.noise_mm, level.bias_mm, level.outlier_share, rng)
    metadata |= {"noise_mm": level.noise_mm, "bias_mm": level.bias_mm, "outlier_share": level.outlier_share}
    rotation = Rotation.random(random_state=rng).as_matrix()  # uniform on SO(3)
    return _place(specimen, rng.permutation(dirty), target, rotation, metadata, rng)


def wrong(specimen: Specimen, rng: np.random.Generator, others: Sequence[Specimen], turn: int | None = None) -> Pair:
    """A source that is not of this bone: in turn another bone type, another person's; each as L1, L2, L3 and paper."""
    turn = int(rng.integers(8)) if turn is None else turn
    source_of = _another(specimen, others, turn % 2, rng)
    kind = "other_person" if source_of.bone == specimen.bone else "other_bone"
    degraded_as = ("L1", "L2", "L3", "paper")[turn // 2 % 4]
    stranger, own = (PROTOCOLS[degraded_as](who, rng) for who in (source_of, specimen))
    metadata = {
        **stranger.metadata,
        "origin_mm": own.metadata["origin_mm"],
        "overlap": 0.0,
        "wrong_kind": kind,
        "degraded_as": degraded_as,
        "source_bone": source_of.bone,
        "source_person": source_of.person,
    }
    return replace(own, source=stranger.source, T_target_source=np.full((4, 4), np.nan), metadata=metadata)


def _another(specimen: Specimen, others: Sequence[Specimen], kind: int, rng: np.random.Generator) -> Specimen:
    """Another bone type (kind 0) or another person's (kind 1); the other of the two where there is none of the kind."""
    other_bone = [o for o in others if o.bone != specimen.bone]
    other_person = [o for o in others if o.bone == specimen.bone and o.person != specimen.person]
    candidates = (other_bone or other_person, other_person or other_bone)[kind]
    if not candidates:
        raise ConfigError(
            f"another bone or another person beside {specimen.bone} of {specimen.person}",
            f"{len(others)} other specimens, none fitting",
            "name more bones or more people",
        )
    return candidates[rng.integers(len(candidates))]


def _finish_like_the_paper(
    specimen: Specimen, source: Array, target: Array, metadata: dict[str, Any], rng: np.random.Generator
) -> Pair:
    scale = degradation.half_extent(source)
    source = degradation.vary_density(source, scale, rng)
    noise_mm = 0.01 * scale  # sigma 0.01 on the cloud scaled to [-1, 1]
    source = source + rng.normal(0.0, noise_mm, source.shape)
    metadata |= {"noise_mm": noise_mm, "bias_mm": 0.0, "outlier_share": 0.0}
    rotation = Rotation.from_euler("xyz", rng.uniform(0.0, 180.0, 3), degrees=True).as_matrix()
    return _place(specimen, rng.permutation(source), target, rotation, metadata, rng)


def _place(
    specimen: Specimen,
    source: Array,
    target: Array,
    rotation: Array,
    metadata: dict[str, Any],
    rng: np.random.Generator,
) -> Pair:
    """Centre both on the target's mean, then move the source by the rotation and +-150 mm along each axis."""
    origin = target.mean(axis=0)
    T_source_target = se3.from_rotation_translation(rotation, rng.uniform(-TRANSLATION_MM, TRANSLATION_MM, 3))
    return Pair(
        source=se3.apply(T_source_target, source - origin),
        target=target - origin,
        T_target_source=se3.inverse(T_source_target),
        name="",
        bone=specimen.bone,
        person=specimen.person,
        protocol="",
        metadata={**metadata, "origin_mm": origin},
    )


def _nearest(cloud: Array, centre: Array, share: float) -> NDArray[np.intp]:
    """Indices of the `share` of the cloud (N, 3) that is nearest to `centre` (3,)."""
    count = max(1, round(share * len(cloud)))
    return np.argpartition(((cloud - centre) ** 2).sum(axis=1), count - 1)[:count]


def _crop_centre(cloud: Array, rng: np.random.Generator) -> int:
    """Index of a random point; of a long bone (twice as long as wide) one from the last 5 % at either end."""
    centred = cloud - cloud.mean(axis=0)
    variances, axes = np.linalg.eigh(centred.T @ centred / len(cloud))
    if variances[2] < 4.0 * variances[1]:
        return int(rng.integers(len(cloud)))
    along = centred @ axes[:, 2]
    low, high = along.min(), along.max()
    margin = 0.05 * (high - low)
    end = along < low + margin if rng.random() < 0.5 else along > high - margin
    return int(rng.choice(np.flatnonzero(end)))


def _best_view(
    specimen: Specimen, level: Level, rng: np.random.Generator, draws: int = 20_000, tries: int = 8
) -> tuple[Array, Array, dict[str, Any]]:
    """Surface points and normals that a probe sees of the bone around a random point.

    The probe looks from within 45 degrees of that point's normal. A view that shows too little (a look along a shaft,
    into a fold) is no acquisition: another one is drawn, and the best of `tries` is taken.
    """
    best: tuple[float, Array, Array, dict[str, Any]] | None = None
    for _ in range(tries):
        points, normals = specimen.sample(draws, rng)
        kept = rng.uniform(*level.share)
        direction = _probe_direction(specimen, points[:1], normals[0], rng)
        if direction is None:
            continue
        seen = VIEWS[level.share_of](specimen, points, direction, kept)
        shown = len(seen) / (kept * draws)
        if best is None or shown > best[0]:
            metadata = {
                "share": kept,
                "share_of": level.share_of,
                "overlap": len(seen) / draws,
                "view_direction": direction,
            }
            best = shown, points[seen], normals[seen], metadata
        if shown >= ENOUGH_SHOWN[level.share_of]:
            break
    if best is None:
        given = f"{specimen.bone} of {specimen.person}, all hidden"
        raise ConfigError("a surface that can be seen from outside", given, "check that no closed mesh surrounds it")
    return best[1:]


def _seen_of_region(specimen: Specimen, points: Array, direction: Array, share: float) -> NDArray[np.intp]:
    """What is visible of the `share` of the surface that is nearest to the first point."""
    region = _nearest(points, points[0], share)
    return region[specimen.visible_from(points[region], direction)]


def _nearest_seen(specimen: Specimen, points: Array, direction: Array, share: float) -> NDArray[np.intp]:
    """The visible points nearest to the first one, until they are `share` of the surface, or all that is visible."""
    seen = np.flatnonzero(specimen.visible_from(points, direction))
    wanted = round(share * len(points))
    return seen if len(seen) <= wanted else seen[_nearest(points[seen], points[0], wanted / len(seen))]


def _band_seen(specimen: Specimen, points: Array, direction: Array, share: float) -> NDArray[np.intp]:
    """The visible points nearest to a line through the first one, along what is visible, until they are `share`."""
    seen = np.flatnonzero(specimen.visible_from(points, direction))
    in_view = points[seen] - points[0]
    in_view -= np.outer(in_view @ direction, direction)
    along = np.linalg.eigh(np.cov(in_view.T))[1][:, 2]
    across = np.abs(in_view @ np.cross(direction, along))
    return seen[np.argsort(across, kind="stable")[: round(share * len(points))]]


VIEWS = {"region": _seen_of_region, "seen": _nearest_seen, "band": _band_seen}
ENOUGH_SHOWN = {"region": 0.25, "seen": 0.7, "band": 0.7}  # of the share asked for


def _probe_direction(specimen: Specimen, point: Array, normal: Array, rng: np.random.Generator) -> Array | None:
    """A unit direction within 45 degrees of the normal (either sign) from which `point` (1, 3) is seen, if any."""
    for _ in range(8):
        away = degradation.random_directions(1, rng)[0]
        tilt = away - normal * (away @ normal)
        tilt /= np.linalg.norm(tilt)
        angle = np.arccos(rng.uniform(np.cos(np.pi / 4.0), 1.0))
        for outward in (normal, -normal):
            direction = np.cos(angle) * outward + np.sin(angle) * tilt
            if specimen.visible_from(point, direction)[0]:
                return direction
    return None


PROTOCOLS: dict[str, Callable[..., Pair]] = {
    "paper": paper,
    **{f"overlap-{k}": partial(paper, share=(k / 100.0, k / 100.0)) for k in (40, 50, 60, 70)},
    "incomplete": incomplete,
    **{name: partial(one_sided, level=level) for name, level in LEVELS.items()},
    "wrong": wrong,
}
