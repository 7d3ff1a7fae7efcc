from __future__ import annotations

import pytest
import torch

from gapr_core.model.export import Flat, leaves, with_leaves
from gapr_core.model.network import GAPRNet
from gapr_core.model.pyramid import build_cloud, target_frame


@pytest.fixture(scope="module")
def config(toy):
    """Two stages: exporting takes seconds for each."""
    return toy.small_config(stages=2, neighbors=(10, 10))


@pytest.fixture(scope="module")
def cloud(config, toy):
    return build_cloud(toy.view(toy.bone(700, 1)), target_frame(toy.bone(), config), config)


@pytest.fixture(scope="module")
def network(config) -> GAPRNet:
    torch.manual_seed(0)
    return GAPRNet(config).eval()


def test_a_cloud_is_the_same_after_being_taken_apart_and_put_together(cloud, network):
    again = with_leaves(cloud, iter(leaves(cloud)))
    assert again.coarse.lengths == cloud.coarse.lengths and again.levels[0].below is None
    with torch.inference_mode():
        assert torch.equal(network.backbone(again).coarse, network.backbone(cloud).coarse)


@pytest.mark.slow
def test_the_backbone_exports_and_its_program_answers_alike_after_a_reload(cloud, network, tmp_path):
    flat = Flat(network.backbone, cloud)
    with torch.no_grad():
        program = torch.export.export(flat, tuple(flat.example), strict=False)
        torch.export.save(program, tmp_path / "backbone.pt2")
        answer = torch.export.load(tmp_path / "backbone.pt2").module()(*flat.example)
        moved = [x + 0.1 * torch.randn_like(x) if x.dtype == torch.float32 else x for x in flat.example]
        others = program.module()(*moved)
        for found, expected in zip([*answer, *others], [*flat(*flat.example), *flat(*moved)], strict=True):
            torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)
