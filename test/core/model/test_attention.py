from __future__ import annotations

import pytest
import torch
from torch.nn.functional import scaled_dot_product_attention

from gapr_core.model import fused
from gapr_core.model.attention import Attention, VanillaEncoder
from gapr_core.model.encoding import TRANSFORMERS, make_transformer
from gapr_core.model.encoding.gcn import EdgeConv
from gapr_core.model.encoding.geotransformer import _angles
from gapr_core.model.encoding.pga import PGAEncoder
from gapr_core.model.encoding.ppf import point_pair_features
from gapr_core.model.encoding.ptv3 import PATCH, SerialEncoder, local_patches, z_order
from gapr_core.model.encoding.rotary import RotaryEncoder
from gapr_core.model.pairs import LocalPairs, self_pairs
from gapr_core.model.transformer import Nodes

DIM, HEADS = 32, 4


def local(cloud, level=1):
    found = cloud.levels[level]
    return LocalPairs(found, found, found.within)


def dense(batch=2, n=9, valid=None):
    torch.manual_seed(4)
    points, normals = torch.randn(batch, n, 3), torch.nn.functional.normalize(torch.randn(batch, n, 3), dim=-1)
    valid = torch.ones(batch, n, dtype=torch.bool) if valid is None else valid
    return self_pairs(points, normals, valid, points + 0.1 * torch.randn(batch, n, 3), torch.full((batch,), 0.8))


def heads(x):
    return x.unflatten(-1, (HEADS, -1)).transpose(-2, -3)


def test_vanilla_attention_equals_scaled_dot_product_attention():
    layer, pairs = Attention(DIM, HEADS, VanillaEncoder()), dense()
    x = torch.randn(2, 9, DIM)
    expected = scaled_dot_product_attention(heads(layer.query(x)), heads(layer.key(x)), heads(layer.value(x)))
    torch.testing.assert_close(layer(x, x, pairs), expected.transpose(1, 2).flatten(2), atol=1e-5, rtol=1e-4)


