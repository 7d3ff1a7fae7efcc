from __future__ import annotations

import numpy as np
import torch

from gapr_core.geometry import se3
from gapr_core.model.point_matching import CosineScores, log_optimal_transport
from gapr_core.model.repositioning import WeightedSVD, move, weighted_svd
from gapr_core.model.superpoint_matching import coarse_scores, patch_pairs, top_pairs


def bools(*shape):
    return torch.ones(*shape, dtype=torch.bool)


def test_a_masked_superpoint_takes_nothing_from_the_others():
    f_p, f_q = torch.randn(1, 4, 8), torch.randn(1, 5, 8)
    valid = bools(1, 5)
    valid[0, 3:] = False
    found = coarse_scores(f_p, f_q, bools(1, 4), valid)
    torch.testing.assert_close(found[:, :, :3], coarse_scores(f_p, f_q[:, :3], bools(1, 4), bools(1, 3)))
    assert found[:, :, 3:].isneginf().all()


def test_top_pairs_are_the_largest_entries_as_rows_of_the_concatenation():
    scores = torch.tensor([[[0.1, 0.9], [0.8, 0.2]], [[0.3, 0.4], [0.05, 0.0]]]).log()
    rows, columns, best = top_pairs(scores, 2)
    assert rows.tolist() == [[0, 1], [0, 0]] and columns.tolist() == [[1, 0], [1, 0]]
    torch.testing.assert_close(best, torch.tensor([[0.9, 0.8], [0.4, 0.3]]))
    chosen = patch_pairs(scores, 4, (2, 2), (2, 2))
    assert chosen.pair.tolist() == [0, 0, 0, 0, 1, 1, 1]  # an entry of zero is no pair
    assert chosen.source.tolist() == [0, 1, 1, 0, 2, 2, 3] and chosen.target.tolist() == [1, 0, 1, 0, 3, 2, 2]


def test_the_assignment_of_every_point_sums_to_one():
    torch.manual_seed(0)
    valid_p, valid_q = bools(3, 6), bools(3, 4)
    valid_p[0, 2:] = False
    valid_q[1, 3:] = False
    log_z = log_optimal_transport(3 * torch.randn(3, 6, 4), torch.tensor(0.5), valid_p, valid_q, 100)
    rows, columns = log_z.exp().sum(2)[:, :-1], log_z.exp().sum(1)[:, :-1]
    torch.testing.assert_close(rows[valid_p], torch.ones(int(valid_p.sum())), atol=1e-3, rtol=0)
    torch.testing.assert_close(columns[valid_q], torch.ones(int(valid_q.sum())), atol=1e-3, rtol=0)


def test_masked_transport_equals_transport_of_the_points_that_exist():
    scores, alpha = torch.randn(1, 6, 5), torch.tensor(1.0)
    valid_p, valid_q = bools(1, 6), bools(1, 5)
    valid_p[0, 4:], valid_q[0, 3:] = False, False
    found = log_optimal_transport(scores, alpha, valid_p, valid_q, 20)
    expected = log_optimal_transport(scores[:, :4, :3], alpha, bools(1, 4), bools(1, 3), 20)
    torch.testing.assert_close(found[:, :4, :3], expected[:, :4, :3], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(found[:, :4, -1], expected[:, :4, -1], atol=1e-4, rtol=1e-4)


def test_transport_agrees_with_plain_sinkhorn_scaling():
    scores = torch.randn(1, 3, 4)
    kernel = torch.nn.functional.pad(scores, (0, 1, 0, 1), value=0.7)[0].exp().double()
    mu, nu = torch.tensor([1.0, 1, 1, 4]).double(), torch.tensor([1.0, 1, 1, 1, 3]).double()
    v = torch.ones(5).double()
    for _ in range(200):
        u = mu / (kernel @ v)
        v = nu / (kernel.T @ u)
    found = log_optimal_transport(scores, torch.tensor(0.7), bools(1, 3), bools(1, 4), 200).exp()
    torch.testing.assert_close(found[0], (u[:, None] * kernel * v).float(), atol=1e-4, rtol=1e-3)


def test_cosine_scores_ignore_length():
    f_p, f_q = torch.randn(1, 3, 16), torch.randn(1, 4, 16)
    cosine = CosineScores()
    expected = 10.0 * torch.cosine_similarity(f_p[:, :, None], f_q[:, None], dim=-1)
    torch.testing.assert_close(cosine(cosine.prepare(3 * f_p), cosine.prepare(f_q)), expected)


def test_transport_of_huge_scores_stays_finite_with_finite_gradients():
    scores = (300.0 * torch.randn(2, 6, 5)).requires_grad_()
    log_z = log_optimal_transport(scores, torch.tensor(1.0), bools(2, 6), bools(2, 5), 30)
    log_z.exp().sum().backward()
    assert log_z.isfinite().all() and scores.grad.isfinite().all()


def test_weighted_svd_equals_the_float64_reference():
    rng = np.random.default_rng(0)
    p, w = rng.normal(size=(20, 3)), rng.uniform(size=20)
    q = se3.apply(se3.from_rotation_translation(se3.random_rotation(rng), [1, 2, 3]), p) + 0.1 * rng.normal(
        size=(20, 3)
    )
    T, _ = weighted_svd(*(torch.from_numpy(x)[None] for x in (p, q, w)))
    np.testing.assert_allclose(T[0].numpy(), se3.kabsch(p, q, w)[:3], atol=1e-5)


def test_repositioning_finds_the_motion_of_well_matched_superpoints_without_gradient(config):
    torch.manual_seed(0)
    p, features = torch.randn(1, 12, 3), torch.nn.functional.normalize(torch.randn(1, 12, 16), dim=-1).requires_grad_()
    T = torch.cat([torch.from_numpy(se3.random_rotation(np.random.default_rng(1))).float(), torch.ones(3, 1)], 1)[None]
    found = WeightedSVD(config)(features, features, p, move(T, p), bools(1, 12), bools(1, 12))
    torch.testing.assert_close(found, T, atol=0.02, rtol=0)
    assert not found.requires_grad


def test_repositioning_stays_where_points_lie_in_a_line_or_are_too_few(config):
    features = torch.nn.functional.normalize(torch.randn(1, 12, 16), dim=-1)
    line = torch.arange(12.0)[None, :, None] * torch.tensor([1.0, 2.0, -1.0])
    few = bools(1, 12)
    few[0, 2:] = False
    reposition, still = WeightedSVD(config), torch.eye(3, 4)[None]
    assert torch.equal(reposition(features, features, line, line + 1, bools(1, 12), bools(1, 12)), still)
    cloud = torch.randn(1, 12, 3)
    assert torch.equal(reposition(features, features, cloud, cloud + 1, few, bools(1, 12))[:, :, :3], still[:, :, :3])
