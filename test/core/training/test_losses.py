from __future__ import annotations

import torch

from gapr_core.model.network import GAPRNet
from gapr_core.training.losses import circle_loss, compute_losses
from gapr_core.training.validation import inlier_ratios


def bools(*shape):
    return torch.ones(*shape, dtype=torch.bool)


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


def test_overfitting_one_pair_drives_both_inlier_ratios_up(toy):
    config = toy.small_config(test_pairs=12, superpoints=(10, 16), width=8)
    pair = toy.pair(config)
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
