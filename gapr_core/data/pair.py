"""A source and a target cloud with the motion between them, and how protocols place them in space."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3

Array = NDArray[np.float64]
TARGET_POINTS = 8192
TRANSLATION_MM = 150.0


@dataclass(frozen=True)
class Pair:
    """A source and a target cloud, and the motion that takes one to the other.

    Attributes:
        source: (N, 3) mm, in its own frame.
        target: (M, 3) mm, centred on its mean: surface coordinates minus metadata["origin_mm"].
        T_target_source: (4, 4) truth; all NaN where no pose is right (protocol `wrong`).
        metadata: region share, overlap, noise_mm, bias_mm, outlier_share and others. A camera's view has `viewpoint`
            (3,) mm, the camera's place in the source's frame; several looks have (N, 3), one for each point.
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

    @property
    def viewpoint(self) -> Array | None:
        """(3,) or (N, 3) mm, source frame: the camera; None where there is none."""
        given = self.metadata.get("viewpoint")
        return None if given is None else np.asarray(given, dtype=np.float64)


def place(
    specimen: Specimen,
    source: Array,
    target: Array,
    rotation: Array,
    metadata: dict[str, Any],
    rng: np.random.Generator,
    viewpoint: Array | None = None,
) -> Pair:
    """Centre both on the target's mean, then move the source by the rotation and +-150 mm along each axis.

    A camera at `viewpoint` mm, (3,) or for each point (N, 3), in the bone's frame, moves with the source.
    """
    origin = target.mean(axis=0)
    T_source_target = se3.from_rotation_translation(rotation, rng.uniform(-TRANSLATION_MM, TRANSLATION_MM, 3))
    seen_from = {}
    if viewpoint is not None:
        places = se3.apply(T_source_target, np.atleast_2d(viewpoint - origin))
        seen_from["viewpoint"] = places.reshape(viewpoint.shape)
    return Pair(
        source=se3.apply(T_source_target, source - origin),
        target=target - origin,
        T_target_source=se3.inverse(T_source_target),
        name="",
        bone=specimen.bone,
        person=specimen.person,
        protocol="",
        metadata={**metadata, "origin_mm": origin, **seen_from},
    )
