"""Shapes without a knowable pose: solids of revolution and boxes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapr_core.data import protocols, scans
from gapr_core.data.pair import Pair
from gapr_core.data.scenes.things import BOX_FACES
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3
from gapr_core.geometry.sampling import log_uniform
from gapr_core.surface import Surface

Array = NDArray[np.float64]


def turned_pair(seed: int) -> Pair:
    """Pair a solid of revolution with a view from one side: its spin is unknowable, so no pose is right."""
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
    return Pair(source[: rng.integers(500, 3000)], draw(8192), nowhere, f"turned-{seed}", "none", "none", "turned")


def box_pair(seed: int) -> Pair:
    """Pair a box, smooth or of voxels, with a side or a corner: alike in four poses, so none is right."""
    rng = np.random.default_rng([seed, 43])
    sides_mm, turn = np.exp(rng.uniform(np.log(20.0), np.log(250.0), 3)), se3.random_rotation(rng)
    corners = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * sides_mm @ turn.T
    box = Specimen(Surface(corners, BOX_FACES), "box", "none")
    if rng.random() < 0.5:
        box = replace(box, surface=scans.drawn(rng)(box.surface))
    noise_mm, bias_mm, outliers = rng.uniform(0.05, 1.0), rng.uniform(0.0, 1.0) * (rng.random() < 0.5), 0.0
    share, points = (log_uniform(limits, rng) for limits in ((0.02, 0.4), (300.0, 4000.0)))
    level = protocols.Level((share, share), "seen", noise_mm, bias_mm, outliers, int(points))
    pair = protocols.one_sided(box, rng, level)
    return replace(pair, T_target_source=np.full((4, 4), np.nan), name=f"box-{seed}", protocol="box", bone="none")


SHAPES = {"turned": turned_pair, "box": box_pair}
