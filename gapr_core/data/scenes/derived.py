"""Pairs made of other pairs: the bone's points alone, one look of several, far clutter, echoes of ultrasound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gapr_core.data.pair import Pair
from gapr_core.geometry import extent, se3

Array = NDArray[np.float64]
BEYOND_MM = 200.0  # from the bone's outermost point to the clutter's box
CLEAR_MM = 30.0  # no clutter is nearer to the bone
BEHIND, BEFORE = (0.1, 0.3), (0.1, 0.4)  # echoes behind the bone and of layers before it, a bone point each
LAYER = (0.3, 0.8)  # where a layer is between the probe and the bone
TISSUE_MM = (8.0, 35.0)  # between the probe and the highest point of bone
ECHO_MM, LAYER_MM = 1.0, 1.5  # standard deviations along the beam
IS_BONE_MM = 6.0  # a measured point as near to a target point shows the bone; target points are some 3 mm apart


def bone_alone(pair: Pair, rng: np.random.Generator) -> Pair:
    """Keep the points of a scene that are bone, as if somebody had segmented it."""
    is_bone = np.asarray(pair.metadata["is_bone"])
    facts = {"is_bone": is_bone[is_bone], "bone_share": 1.0, "outlier_share": 0.0}
    return replace(pair, source=pair.source[is_bone], metadata={**pair.metadata, **facts})


def first_look(pair: Pair, rng: np.random.Generator) -> Pair:
    """Keep the first of several looks alone."""
    first = np.asarray(pair.metadata["look"]) == 0
    is_bone = np.asarray(pair.metadata["is_bone"])[first]
    share = float(is_bone.mean())
    of_it = {"viewpoint": pair.metadata["viewpoint"][first][0], "look": np.zeros(len(is_bone), dtype=np.int64)}
    facts = {**of_it, "is_bone": is_bone, "bone_share": share, "outlier_share": 1.0 - share}
    return replace(pair, source=pair.source[first], metadata={**pair.metadata, **facts})


def far_clutter(pair: Pair, rng: np.random.Generator, share: float) -> Pair:
    """Add points uniform in a box well beyond the bone; they are `share` of all points then."""
    count, found = round(share / (1.0 - share) * len(pair.source)), np.empty((0, 3))
    reach, bone = extent.half_extent_mm(pair.target) + BEYOND_MM, cKDTree(pair.target)
    while len(found) < count:
        drawn = rng.uniform(-reach, reach, (count, 3))
        found = np.vstack([found, drawn[bone.query(drawn, distance_upper_bound=CLEAR_MM)[0] >= CLEAR_MM]])
    clutter = se3.apply(se3.inverse(pair.T_target_source), found[:count])
    return _with(pair, clutter, np.ones(len(pair.source), dtype=bool), rng)


def echoes(pair: Pair, rng: np.random.Generator) -> Pair:
    """Add the other interfaces of an ultrasound image: layers before the bone, echoes behind it.

    A reverberation lies below the bone's point by the depth of that point under the probe.
    """
    towards = pair.T_target_source[:3, :3].T @ pair.metadata["view_direction"]
    height = pair.source @ towards
    depth = rng.uniform(*TISSUE_MM) + height.max() - height
    behind = _some(pair.source, rng.uniform(*BEHIND), rng)
    echo = -depth[behind] + rng.normal(0.0, ECHO_MM, len(behind))
    before = _some(pair.source, rng.uniform(*BEFORE), rng)
    layer = rng.uniform(*LAYER) * depth[before] + rng.normal(0.0, LAYER_MM, len(before))
    off = np.concatenate([echo, layer])[:, None] * towards
    is_bone = cKDTree(pair.target).query(se3.apply(pair.T_target_source, pair.source))[0] < IS_BONE_MM
    return _with(pair, pair.source[np.concatenate([behind, before])] + off, is_bone, rng)


def _some(points: Array, share: float, rng: np.random.Generator) -> NDArray[np.intp]:
    return rng.permutation(len(points))[: round(share * len(points))]


def _with(pair: Pair, clutter: Array, is_bone: NDArray[np.bool_], rng: np.random.Generator) -> Pair:
    """Add points to a pair that are not bone."""
    order = rng.permutation(len(pair.source) + len(clutter))
    flags = np.append(is_bone, np.zeros(len(clutter), dtype=bool))[order]
    share = float(flags.mean())
    known = {key: value for key, value in pair.metadata.items() if key != "noise_mm"}  # it is not that of all points
    facts = {"is_bone": flags, "bone_share": share, "outlier_share": 1.0 - share}
    return replace(pair, source=np.vstack([pair.source, clutter])[order], metadata={**known, **facts})