def test_local_vanilla_attention_equals_attention_over_each_neighbourhood_alone(clouds):
    pairs, layer = local(clouds[0]), Attention(DIM, HEADS, VanillaEncoder())
    x = torch.randn(len(pairs.index), DIM)
    found = layer(x, x, pairs)
    for i in range(0, len(x), 5):
        near = x[pairs.index[i][pairs.hood.valid[i]]]
        q, k, v = heads(layer.query(x[i : i + 1])), heads(layer.key(near)), heads(layer.value(near))
        expected = scaled_dot_product_attention(q, k, v).transpose(0, 1).flatten()
        torch.testing.assert_close(found[i], expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("in_values", [True, False])
@pytest.mark.parametrize("kind", ["local", "dense"])
def test_the_compiled_loops_of_pga_and_their_gradients_equal_the_hooks(clouds, monkeypatch, kind, in_values):
    valid = torch.ones(2, 9, dtype=torch.bool)
    valid[1, 6:] = False
    pairs = local(clouds[0]) if kind == "local" else dense(valid=valid)
    shape = (len(pairs.index),) if kind == "local" else (2, 9)
    torch.manual_seed(5)
    layer, x, up = Attention(DIM, HEADS, PGAEncoder(DIM, 16, in_values)), torch.randn(*shape, DIM), torch.randn(DIM)
    found = {}
    for way, fits in (("loops", True), ("hooks", False)):
        monkeypatch.setattr(fused, "fits", lambda *given, fits=fits: fits)
        source = x.clone().requires_grad_()
        layer.zero_grad()
        out = layer(source, source.roll(1, -2), pairs)
        (out.tanh() @ up).sum().backward()
        found[way] = [out, source.grad, *(each.grad for each in layer.parameters() if each.grad is not None)]
    assert len(found["loops"]) == len(found["hooks"]) >= 8
    for one, other in zip(found["loops"], found["hooks"], strict=True):
        torch.testing.assert_close(one, other, atol=2e-4, rtol=2e-4)


def test_pga_equals_its_equation_written_out_pair_by_pair():
    """Eq. (2) with r_ij = MLP(l_ij) and W^R as they stand, nothing folded."""
    encoder = PGAEncoder(DIM, 16, in_values=True)
    layer, pairs, x = Attention(DIM, HEADS, encoder), dense(), torch.randn(2, 9, DIM)
    r = encoder.relative.second(encoder.first(pairs.pgf)) + 0.37  # a bias b_2 of the MLP must not matter
    keys = layer.key(x)[:, None] + encoder.relative.to_key(r)  # f_k W^K + r_ij W^R
    values = layer.value(x)[:, None] + encoder.relative.to_value(encoder.first(pairs.pgf))
    q = layer.query(x).unflatten(-1, (HEADS, -1))
    logits = torch.einsum("bihd,bijhd->bhij", q, keys.unflatten(-1, (HEADS, -1))) / (DIM // HEADS) ** 0.5
    out = torch.einsum("bhij,bijhd->bihd", logits.softmax(-1), values.unflatten(-1, (HEADS, -1))).flatten(2)
    torch.testing.assert_close(layer(x, x, pairs), out, atol=1e-5, rtol=1e-4)


def test_padding_changes_no_answer_of_any_encoding(toy):
    torch.manual_seed(1)
    for name in TRANSFORMERS:
        layer = make_transformer(name, DIM, toy.small_config()).eval()
        valid = torch.ones(1, 9, dtype=torch.bool)
        short = dense(1, 9)
        x = torch.randn(1, 14, DIM)
        padded = dense(1, 14, torch.nn.functional.pad(valid, (0, 5)))
        for part in ("p_i", "n_i", "c_k"):
            getattr(padded, part)[:, :9] = getattr(short, part)
        padded.c_h = short.c_h
        torch.testing.assert_close(
            layer(x, x, padded)[:, :9],
            layer(x[:, :9], x[:, :9], short),
            atol=1e-5,
            rtol=1e-4,
            msg=f"{name} saw padding",
        )


def test_rotary_attention_depends_on_relative_position_only():
    encoder, pairs = RotaryEncoder(DIM), dense(1)
    q, k = torch.randn(1, 9, DIM), torch.randn(1, 9, DIM)

    def logits():
        encoding = encoder(pairs)
        return encoding.query(q) @ encoding.key(k).transpose(1, 2)

    before = logits()
    pairs.p_i, pairs.p_j = pairs.p_i + 0.3, pairs.p_j + 0.3
    torch.testing.assert_close(logits(), before, atol=1e-4, rtol=1e-4)
    pairs.p_j = pairs.p_j + 0.3
    assert (logits() - before).abs().max() > 0.01


def test_geotransformer_angles_are_those_at_i_between_its_nearest_neighbour_and_j():
    pairs = dense(1)
    points = pairs.p_i[0, :, 0]
    for i in range(9):
        x = (points - points[i]).norm(dim=1).argsort()[1]
        for j in (j for j in range(9) if j != i):
            cosine = torch.cosine_similarity(points[x] - points[i], points[j] - points[i], dim=0)
            torch.testing.assert_close(_angles(pairs, 0)[0, i, j].cos(), cosine, atol=1e-5, rtol=0)


def test_the_nearest_keys_leave_out_the_query_only_where_it_is_one_of_them(clouds):
    fine, coarse = clouds[0].levels[:2]
    for pairs in (LocalPairs(coarse, coarse, coarse.within), LocalPairs(coarse, fine, coarse.below)):
        order = pairs.distance[:, 0].argsort(stable=True)
        first = pairs.distance[:, 0].gather(1, pairs.nearest(3)[:, 0])[:, 0]
        expected = pairs.distance[:, 0].gather(1, order)[:, 1 if pairs.same else 0]
        assert torch.equal(first, expected) and (first > 0).any()


def test_point_pair_features_of_two_hand_made_points():
    pairs = dense(1, 2)
    pairs.p_i = torch.tensor([[[[0.0, 0, 0]], [[2.0, 0, 0]]]])
    pairs.p_j = pairs.p_i.transpose(1, 2)
    pairs.n_i = torch.tensor([[[[0.0, 0, 1]], [[1.0, 0, 0]]]])
    pairs.n_j, pairs.reach = pairs.n_i.transpose(1, 2), torch.ones(1, 1, 1)
    half = torch.pi / 2
    torch.testing.assert_close(point_pair_features(pairs)[0, 0, 1], torch.tensor([2.0, half, 0.0, half]))


def test_edge_convolution_equals_a_loop_over_the_ten_nearest_points():
    pairs, conv = dense(1, 14), EdgeConv(DIM, DIM)
    x = torch.randn(1, 14, DIM)
    points = pairs.p_i[0, :, 0]
    for i in range(14):
        near = (points - points[i]).norm(dim=1).argsort()[1:11]
        edges = conv.own(x[0, i]) + conv.other(x[0, near])
        expected = torch.nn.functional.leaky_relu(conv.norm(edges), 0.2).amax(0)
        torch.testing.assert_close(conv(x, x, pairs)[0, i], expected, atol=1e-5, rtol=1e-4)


def test_z_order_interleaves_the_bits_of_the_cells():
    cell = torch.tensor([1.0])
    codes = z_order(torch.tensor([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [0.5, 1.5, 0.5], [0.5, 0.5, 1.5]]), cell)
    assert (codes - codes[0]).tolist() == [0, 1, 2, 4]


def test_serialised_patches_hold_the_point_itself_and_never_another_cloud(clouds):
    from gapr_core.model.types import collate

    pairs = local(collate([clouds[0], clouds[1]]), 0)
    index, first = local_patches(pairs), len(clouds[0].levels[0].points)
    assert index.shape == (len(pairs.index), PATCH)
    assert (index == torch.arange(len(index))[:, None]).any(1).all()
    assert index[:first].max() < first and index[first:].min() >= first


def test_dense_serialised_attention_sees_its_patch_only():
    pairs = dense(1, 3 * PATCH)
    same = SerialEncoder()(pairs).same[0]
    assert (same.sum(1) == PATCH).all() and torch.equal(same, same.T)


def test_the_pgf_of_a_batch_is_made_once_for_all_layers(clouds):
    pairs = Nodes.of(clouds[0]).look_at_self()
    assert pairs.pgf is pairs.pgf and not pairs.pgf.requires_grad
