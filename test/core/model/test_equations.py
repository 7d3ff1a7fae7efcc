"""Every equation of the paper (arXiv 2606.13488), written out here with NumPy and loops, against the network's code."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from gapr_core.model.attention import Attention, VanillaEncoder
from gapr_core.model.encoding.pga import PGAEncoder
from gapr_core.model.pairs import LocalPairs
from gapr_core.model.pgf import embed
from gapr_core.model.point_matching import DotScores, FineAssignment, FineMatching
from gapr_core.model.repositioning import move
from gapr_core.model.superpoint_matching import coarse_scores
from gapr_core.model.transformer import GlobalAggregation, Nodes
from gapr_core.model.types import PatchPairs
from gapr_core.training.losses import Losses, assignment_loss, circle_loss

DIM = 8


def array(tensor):
    return tensor.detach().double().numpy()


def softmax(logits):
    shifted = np.exp(logits - logits.max())
    return shifted / shifted.sum()


def dense(x, layer):
    """A linear layer, or an MLP of linear layers and ReLUs, on one vector."""
    for part in layer if isinstance(layer, torch.nn.Sequential) else [layer]:
        if isinstance(part, torch.nn.ReLU):
            x = np.maximum(x, 0.0)
        else:
            x = array(part.weight) @ x + (0.0 if part.bias is None else array(part.bias))
    return x


def written_out(layer, x_q, x_s, l_ij=None, present=None):
    """Eq. (1) to (5) for one head: sum_j softmax_j(f_q W^Q (f_k W^K + r_ij W^R)^T / sqrt d) f_v W^V."""
    out = []
    for i, query in enumerate(array(x_q)):
        q, logits, values = dense(query, layer.query), [], []
        columns = range(len(x_s)) if present is None else present[i]
        for column, j in enumerate(columns):
            k = dense(array(x_s[j]), layer.key)
            if l_ij is not None:
                r = dense(dense(array(l_ij[i, column]), layer.encoder.first), layer.encoder.relative.second)
                k = k + dense(r, layer.encoder.relative.to_key)
            logits.append(q @ k / np.sqrt(DIM))
            values.append(dense(array(x_s[j]), layer.value))
        out.append(softmax(np.array(logits)) @ np.array(values))
    return np.array(out)


def attention(encoder, seed=0):
    torch.manual_seed(seed)
    return Attention(DIM, 1, encoder, mlp=True)  # one head and an MLP before every W, as the paper has it


def pga():
    return PGAEncoder(DIM, DIM, in_values=False)


def features(count, seed=0):
    return torch.randn(count, DIM, generator=torch.Generator().manual_seed(seed))


def seven(p_i, p_j, c_h, c_k, radius):
    """The embedded PGF of one pair; test_pgf.py holds it against its definition."""
    return embed(*(torch.as_tensor(p, dtype=torch.float32) for p in (p_i, p_j, c_h, c_k)), float(radius))


def test_equations_1_and_2_of_local_attention_with_the_balls_of_kpconv(clouds):
    """c_h and c_k are the means of the balls of radius r and k_r r, r that of the KPConv before it."""
    level = clouds[0].levels[-1]
    points, radius = level.points.double().numpy(), float(level.within.radius[0])
    pairs, layer, x = LocalPairs(level, level, level.within), attention(pga()), features(len(points))
    found = layer(x, x, pairs)
    for i in range(0, len(points), 4):
        distance = np.linalg.norm(points - points[i], axis=1)
        inside = np.argsort(distance, kind="stable")[: int((distance <= radius).sum())][: level.within.index.shape[1]]
        c_h, c_k = points[inside].mean(axis=0), points[inside[distance[inside] <= 0.5 * radius]].mean(axis=0)
        l_ij = torch.stack([seven(points[i], points[j], c_h, c_k, radius) for j in inside])[None]
        expected = written_out(layer, x[i : i + 1], x, l_ij, [inside])[0]
        np.testing.assert_allclose(array(found[i]), expected, atol=2e-4)


@pytest.mark.parametrize("ball", ["whole", "part"])
def test_equations_1_and_2_of_global_attention_with_the_whole_cloud_as_the_larger_ball(ball, clouds):
    """The smaller ball is KPConv's at the bottleneck (`whole`, the paper's), or a part of it (what ships)."""
    level = clouds[0].levels[-1]
    points, radius = level.points.double().numpy(), float(level.within.radius[0])
    inner = radius if ball == "whole" else 0.5 * radius
    layer, x = attention(pga()), features(len(points))
    found = layer(x[None], x[None], Nodes.of(clouds[0], ball).look_at_self())[0]
    near = [points[np.linalg.norm(points - p, axis=1) <= inner] for p in points]
    c_k = [
        within[np.argsort(np.linalg.norm(within - p, axis=1))[:10]].mean(0)
        for within, p in zip(near, points, strict=True)
    ]
    rows = [[seven(p_i, p_j, points.mean(0), c, 1.0) for p_j in points] for p_i, c in zip(points, c_k, strict=True)]
    l_ij = torch.stack([torch.stack(row) for row in rows])
    np.testing.assert_allclose(array(found), written_out(layer, x, x, l_ij), atol=2e-4)


def test_equations_3_and_4_of_the_standard_cross_attention(clouds):
    source, target = (Nodes.of(cloud) for cloud in clouds[:2])
    x_p, x_q, layer = features(source.points.shape[1]), features(target.points.shape[1], 1), attention(VanillaEncoder())
    found = layer(x_p[None], x_q[None], source.look_at(target))[0]
    np.testing.assert_allclose(array(found), written_out(layer, x_p, x_q), atol=1e-5)


def test_equations_3_and_5_of_the_cross_pga_after_repositioning(clouds, toy):
    """c_h is the other cloud's centroid, c_k the mean of its points about p_i, after one cloud was moved by T_r."""
    aggregation = GlobalAggregation(toy.small_config(global_width=DIM, heads=1, early_features="plain"))
    last = aggregation.cross_layers[-1] = torch.nn.Module()
    last.attention, seen = attention(pga()), []
    last.forward = lambda x_q, x_s, pairs: (seen.append((x_q, x_s, pairs)), last.attention(x_q, x_s, pairs))[1]
    coarse = [torch.randn(len(c.coarse.points), 16 * 8, generator=torch.Generator().manual_seed(7)) for c in clouds[:2]]
    found = aggregation(*clouds[:2], *coarse)
    p = array(move(found.T_reposition, clouds[0].coarse.points[None])[0])
    q, radius = array(clouds[1].coarse.points), float(clouds[1].coarse.within.radius[0])
    x_p, x_q, pairs = seen[0]
    for i in range(0, len(p), 5):
        gap = np.linalg.norm(q - p[i], axis=1)
        c_k = q[gap <= max(radius, gap.min())].mean(axis=0)
        l_ij = torch.stack([seven(p[i], q_j, q.mean(axis=0), c_k, 1.0) for q_j in q])[None]
        expected = written_out(last.attention, x_p[0, i : i + 1], x_q[0], l_ij)[0]
        np.testing.assert_allclose(array(last.attention(x_p, x_q, pairs)[0, i]), expected, atol=2e-4)


