from __future__ import annotations

import math

import torch

from gapr_core.geometry import se3
from gapr_core.model.network import GAPRNet
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.training.losses import LOG_SCALE, assignment_loss, circle_loss, compute_losses
from gapr_core.training.targets import training_pair
from gapr_core.training.validation import inlier_ratios


def bools(*shape):
    return torch.ones(*shape, dtype=torch.bool)


def test_the_circle_loss_of_two_patches_by_hand():
    """d = 0 to the partner, sqrt(2) to the other: the positive is within its margin, the negative beyond its own."""
    f = torch.eye(2)[None]
    loss = circle_loss(f, f, torch.eye(2)[None], bools(1, 2), bools(1, 2))
    assert math.isclose(float(loss), math.log(2.0) / LOG_SCALE, rel_tol=1e-3)
    swapped = circle_loss(f, f.flip(1), torch.eye(2)[None], bools(1, 2), bools(1, 2))
    root = math.sqrt(2.0)
    pull, push = LOG_SCALE * (root - 0.1) ** 2, LOG_SCALE * 1.4**2
    assert math.isclose(float(swapped), (pull + push) / LOG_SCALE, rel_tol=1e-3)


def test_the_circle_loss_weighs_a_positive_by_the_root_of_its_overlap():
    f = torch.eye(2)[None]
    overlap = 0.25 * torch.eye(2)[None]
    loss = circle_loss(f, f.flip(1), overlap, bools(1, 2), bools(1, 2))
    root = math.sqrt(2.0)
    assert math.isclose(float(loss), 0.5 * (root - 0.1) ** 2 + 1.4**2, rel_tol=1e-3)


def test_patches_with_some_overlap_below_ten_percent_are_neither_positive_nor_negative():
    f = torch.nn.functional.normalize(torch.randn(1, 3, 8), dim=-1)
    overlaps = torch.tensor([[[0.5, 0.05, 0.0], [0.0, 0.5, 0.05], [0.05, 0.0, 0.5]]])
    g = f.clone()
    g[0, 1] = -f[0, 1]
    with_vague = circle_loss(f, f, overlaps, bools(1, 3), bools(1, 3))
    only = overlaps.clone()
    only[only == 0.05] = 0.07
    torch.testing.assert_close(with_vague, circle_loss(f, f, only, bools(1, 3), bools(1, 3)))


def test_without_any_overlap_the_loss_is_zero_with_a_zero_gradient():
    f = torch.nn.functional.normalize(torch.randn(1, 3, 8), dim=-1).requires_grad_()
    loss = circle_loss(f, f.detach(), torch.zeros(1, 3, 3), bools(1, 3), bools(1, 3))
    loss.backward()
    assert loss == 0 and f.grad.abs().max() == 0


def test_masked_superpoints_do_not_count():
    f, overlaps = torch.nn.functional.normalize(torch.randn(1, 4, 8), dim=-1), torch.eye(4)[None]
    valid = bools(1, 4)
    valid[0, 3] = False
    short = circle_loss(f[:, :3], f[:, :3], overlaps[:, :3, :3], bools(1, 3), bools(1, 3))
    torch.testing.assert_close(circle_loss(f, f, overlaps, valid, valid), short)


def test_the_assignment_loss_is_the_mean_over_the_labelled_entries():
    log_z = torch.tensor([[[-1.0, -2.0], [-4.0, -8.0]]])
    labels = torch.tensor([[[True, False], [True, False]]])
    assert assignment_loss(log_z, labels) == 2.5


def test_overfitting_one_pair_drives_both_inlier_ratios_up(toy):
    config = toy.small_config(test_pairs=12, superpoints=(10, 16), width=8)
    frame = target_frame(toy.bone(), config)
    source = build_cloud(se3.apply(toy.motion(3), toy.view(toy.bone(700, 1))), frame, config)
    pair = training_pair(source, build_cloud(toy.bone(), frame, config), se3.inverse(toy.motion(3)), frame)
    torch.manual_seed(0)
    net = GAPRNet(config)

    def ratios():
        with torch.inference_mode():
            return inlier_ratios(net(pair.source, pair.target), pair.source, pair)

    before = ratios()
    optimizer = torch.optim.AdamW(net.parameters(), 3e-3)
    for step in range(40):
        losses, _ = compute_losses(net, pair, torch.Generator().manual_seed(step))
        optimizer.zero_grad()
        losses.total.backward()
        optimizer.step()
    after = ratios()
    assert after[0] > max(0.8, before[0] + 0.2) and after[1] > before[1] + 0.2
