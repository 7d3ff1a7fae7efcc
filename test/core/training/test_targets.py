from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gapr_core.geometry import se3
from gapr_core.model.pyramid import Frame
from gapr_core.training.targets import fine_labels, join, to_units, training_pair, true_patch_pairs


@pytest.fixture(scope="module")
def pair(toy, config):
    return toy.pair(config)


def test_the_motion_in_units_equals_the_motion_in_millimetres(pair, toy):
    T = se3.inverse(toy.motion(3))
    units = to_units(T, pair.source, pair.target)
    p = pair.source.fine.points.double().numpy()
    scale, c_p, c_q = (x.numpy()[0] for x in (pair.source.scale_mm, pair.source.centre_mm, pair.target.centre_mm))
    np.testing.assert_allclose(se3.apply(units, p) * scale + c_q, se3.apply(T, p * scale + c_p), atol=1e-6)


def test_overlaps_equal_a_loop_over_every_two_patches(pair):
    T = np.vstack([pair.T[0].double().numpy(), [0, 0, 0, 1]])
    p, q = se3.apply(T, pair.source.fine.points.numpy()), pair.target.fine.points.double().numpy()
    for i in range(0, len(pair.source.patches), 3):
        a = p[pair.source.patches[i][pair.source.patches_valid[i]].numpy()]
        for j in range(len(pair.target.patches)):
            b = q[pair.target.patches[j][pair.target.patches_valid[j]].numpy()]
            near = np.linalg.norm(a[:, None] - b, axis=2) <= float(pair.radius[0])
            expected = 0.5 * (near.any(1).mean() + near.any(0).mean()) if near.size else 0.0
            assert np.isclose(float(pair.overlaps[0, i, j]), expected, atol=1e-6)


def test_a_cloud_overlaps_itself_patch_by_patch(pair):
    fine = Frame(float(pair.target.scale_mm[0]), 5e-7)  # no two points match
    overlaps = training_pair(pair.target, pair.target, np.eye(4), fine).overlaps[0].numpy()
    filled = pair.target.patches_valid.any(1).numpy()
    np.testing.assert_allclose(overlaps, np.diag(filled.astype(float)))


def test_drawn_patch_pairs_overlap_and_are_rows_of_the_batch(pair):
    batch = join([pair, pair])
    chosen = true_patch_pairs(batch, 5, torch.Generator().manual_seed(0))
    assert len(chosen) == 10 and (chosen.score > 0.1).all() and chosen.pair.tolist() == [0] * 5 + [1] * 5
    n, m = pair.overlaps.shape[1:]
    rows, columns = chosen.source - n * chosen.pair, chosen.target - m * chosen.pair
    torch.testing.assert_close(pair.overlaps[0, rows, columns], chosen.score)


def test_fine_labels_of_a_hand_made_patch(pair):
    """Three source and two target points on a line; only the first two source points have a partner."""
    p, q = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]]), torch.tensor([[0.1, 0, 0], [1.1, 0, 0]])

    def with_points(cloud, points):
        return replace(cloud, levels=(replace(cloud.levels[0], points=points), *cloud.levels[1:]))

    made = replace(
        pair,
        source=with_points(pair.source, p),
        target=with_points(pair.target, q),
        T=torch.eye(3, 4)[None],
        radius=torch.tensor([0.5]),
    )
    ones = torch.ones(1, 3, dtype=torch.bool)
    labels = fine_labels(
        made, torch.arange(3)[None], torch.arange(2)[None], ones, ones[:, :2], torch.zeros(1, dtype=torch.long)
    )
    assert labels[0].int().tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]]
    masked = ones.clone()
    masked[0, 2] = False
    labels = fine_labels(
        made, torch.arange(3)[None], torch.arange(2)[None], masked, ones[:, :2], torch.zeros(1, dtype=torch.long)
    )
    assert labels[0, 2].sum() == 0
