"""The exhaustive search, against the same score written down a second time."""

from types import SimpleNamespace

import numpy as np
import pytest
import tiny

from gapr_core.config import SearchConfig, SourceConfig
from gapr_core.geometry import se3
from gapr_core.registration.problem import source as sources
from gapr_core.registration.proposals import search

RNG = np.random.default_rng(3)
WORST = 255


def at(field, point):
    """The field's value in the cell that a point lies in; the worst one outside."""
    cell = np.floor((point - field.origin) / field.cell_mm + 0.5).astype(int)
    return int(field.distance[tuple(cell)]) if ((cell >= 0) & (cell < field.distance.shape)).all() else WORST


def expected(local, anchor, axes, field, first, limit):
    """(lowest mean, its spin) of one anchor: the first probes decide which spins count at all."""
    probes, _, spins = local.shape
    totals = []
    for s in range(spins):
        values = [at(field, anchor + local[k, :, s] @ axes) for k in range(probes)]
        within = first >= probes or sum(values[:first]) <= limit * first
        totals.append(sum(values) if within else WORST * probes)
    return min(totals) / probes, int(np.argmin(totals)) if min(totals) < WORST * probes else 0


@pytest.fixture(scope="module")
def target():
    target = tiny.ellipsoid()
    distance = RNG.integers(0, 256, target.field.nearest.shape).astype(np.uint8)  # so that every cell counts
    return SimpleNamespace(points=target.points, field=SimpleNamespace(**vars(target.field) | {"distance": distance}))


@pytest.mark.parametrize(("first", "limit"), [(3, 110.0), (3, 40.0), (3, 255.0), (8, 100.0), (20, 100.0), (1, 0.0)])
def test_every_anchor_has_the_best_of_the_turns_that_begin_well(target, first, limit):
    local = RNG.uniform(-25.0, 25.0, (8, 3, 5)).astype(np.float32)  # some probes lie outside of the field
    anchors = target.points[::40].astype(np.float32)
    axes = np.stack([se3.random_rotation(RNG) for _ in anchors]).astype(np.float32)
    field = target.field
    corner = (field.origin - 0.5 * field.cell_mm).astype(np.float32)
    score, spin = search._best_spins(
        local, anchors, axes, field.distance, corner, np.float32(1.0 / field.cell_mm), first, np.float32(limit)
    )
    wanted = [expected(local, a, x, field, first, limit) for a, x in zip(anchors, axes, strict=True)]
    assert score == pytest.approx([mean for mean, _ in wanted])
    assert spin.tolist() == [number for _, number in wanted]


def test_the_score_of_a_pose_is_that_of_its_probes(monkeypatch):
    """Turned by its angle, laid on its anchor, facing either way: probe by probe, from the pose alone."""
    target = tiny.ellipsoid(count=300)
    points = tiny.on_ellipsoid(200)
    source = sources.describe(points[points[:, 2] > 0.0], SourceConfig())
    config = SearchConfig(references=2, spins=12, probes=10, first_probes=10, keep=40)
    of_all, score_of = [], search.NormalAlignedSearch._score
    monkeypatch.setattr(
        search.NormalAlignedSearch, "_score", lambda *given: of_all.append(score_of(*given)) or of_all[0]
    )
    found = search.NormalAlignedSearch(config, 1).propose(source, target, RNG)
    assert found.shape == (40, 4, 4)
    probes, off = source.subset(config.probes), []
    for T, score in zip(found, np.sort(of_all[0][0], axis=None)[:40], strict=True):
        assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3)) and np.linalg.det(T[:3, :3]) > 0.0
        off.append(abs(np.mean([at(target.field, p) for p in se3.apply(T, probes)]) - score))
    assert np.median(off) < 1e-3 and max(off) < 40.0  # a probe on the border of two cells may fall into either