def test_equations_6_and_7_of_the_coarse_scores():
    f_p, f_q = features(4), features(5, 1)
    s = np.array([[np.exp(-((a - b) ** 2).sum()) for b in array(f_q)] for a in array(f_p)])
    expected = [[s[i, j] / s[i].sum() * s[i, j] / s[:, j].sum() for j in range(5)] for i in range(4)]
    exist = (torch.ones(1, 4, dtype=torch.bool), torch.ones(1, 5, dtype=torch.bool))
    np.testing.assert_allclose(array(coarse_scores(f_p[None], f_q[None], *exist)[0].exp()), expected, rtol=1e-4)


def test_equation_8_of_the_fine_costs():
    scores, f_p, f_q = DotScores(), features(3), features(4, 1)
    found = scores(scores.prepare(f_p)[None], scores.prepare(f_q)[None])[0]
    expected = [[sum(a * b) / np.sqrt(DIM) for b in array(f_q)] for a in array(f_p)]
    np.testing.assert_allclose(array(found), expected, rtol=1e-5)


def test_equation_9_of_the_union_of_the_mutual_best_matches(clouds, toy):
    """A match is kept where it is among the k best of its row and of its column of Z, and no dustbin counts."""
    k, source, target = 2, *clouds[:2]
    matching = FineMatching(toy.small_config(mutual_k=k, match_confidence=0.0))
    z = torch.rand(3, 5, 6, generator=torch.Generator().manual_seed(1))
    index = torch.arange(3 * 9).view(3, 9)
    exist = torch.ones(3, 9, dtype=torch.bool)
    fine = FineAssignment(z.log(), index[:, :4], index[:, 4:], exist[:, :4], exist[:, 4:])
    chosen = PatchPairs(torch.zeros(3, dtype=torch.long), torch.arange(3), torch.arange(3), torch.ones(3))
    found = matching.correspondences(source, target, fine, chosen)
    union = set()
    for patch in range(3):
        inner = array(z[patch])[:4, :5]
        for a in range(4):
            for b in range(5):
                if (inner[a] > inner[a, b]).sum() < k and (inner[:, b] > inner[a, b]).sum() < k:
                    union.add(
                        (
                            patch,
                            *source.fine.points[index[patch, a]].tolist(),
                            *target.fine.points[index[patch, 4 + b]].tolist(),
                        )
                    )
    columns = zip(found.patch.tolist(), found.source.tolist(), found.target.tolist(), strict=True)
    assert {(patch, *p, *q) for patch, p, q in columns} == union


