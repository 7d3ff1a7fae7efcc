from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import save_file

from gapr_core.errors import ConfigError, WeightsError
from gapr_core.geometry import se3
from gapr_core.model import weights
from gapr_core.model.config import ModelConfig
from gapr_core.model.encoding import TRANSFORMERS, ptv3
from gapr_core.model.network import GAPRNet
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.model.types import collate
from gapr_core.runtime.origin import WEIGHTS
from gapr_core.training import export
from gapr_core.training.losses import compute_losses
from gapr_core.training.targets import join, training_pair

YAMLS = sorted((Path(__file__).parents[3] / "config" / "model").glob("*.yaml"))
ABLATIONS = Path(__file__).parents[3] / "config" / "ablation.yaml"


def tiny(path: Path, toy) -> ModelConfig:
    """The yaml's variant at the size of a test; all that the yaml says but sizes stays."""
    named = ModelConfig.from_yaml(path)
    sizes = toy.small_config()
    return replace(
        sizes,
        **{
            key: getattr(named, key)
            for key in (
                "name",
                "inputs",
                "backbone",
                "kernel_frame",
                "encoding",
                "values_encoded",
                "final_cross",
                "repositioning",
                "fine_scores",
                "norm",
                "mlp_projections",
                "pair_width",
                "coarse_temperature",
                "fine_stage",
                "global_small_ball",
                "early_features",
            )
        },
    )


def network(config, seed=0):
    torch.manual_seed(seed)
    return GAPRNet(config)


def test_weights_of_earlier_settings_load_where_these_changed_no_match(toy, tmp_path):
    """The shipped file has a head whose scores are not used. Where they were, the network is another one."""
    config = toy.small_config()
    net = network(config)
    tensors = {**net.state_dict(), "bone_head.layers.0.bias": torch.zeros(3)}

    def written(**earlier):
        settings = json.dumps(config.to_dict() | earlier)
        header = {"format": weights.FORMAT, "config": settings, "sha256": weights.checksum(tensors)}
        save_file(tensors, tmp_path / "w.safetensors", metadata=header)
        return tmp_path / "w.safetensors"

    again, _ = weights.load(written(bone_head="mlp", bone_scores=False, centred_features=False))
    assert again.config == config and all(torch.equal(t, tensors[name]) for name, t in again.state_dict().items())
    for changed in ({"bone_scores": True}, {"centred_features": True}):
        with pytest.raises(WeightsError, match="fit their configuration"):
            weights.load(written(bone_head="mlp", **changed))


def test_there_is_a_yaml_for_every_variant_of_the_ablations_and_each_is_named_after_its_file():
    compared = {row["model"] for rows in yaml.safe_load(ABLATIONS.read_text()).values() for row in rows}
    assert {"best", "faithful"} <= {p.stem for p in YAMLS} and compared <= {p.stem for p in YAMLS}
    assert all(ModelConfig.from_yaml(p).name == p.stem for p in YAMLS)


@pytest.mark.parametrize("name", TRANSFORMERS)
def test_every_encoding_learns_from_a_pair(name, toy):
    config = toy.small_config(encoding=name)
    net, example = network(config), toy.pair(config)
    losses, _ = compute_losses(net, example, torch.Generator().manual_seed(0))
    losses.total.backward()
    assert torch.isfinite(losses.total)
    assert [n for n, p in net.named_parameters() if p.grad is None or not p.grad.abs().max() > 0] == []


@pytest.mark.parametrize("path", YAMLS, ids=lambda p: p.stem)
def test_every_variant_runs_forward_and_backward_and_reloads_bit_by_bit(path, toy, tmp_path):
    GAPRNet(ModelConfig.from_yaml(path))  # builds at its own size
    config = tiny(path, toy)
    net, example = network(config), toy.pair(config)
    losses, _ = compute_losses(net, example, torch.Generator().manual_seed(0))
    losses.total.backward()
    without = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert without == [] and torch.isfinite(losses.total)
    weights.save(net, tmp_path / "w.safetensors", {"data": "toy"})
    again, card = weights.load(tmp_path / "w.safetensors")
    with torch.inference_mode():
        first, second = net.eval()(example.source, example.target), again(example.source, example.target)
    assert card == {"data": "toy"} and again.config == config
    assert all(torch.equal(a, b) for a, b in zip(net.parameters(), again.parameters(), strict=True))
    assert torch.equal(first.coarse, second.coarse) and torch.equal(first.matches.score, second.matches.score)
    assert first.matches.score.isfinite().all()


def moved_deviation(config, toy) -> float:
    """Largest change of a superpoint score when both clouds are moved, each by its own motion."""
    frame, net = target_frame(toy.bone(), config), network(config).eval()
    source, target = toy.view(toy.bone(700, 1)), toy.bone()
    with torch.inference_mode():
        before, after = (
            net(*(build_cloud(se3.apply(T, c), frame, config) for T, c in zip(motions, (source, target), strict=True)))
            for motions in ((np.eye(4), np.eye(4)), (toy.motion(7), toy.motion(8)))
        )
    return float((before.coarse.exp() - after.coarse.exp()).abs().max() / before.coarse.exp().max())


