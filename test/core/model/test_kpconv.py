from __future__ import annotations

import pytest
import torch

from gapr_core.model.backbone.kpconv import KERNEL_FRAMES, KPConv, kernel_layout
from gapr_core.model.pairs import LocalPairs


def pairs_of(cloud, level=1):
    fine, coarse = cloud.levels[level - 1], cloud.levels[level]
    return LocalPairs(coarse, fine, coarse.below)


def naive(conv, x, pairs):
    """Three nested loops: over centres, neighbours and kernel points."""
    places, out = conv.places(pairs), []
    weight = conv.weight.view(15, x.shape[1], -1)
    for i in range(len(pairs.index)):
        total, count = 0.0, int(pairs.hood.valid[i].sum())
        for j in range(pairs.index.shape[1]):
            if pairs.hood.valid[i, j]:
                for k in range(15):
                    influence = max(0.0, 1.0 - float((places[i, j] - conv.kernel[k]).norm()) / conv.sigma)
                    total = total + influence * x[pairs.index[i, j]] @ weight[k]
        out.append(total / count)
    return torch.stack(out)


@pytest.mark.parametrize("frame", sorted(KERNEL_FRAMES))
def test_kpconv_equals_a_naive_loop(frame, clouds, toy):
    torch.manual_seed(0)
    conv, pairs = KPConv(5, 7, toy.small_config(kernel_frame=frame)), pairs_of(clouds[0], 2)
    x = torch.randn(len(clouds[0].levels[1].points), 5)
    torch.testing.assert_close(conv(x, pairs), naive(conv, x, pairs), atol=2e-5, rtol=1e-4)


def test_the_surface_frame_does_not_turn_with_the_cloud_and_the_world_frame_does(clouds, toy):
    cloud = clouds[1]
    turned = cloud.turned(toy.motion(4))
    for frame, invariant in (("surface", True), ("world", False)):
        before, after = (KERNEL_FRAMES[frame](pairs_of(c)) for c in (cloud, turned))
        assert torch.allclose(before, after, atol=1e-3) == invariant


def test_kernel_points_are_the_centre_and_fourteen_on_one_sphere():
    radii = kernel_layout().norm(dim=1)
    assert radii[0] == 0 and torch.allclose(radii[1:], torch.full((14,), 0.66))
    assert torch.allclose(kernel_layout().mean(0), torch.zeros(3), atol=1e-6)


def test_missing_neighbours_have_no_influence(clouds, toy):
    conv, pairs = KPConv(3, 4, toy.small_config()), pairs_of(clouds[0])
    x = torch.randn(len(clouds[0].levels[0].points), 3)
    pairs.hood.valid[:, 4:] = False
    before = conv(x, pairs)
    x2 = x.clone()
    unseen = torch.ones(len(x), dtype=torch.bool)
    unseen[pairs.index[:, :4]] = False
    x2[unseen] = 100.0
    torch.testing.assert_close(conv(x2, pairs), before)
