"""Views of a bone from one side: a region, all that is visible near a point, or a band. Seeded."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.geometry import extent, sampling

Array = NDArray[np.float64]
TRIES = 8  # views that are drawn where each shows too little


def best_view(
    specimen: Specimen,
    share: tuple[float, float],
    share_of: str,
    rng: np.random.Generator,
    draws: int = 20_000,
) -> tuple[Array, Array, dict[str, Any]]:
    """Surface points and normals that a probe sees of the bone around a random point.

    The probe looks from within 45 degrees of that point's normal. A view that shows too little (a look along a shaft,
    into a fold) is no acquisition: another one is drawn, and the best of `TRIES` is taken.
    """
    best: tuple[float, Array, Array, dict[str, Any]] | None = None
    for _ in range(TRIES):
        points, normals = specimen.sample(draws, rng)
        kept = rng.uniform(*share)
        direction = _probe_direction(specimen, points[:1], normals[0], rng)
        if direction is None:
            continue
        seen = VIEWS[share_of](specimen, points, direction, kept)
        shown = len(seen) / (kept * draws)
        if best is None or shown > best[0]:
            metadata = {
                "share": kept,
                "share_of": share_of,
                "overlap": len(seen) / draws,
                "view_direction": direction,
            }
            best = shown, points[seen], normals[seen], metadata
        if shown >= ENOUGH_SHOWN[share_of]:
            break
    if best is None:
        given = f"{specimen.bone} of {specimen.person}, all hidden"
        raise ConfigError("a surface that can be seen from outside", given, "check that no closed mesh surrounds it")
    return best[1:]


def _seen_of_region(specimen: Specimen, points: Array, direction: Array, share: float) -> NDArray[np.intp]:
    """Find the visible points of the `share` of the surface that is nearest to the first point."""
    region = nearest(points, points[0], share)
    return region[specimen.visible_from(points[region], direction)]


def _nearest_seen(specimen: Specimen, points: Array, direction: Array, share: float) -> NDArray[np.intp]:
    """Find the visible points nearest to the first one, up to `share` of the surface."""
    seen = np.flatnonzero(specimen.visible_from(points, direction))
    wanted = round(share * len(points))
    return seen if len(seen) <= wanted else seen[nearest(points[seen], points[0], wanted / len(seen))]


def _band_seen(specimen: Specimen, points: Array, direction: Array, share: float) -> NDArray[np.intp]:
    """Find the visible points nearest to a line through the first one, up to `share`."""
    seen = np.flatnonzero(specimen.visible_from(points, direction))
    in_view = points[seen] - points[0]
    in_view -= np.outer(in_view @ direction, direction)
    along = extent.principal(in_view).axes[0]
    across = np.abs(in_view @ np.cross(direction, along))
    return seen[np.argsort(across, kind="stable")[: round(share * len(points))]]


VIEWS = {"region": _seen_of_region, "seen": _nearest_seen, "band": _band_seen}
ENOUGH_SHOWN = {"region": 0.25, "seen": 0.7, "band": 0.7}  # of the share asked for


def _probe_direction(specimen: Specimen, point: Array, normal: Array, rng: np.random.Generator) -> Array | None:
    """Draw a direction within 45 degrees of the normal (either sign) from which `point` (1, 3) is seen."""
    for _ in range(8):
        away = sampling.random_directions(1, rng)[0]
        tilt = away - normal * (away @ normal)
        tilt /= np.linalg.norm(tilt)
        angle = np.arccos(rng.uniform(np.cos(np.pi / 4.0), 1.0))
        for outward in (normal, -normal):
            direction = np.cos(angle) * outward + np.sin(angle) * tilt
            if specimen.visible_from(point, direction)[0]:
                return direction
    return None


def nearest(cloud: Array, centre: Array, share: float) -> NDArray[np.intp]:
    """Indices of the `share` of the cloud (N, 3) that is nearest to `centre` (3,)."""
    count = max(1, round(share * len(cloud)))
    return np.sort(np.argpartition(((cloud - centre) ** 2).sum(axis=1), count - 1)[:count])
