"""The paper's regime, from config/train_paper.yaml to its tables, on networks and lists of the size of a test."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from gapr_core.data.protocols import make_pair
from gapr_core.model.config import ModelConfig
from gapr_core.training import trainer
from gapr_core.training.config import TrainConfig, network_of, read_plan, trained_as
from gapr_core.training.dataset import SampledOnce, TrainingPairs

CONFIG = Path(__file__).parents[3] / "config"


@pytest.fixture(scope="module")
def regime(toy, tmp_path_factory):
    """config/train_paper.yaml as it is but for the sizes."""
    config = TrainConfig.from_yaml(CONFIG / "train_paper.yaml")
    of_paper = yaml.safe_load((CONFIG / "model" / "faithful_small.yaml").read_text())
    small = toy.small_config(superpoints=(10, 20), width=8, global_width=16, train_pairs=6).to_dict()
    path = tmp_path_factory.mktemp("model") / "faithful_small.yaml"
    sizes = {k: list(v) if isinstance(v, tuple) else v for k, v in small.items()}
    path.write_text(yaml.safe_dump({**sizes, **of_paper}))
    return replace(config, model=str(path), bones=("femur",), pairs=8, batch=4, pool=3, validation_pairs=2)


def test_the_yaml_says_what_the_paper_does():
    config = TrainConfig.from_yaml(CONFIG / "train_paper.yaml")
    assert config.mix.keys() == {"paper", "incomplete"}
    assert (config.target_frame, config.source_points) == ("scan", "target")
    assert config.early_loss == 0.0 and config.network().early_features == "plain"


def test_targets_lie_as_they_were_scanned(regime, anatomy):
    pairs = TrainingPairs(regime, regime.network(), anatomy)
    bone = pairs._bone(0)
    assert np.array_equal(bone.turn, np.eye(4))
    turned = TrainingPairs(replace(regime, target_frame="random"), regime.network(), anatomy)._bone(0)
    assert not np.allclose(turned.turn, np.eye(4))
    torch.testing.assert_close(
        turned.target.centre_mm[0], torch.from_numpy(turned.turn[:3, :3]) @ bone.target.centre_mm[0]
    )


def test_rotations_are_those_of_the_paper(regime, anatomy):
    """0 to 180 degrees about each axis: an Euler angle about y beyond 90 turns x and z by 180, so y stays within 90."""
    from scipy.spatial.transform import Rotation

    pairs = TrainingPairs(regime, regime.network(), anatomy)
    turns = np.stack([pairs.pair(number).T[0, :, :3].double().numpy() for number in range(40)])
    first = Rotation.from_matrix(turns.transpose(0, 2, 1)).as_euler("xyz", degrees=True)
    assert (first[:, 1] >= -1e-3).all()  # uniform on SO(3) half of them would be negative


def test_sources_are_cropped_out_of_the_points_of_the_target(regime, anatomy):
    pairs = TrainingPairs(regime, regime.network(), anatomy)
    bone = pairs._bone(0)
    assert isinstance(pairs._seen_by("paper", bone), SampledOnce) and pairs._seen_by("L1", bone) is bone.specimen
    made = make_pair("paper", pairs._seen_by("paper", bone), 1)
    np.testing.assert_allclose(made.target + made.metadata["origin_mm"], bone.points)


def test_a_smoke_training_through_the_yaml_leaves_weights_of_the_paper(regime, anatomy, tmp_path):
    written = trainer.train(regime, tmp_path, anatomy)
    from gapr_core.model import weights

    network, card = weights.load(written)
    assert (network.config.inputs, network.config.global_small_ball) == ("ones", "whole") and card["step"] == 2
    lines = (tmp_path / "log.csv").read_text().splitlines()
    loss, coarse, fine = (float(x) for x in lines[1].split(",")[5:8])
    assert loss == pytest.approx(coarse + fine, rel=1e-3)  # nothing but the paper's loss


def test_the_ablation_in_the_regime_of_the_paper_has_its_network_as_a_row():
    config = TrainConfig.from_yaml(CONFIG / "ablate_paper.yaml")
    plan = read_plan(CONFIG / "ablation_paper.yaml")
    rows = {v.model.stem: network_of(v.model, config.model_settings) for v in plan}
    of_paper = replace(ModelConfig.from_yaml(CONFIG / "model" / "faithful_small.yaml"), name="")
    assert {stem for stem, network in rows.items() if replace(network, name="") == of_paper} == {
        "backbone_kpconv_pga", "cross_pga_repositioning", "transformer_pga",
    }  # fmt: skip
    assert len(set(trained_as(plan, config.model_settings).values())) == 10
    regime = TrainConfig.from_yaml(CONFIG / "train_paper.yaml")
    same = ("target_frame", "source_points", "early_loss")
    assert all(getattr(config, name) == getattr(regime, name) for name in same)