def test_equation_10_of_the_loss_and_what_the_auxiliary_loss_adds():
    coarse, fine, early = torch.tensor([1.0, 20.0, 300.0])
    assert Losses(coarse, fine, early, early_weight=0.0).total == 21.0
    assert Losses(coarse, fine, early, early_weight=0.5).total == 171.0


def circle(distance, overlap):
    """Eq. (12) of the rows; the scale 24 is GeoTransformer's, on either exponent and off the logarithm."""
    losses = []
    for d, o in zip(distance, overlap, strict=True):
        positive, negative = o > 0.1, o == 0
        if positive.any() and negative.any():
            weight_p, weight_n = np.maximum(d - 0.1, 0.0), np.maximum(1.4 - d, 0.0)
            pull = sum(np.exp(24 * np.sqrt(o) * weight_p * (d - 0.1))[positive])
            losses.append(np.log(1.0 + pull * sum(np.exp(24 * weight_n * (1.4 - d))[negative])) / 24)
    return np.mean(losses)


def test_equations_11_and_12_of_the_overlap_aware_circle_loss():
    rng = np.random.default_rng(3)
    f_p, f_q = (torch.nn.functional.normalize(features(n, n), dim=-1) for n in (6, 7))
    overlap = rng.choice([0.0, 0.0, 0.05, 0.2, 0.7], (6, 7))
    distance = np.linalg.norm(array(f_p)[:, None] - array(f_q), axis=2)
    expected = 0.5 * (circle(distance, overlap) + circle(distance.T, overlap.T))
    exist = (torch.ones(1, 6, dtype=torch.bool), torch.ones(1, 7, dtype=torch.bool))
    found = circle_loss(f_p[None], f_q[None], torch.from_numpy(overlap).float()[None], *exist)
    assert float(found) == pytest.approx(expected, rel=1e-4)


def test_equations_13_and_14_of_the_fine_loss_up_to_the_number_of_entries():
    """The paper sums the entries of a patch pair and averages over patch pairs; we average over all entries."""
    z = torch.rand(3, 5, 6, generator=torch.Generator().manual_seed(1))
    matches = {0: [(0, 1), (2, 3)], 1: [(1, 1)], 2: []}  # M_ij
    labels, losses = torch.zeros(3, 5, 6, dtype=torch.bool), []
    for patch, pairs in matches.items():
        lonely_p = [(x, 5) for x in range(4) if x not in {p for p, _ in pairs}]  # I_i, with the dustbin's column
        lonely_q = [(4, y) for y in range(5) if y not in {q for _, q in pairs}]  # J_j
        entries = [*pairs, *lonely_p, *lonely_q]
        losses.append(-sum(float(z[patch, x, y].log()) for x, y in entries))  # eq. (13)
        for x, y in entries:
            labels[patch, x, y] = True
    of_paper = np.mean(losses)  # eq. (14)
    assert float(assignment_loss(z.log(), labels)) == pytest.approx(of_paper * 3 / int(labels.sum()), rel=1e-5)


def test_the_documentation_names_the_check_of_every_equation():
    text = (Path(__file__).parents[3] / "docs" / "concepts" / "network.md").read_text()
    rows = re.findall(r"^\| \((\d+)\) \|.*\| `(\w+)` \|$", text, re.MULTILINE)
    assert [int(number) for number, _ in rows] == list(range(1, 15))
    assert all(re.search(rf"(?<!\d){number}(?!\d)", test) or "to" in test for number, test in rows)
    assert {test for _, test in rows} <= globals().keys()