def test_moving_either_cloud_moves_the_answer_in_the_invariant_configuration(toy):
    config = toy.small_config()
    assert moved_deviation(config, toy) < 1e-4
    frame, net, T = target_frame(toy.bone(), config), network(config).eval(), toy.motion(7)
    source, target = toy.view(toy.bone(700, 1)), build_cloud(toy.bone(), frame, config)
    with torch.inference_mode():
        still = net(build_cloud(source, frame, config), target).matches
        moved = net(build_cloud(se3.apply(T, source), frame, config), target).matches
    assert torch.equal(still.patch, moved.patch) and torch.equal(still.target, moved.target)
    R = torch.from_numpy(T[:3, :3]).float()
    torch.testing.assert_close(still.source @ R.T, moved.source, atol=1e-4, rtol=0)
    torch.testing.assert_close(still.score, moved.score, atol=1e-4, rtol=1e-3)


def test_the_faithful_configuration_is_not_invariant_and_a_mirrored_cloud_is_another_one(toy):
    faithful = tiny(next(p for p in YAMLS if p.stem == "faithful"), toy)
    assert moved_deviation(faithful, toy) > 1e-3
    config = toy.small_config()
    frame, net = target_frame(toy.bone(), config), network(config).eval()
    with torch.inference_mode():
        left, right = (
            net.backbone(build_cloud(toy.bone() * side, frame, config)).coarse for side in ([1, 1, 1], [-1, 1, 1])
        )
    gap = torch.cdist(left, right).amin(1)  # every superpoint against its best mirrored one
    assert gap.median() > 0.01 * torch.cdist(left, left).median()


@pytest.mark.parametrize("path", YAMLS, ids=lambda p: p.stem)
def test_clouds_of_unequal_sizes_in_a_batch_have_finite_losses_and_gradients(path, toy, monkeypatch):
    monkeypatch.setattr(ptv3, "PATCH", 4)  # as the real clouds have, several patches and padding that fills some
    config = tiny(path, toy)
    net = network(config)
    batch = join([toy.pair(config, seed, share) for seed, share in ((3, 0.5), (4, 0.9))])
    losses, _ = compute_losses(net, batch, torch.Generator().manual_seed(0))
    losses.total.backward()
    assert torch.isfinite(losses.total)
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


def test_a_batch_gives_each_pair_what_it_gets_alone(toy):
    config = toy.small_config()
    net, pairs = network(config).eval(), [toy.pair(config, 3), toy.pair(config, 4, 0.15), toy.pair(config, 5, 0.3)]
    with torch.inference_mode():
        batch = net(collate([p.source for p in pairs]), collate([p.target for p in pairs]))
        for b, p in enumerate(pairs):
            alone = net(p.source, p.target)
            n, m = alone.coarse.shape[1:]
            torch.testing.assert_close(batch.coarse[b, :n, :m], alone.coarse[0], atol=1e-3, rtol=1e-3)
            assert abs(int((batch.matches.pair == b).sum()) - len(alone.matches.score)) <= 2


def test_the_features_of_a_target_may_be_given(toy):
    config = toy.small_config()
    net, p = network(config).eval(), toy.pair(config)
    with torch.inference_mode():
        kept = net.backbone(p.target)
        assert torch.equal(net(p.source, p.target, kept).coarse, net(p.source, p.target).coarse)


@pytest.mark.parametrize("name", ["sixteen points", "a line", "a plane", "two clumps", "one far outlier"])
@pytest.mark.parametrize(
    "stem", ["best", "faithful", "transformer_geotransformer", "transformer_gcn", "transformer_ptv3"]
)
def test_small_and_degenerate_sources_give_finite_answers(stem, name, toy):
    rng = np.random.default_rng(0)
    source = {
        "sixteen points": toy.bone()[:16],
        "a line": np.outer(np.linspace(-80, 80, 60), [1.0, 0.5, 0.2]),
        "a plane": rng.uniform(-40, 40, (100, 3)) * [1, 1, 0],
        "two clumps": rng.normal(size=(40, 3)) + 60 * (np.arange(40) % 2)[:, None],
        "one far outlier": np.vstack([toy.view(toy.bone()), [[300.0, 0, 0]]]),
    }[name]
    config = tiny(next(p for p in YAMLS if p.stem == stem), toy)
    frame = target_frame(toy.bone(), config)
    example = training_pair(
        build_cloud(source, frame, config), build_cloud(toy.bone(), frame, config), np.eye(4), frame
    )
    net = network(config)
    losses, _ = compute_losses(net, example, torch.Generator().manual_seed(0))
    losses.total.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in net.parameters())
    with torch.inference_mode():
        matches = net.eval()(example.source, example.target).matches
    assert matches.score.isfinite().all() and matches.source.isfinite().all()


