"""Views of a bone outside of the protocols, for the models of confidence and precision only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import open3d as o3d

from gapr_core.data import protocols
from gapr_core.data.pair import TARGET_POINTS, Pair
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import sampling
from gapr_core.geometry.sampling import log_uniform

VOXELS_MM = (4.0, 12.0)  # edges of the grid that thins a cloud
DENSE = 20000  # points before thinning


def patch_view(specimen: Specimen, rng: np.random.Generator) -> Pair:
    """Draw a one-sided view of 1 to 12 % of the bone, of few points."""
    share, points = (log_uniform(limits, rng) for limits in ((0.01, 0.12), (60.0, 1500.0)))
    noise_mm, bias_mm, outliers = rng.uniform(0.2, 1.5), rng.uniform(0.0, 1.5), rng.uniform(0.0, 0.2)
    level = protocols.Level((share, share), "seen", noise_mm, bias_mm, outliers, int(points))
    return protocols.one_sided(specimen, rng, level)


def mixed_view(specimen: Specimen, rng: np.random.Generator) -> Pair:
    """Draw a view between and beyond the protocols: from many clean points to tiny, noisy, biased, dirty views."""
    share = rng.uniform(0.1, 0.9)
    noise_mm, bias_mm, outliers = (rng.uniform(0.0, most) * (rng.random() < 0.7) for most in (2.0, 1.5, 0.25))
    share_of = str(rng.choice(["seen", "region"]))
    points = int(np.exp(rng.uniform(np.log(300), np.log(6000))))
    level = protocols.Level((share, share), share_of, noise_mm, bias_mm, outliers, points)
    return protocols.one_sided(specimen, rng, level)


def crop_view(specimen: Specimen, rng: np.random.Generator) -> Pair:
    """Cut clean points of a region out of the bone, from all sides, as a piece of a model."""
    cloud, _ = specimen.sample(2 * TARGET_POINTS, rng)
    distance = ((cloud - cloud[rng.integers(len(cloud))]) ** 2).sum(axis=1)
    source = cloud[distance <= np.quantile(distance, rng.uniform(0.1, 0.9))]
    source = source[rng.permutation(len(source))[: rng.integers(300, 6000)]]
    metadata = {"origin_mm": np.zeros(3)}
    return Pair(source, cloud, np.eye(4), "", specimen.bone, specimen.person, "crop", metadata)


def thinned_view(specimen: Specimen, rng: np.random.Generator) -> Pair:
    """Draw a one-sided view in a grid of 4 to 12 mm, as tools thin clouds that are too large.

    Of each voxel either the mean of its points, as by PCL's and Open3D's filters, or one of them is left.
    """
    share, voxel_mm = rng.uniform(0.15, 0.9), rng.uniform(*VOXELS_MM)
    noise_mm, bias_mm, outliers = rng.uniform(0.1, 1.2), rng.uniform(0.0, 1.0), rng.uniform(0.0, 0.05)
    level = protocols.Level((share, share), "seen", noise_mm, bias_mm, outliers, DENSE)
    pair = protocols.one_sided(specimen, rng, level)
    if rng.random() < 0.5:
        dense = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(pair.source))
        source = np.asarray(dense.voxel_down_sample(voxel_mm).points)
    else:
        source = pair.source[sampling.voxel_indices(pair.source, voxel_mm)]
    return replace(pair, source=source, metadata=pair.metadata | {"voxel_mm": voxel_mm})


VIEWS: dict[str, Callable[[Specimen, np.random.Generator], Pair]] = {
    "patch": patch_view,
    "mixed": mixed_view,
    "crop": crop_view,
    "thinned": thinned_view,
}
