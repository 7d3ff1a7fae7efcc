"""The surface of a mask at sub-voxel accuracy: the staircase is smoothed, and nothing shrinks.

A Gaussian G_s of standard deviation s takes a mask, on its surface, to 1/2 - s (k1 + k2) / sqrt(8 pi) + O(s^3), where
the curvatures are k1 and k2: its level of one half has moved inwards. The term is linear in s, so that 2 G_s - G_2s
keeps one half where the surface is (Richardson's extrapolation).
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gapr_core.errors import InvalidPointCloudError
from gapr_core.surface import Surface

Array = NDArray[np.float64]
log = logging.getLogger(__name__)

SMOOTHING_VOXELS = 1.0  # standard deviation of G along each axis
SPECK = 0.01  # share of the largest component below which another one is noise of the segmentation


def surface_of(mask: NDArray[np.uint8], affine: Array, smoothing_voxels: float = SMOOTHING_VOXELS) -> Surface:
    """Mesh the voxels of a mask; open where the mask touches the image's border.

    Args:
        mask: [k, j, i], 0 or 1.
        affine: (4, 4) from voxel indices (i, j, k) to mm.
        smoothing_voxels: standard deviation of the smoothing, in voxels.

    Returns:
        vertices in mm, faces wound outward, also where the affine is a reflection.

    Raises:
        InvalidPointCloudError: a mask that is too thin to have a surface, or fills its image.
    """
    from skimage.measure import marching_cubes

    field = _smoothed(_without_specks(mask), smoothing_voxels)
    if field.max() <= 0.5 or min(field.shape) < 2:
        given, how = "one that is too thin or too small for its voxels", "segment it on a finer grid"
        raise InvalidPointCloudError("a segment with a surface", given, how)
    if field.min() >= 0.5:
        given, how = "one that fills the whole image", "check the segmentation, and which label you chose"
        raise InvalidPointCloudError("a segment with a surface", given, how)
    vertices, faces, _, _ = marching_cubes(field, 0.5, gradient_direction="ascent")
    points = vertices[:, ::-1].astype(np.float64) @ affine[:3, :3].T + affine[:3, 3]
    outward = faces[:, ::-1] if np.linalg.det(affine[:3, :3]) > 0.0 else faces
    return Surface(points, np.ascontiguousarray(outward, dtype=np.int64))


def _smoothed(mask: NDArray[np.uint8], sigma: float) -> NDArray[np.float32]:
    fine, coarse = (ndimage.gaussian_filter(mask.astype(np.float32), s, mode="nearest") for s in (sigma, 2.0 * sigma))
    return 2.0 * fine - coarse


def _without_specks(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    labels, count = ndimage.label(mask, structure=np.ones((3, 3, 3)))
    sizes = np.bincount(labels.ravel())[1:]
    specks = np.flatnonzero(sizes < SPECK * sizes.max()) + 1
    if len(specks) == 0:
        return mask
    log.warning("%d specks of together %d voxels are left out of the segment", len(specks), sizes[specks - 1].sum())
    return mask * ~np.isin(labels, specks)