def test_autocast_stays_finite_and_close(toy):
    config = toy.small_config()
    net, p = network(config).eval(), toy.pair(config)
    with torch.inference_mode():
        full = net(p.source, p.target).coarse.exp()
        with torch.autocast("cpu", torch.bfloat16):
            half = net(p.source, p.target)
    assert half.matches.score.isfinite().all()
    assert torch.corrcoef(torch.stack([full.flatten(), half.coarse.exp().flatten()]))[0, 1] > 0.9


def test_a_batch_trains_like_its_pairs(toy):
    config = toy.small_config()
    net, pairs = network(config), [toy.pair(config, 3), toy.pair(config, 5)]
    losses, _ = compute_losses(net, join(pairs), torch.Generator().manual_seed(0))
    alone = [compute_losses(net, p, torch.Generator().manual_seed(0))[0].coarse for p in pairs]
    assert min(alone) * 0.99 <= losses.coarse <= max(alone) * 1.01


@pytest.mark.parametrize("stages", [3, 5])
def test_networks_of_fewer_or_more_stages_run_with_either_kind_of_inputs(stages, toy):
    for inputs in ("ones", "invariant"):
        config = toy.small_config(stages=stages, neighbors=(10,) * stages, inputs=inputs)
        p = toy.pair(config)
        with torch.inference_mode():
            assert network(config).eval()(p.source, p.target).matches.score.isfinite().all()


def test_unknown_keys_and_options_are_named():
    with pytest.raises(ConfigError, match="widht"):
        ModelConfig.from_dict({"widht": 3})
    with pytest.raises(ConfigError, match="encoding"):
        GAPRNet(ModelConfig(encoding="magic"))
    with pytest.raises(ConfigError, match="neighbors"):
        ModelConfig(neighbors=(3, 3))


def test_missing_damaged_and_foreign_weights_are_refused(toy, tmp_path):
    path = tmp_path / "w.safetensors"
    with pytest.raises(WeightsError):
        weights.load(path)
    digest = weights.save(network(toy.small_config()), path)
    assert len(digest) == 64
    raw = bytearray(path.read_bytes())
    raw[-5] ^= 0xFF
    path.write_bytes(raw)
    with pytest.raises(WeightsError, match="checksum"):
        weights.load(path)
    path.write_bytes(raw[:100])
    with pytest.raises(WeightsError):
        weights.load(path)


@pytest.mark.parametrize(("entry", "said", "other"), [("config", "0.", "1."), ("card", "a card", "b card")])
def test_the_signature_of_weights_covers_their_configuration_and_card(toy, tmp_path, entry, said, other):
    path = tmp_path / "w.safetensors"
    weights.save(network(toy.small_config()), path, {"of": "a card"})
    header, tensors = weights._read(path)
    assert said in header[entry]
    save_file(tensors, str(path), metadata=header | {entry: header[entry].replace(said, other, 1)})
    with pytest.raises(WeightsError, match="checksum"):
        weights.load(path)


def test_an_older_file_is_signed_again_with_the_same_tensors_as_the_shipped_one_is(toy, tmp_path):
    path, again = tmp_path / "w.safetensors", tmp_path / "again.safetensors"
    weights.save(network(toy.small_config()), path, {"of": "a card"})
    header, tensors = weights._read(path)
    unsigned = {key: value for key, value in header.items() if key != "signature"}
    save_file(tensors, str(path), metadata=unsigned)
    assert export.main([str(path), "--out", str(again)]) == 0
    assert weights._read(again)[0] == header and weights.checksum(weights._read(again)[1]) == header["sha256"]
    assert "signature" in weights._read(WEIGHTS / "gapr_net.safetensors")[0]


@pytest.mark.parametrize("entry", ["config", "card"])
def test_weights_with_a_damaged_header_are_refused_as_weights(toy, tmp_path, entry):
    path = tmp_path / "w.safetensors"
    weights.save(network(toy.small_config()), path)
    header, tensors = weights._read(path)
    del header["signature"]  # as of an older file
    save_file(tensors, str(path), metadata=header | {entry: "{no json"})
    with pytest.raises(WeightsError, match="fit their configuration"):
        weights.load(path)


def test_float16_weights_are_half_the_size_and_answer_alike(toy, tmp_path):
    config = toy.small_config()
    net, p = network(config).eval(), toy.pair(config)
    weights.save(net, tmp_path / "full.safetensors")
    weights.save(net, tmp_path / "half.safetensors", dtype=torch.float16)
    assert (tmp_path / "half.safetensors").stat().st_size < 0.65 * (tmp_path / "full.safetensors").stat().st_size
    with torch.inference_mode():
        full, half = (n(p.source, p.target).coarse.exp() for n in (net, weights.load(tmp_path / "half.safetensors")[0]))
    torch.testing.assert_close(full, half, atol=0.02, rtol=0.1)
