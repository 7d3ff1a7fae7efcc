"""The label map of a mesh that is known exactly."""

import numpy as np
import pytest

from gapr_core.data.masks import mask_of
from gapr_core.surface import Surface


@pytest.mark.parametrize("spacing_mm", [1.0, (0.7, 1.1, 1.6)])
def test_a_voxel_is_bone_where_its_middle_is_inside(spacing_mm):
    import open3d as o3d

    low, size = np.array([3.0, -7.0, 11.0]), np.array([9.5, 12.3, 7.9])
    box = o3d.geometry.TriangleMesh.create_box(*size).subdivide_midpoint(3)
    mask, affine = mask_of(Surface(np.asarray(box.vertices) + low, np.asarray(box.triangles)), spacing_mm)
    indices = np.stack(np.meshgrid(*map(np.arange, mask.shape), indexing="ij"), axis=-1)[..., ::-1]
    middles = indices @ affine[:3, :3].T + affine[:3, 3]
    inside = ((middles > low) & (middles < low + size)).all(axis=-1)
    np.testing.assert_array_equal(mask.astype(bool), inside)
    assert not mask[0].any() and not mask[-1].any() and inside.sum() > 100
