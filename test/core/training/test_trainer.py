from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from gapr_core.data import protocols
from gapr_core.errors import ConfigError, WeightsError
from gapr_core.model import weights
from gapr_core.model.config import ModelConfig
from gapr_core.model.types import mapped
from gapr_core.runtime import files
from gapr_core.runtime.settings import load
from gapr_core.surface import Surface
from gapr_core.training import batches, curves, distributed, provenance, start, trainer, validation
from gapr_core.training.config import TrainConfig
from gapr_core.training.dataset import TrainingPairs, prune
from gapr_core.training.shapes import ShapeModel, vary

REPOSITORY = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def settings(toy, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "toy.yaml"
    small = toy.small_config(superpoints=(10, 20), width=8, global_width=16, train_pairs=6)
    path.write_text(yaml.safe_dump({k: list(v) if isinstance(v, tuple) else v for k, v in small.to_dict().items()}))
    return TrainConfig(
        model=str(path),
        bones=("femur",),
        mix={"L1": 1.0, "paper": 1.0},
        pairs=12,
        batch=4,
        micro_batch=2,
        pool=3,
        validation_pairs=1,
        warmup=0.2,
        checkpoint_minutes=0.0,
        validate_minutes=1e9,
    )


def test_a_pair_is_a_function_of_its_number(settings, anatomy, toy):
    model = ModelConfig.from_yaml(settings.model)
    first, second = TrainingPairs(settings, model, anatomy), TrainingPairs(settings, model, anatomy)
    second.pair(0)  # another history
    a, b = first.pair(7), second.pair(7)
    assert torch.equal(a.source.fine.points, b.source.fine.points) and torch.equal(a.overlaps, b.overlaps)
    assert not torch.equal(a.T, first.pair(8).T)


def test_training_pairs_are_registered_by_their_truth(settings, anatomy):
    """Under the true motion nearly every source point of the clean protocol lies on the target."""
    from gapr_core.model.repositioning import move

    pairs = TrainingPairs(replace(settings, mix={"L1": 1.0}), ModelConfig.from_yaml(settings.model), anatomy)
    for number in range(3):
        pair = pairs.pair(number)
        moved = move(pair.T, pair.source.fine.points[None])[0]
        gap = torch.cdist(moved, pair.target.fine.points).amin(1)
        assert gap.median() < 0.1 and pair.overlaps.max() > 0.3


def test_the_first_part_of_a_schedule_can_see_coarse_clouds(settings, anatomy):
    """The bones that come in first have fewer superpoints, those after them as many as ever."""
    train = replace(settings, mix={"incomplete": 1.0}, pairs=1000, coarse_first=0.5)
    model = replace(settings.network(), superpoints=(40, 60))
    pairs, plain = (TrainingPairs(of, model, anatomy) for of in (train, replace(train, coarse_first=0.0)))
    early, late = ([len(of.pair(n).target.coarse.points) for of in (pairs, plain)] for n in (0, 990))
    assert early[0] < 0.8 * early[1] and late[0] == late[1]


@pytest.mark.parametrize("pool", [3, 8, 128])
def test_processes_that_take_micro_batches_in_turn_share_no_bone_and_all_bones_get_their_share(settings, pool):
    """Every process would draw every bone otherwise. All kinds of bones come in each micro-batch's turn."""
    train = replace(settings, pool=pool, micro_batch=4, reuse=16, share=2, bones=("femur", "tibia"))
    pairs = TrainingPairs(train, settings.network(), None)
    numbers = [[pairs._bone_number(4 * batch + i) for i in range(4)] for batch in range(1600)]
    for processes in (2, 4):
        own = [{bone for batch in numbers[rank::processes] for bone in batch} for rank in range(processes)]
        assert not any(first & second for first, second in combinations(own, 2))
    bones = [bone for batch in numbers for bone in batch]
    used = np.bincount(bones)[2 * pool : 380]
    assert used.mean() == pytest.approx(16.0, rel=0.1) and used.min() > 0
    assert all(bone - number // 16 < pool + 4 for number, bone in enumerate(bones))
    for lane in range(4):
        kinds = np.array([bone // 4 % 2 for batch in numbers[lane::4] for bone in batch])
        assert kinds.mean() == pytest.approx(0.5, abs=0.1)


def test_validation_draws_again_where_a_source_is_too_large_for_the_network(settings, anatomy, monkeypatch):
    """A camera sees far more than the bone in many wounds; one such draw ended a run before its first step."""
    model = ModelConfig.from_yaml(settings.model)
    seeds = []

    def large_at_first(protocol, specimen, seed):
        seeds.append(seed)
        pair = protocols.make_pair(protocol, specimen, seed)
        return replace(pair, source=pair.source * 20.0) if len(seeds) == 1 else pair

    monkeypatch.setattr(validation, "make_pair", large_at_first)
    found = validation.validation_set(replace(settings, mix={"L1": 1.0}), model, anatomy)
    assert [v.protocol for v in found] == ["L1"] and len(seeds) == 2 and seeds[0] != seeds[1]


def test_everybody_of_a_bone_has_a_turn_in_the_validation_and_each_protocol_begins_with_another_one(
    settings, anatomy, monkeypatch
):
    """Bones take turns; p5 and p6 are in split val."""
    seen = []

    def heard(protocol, specimen, seed):
        seen.append((protocol, specimen.bone, specimen.person))
        return protocols.make_pair(protocol, specimen, seed)

    monkeypatch.setattr(validation, "make_pair", heard)
    train = replace(settings, mix={"L1": 1.0, "L2": 1.0}, bones=("femur", "tibia"), validation_pairs=4)
    validation.validation_set(train, ModelConfig.from_yaml(settings.model), anatomy)
    order = dict.fromkeys(seen)  # a pair that the network cannot see is made again
    femurs = [(protocol, person) for protocol, bone, person in order if bone == "femur"]
    assert femurs == [("L1", "p5"), ("L1", "p6"), ("L2", "p6"), ("L2", "p5")]
    tibias = {protocol: [who for p, bone, who in order if (p, bone) == (protocol, "tibia")] for protocol in train.mix}
    assert len(set(tibias["L1"])) == 2 and tibias["L2"][0] == tibias["L1"][1]


def test_a_validated_pose_agrees_with_what_lies_within_one_and_a_half_matching_radii(settings, anatomy, monkeypatch):
    model = ModelConfig.from_yaml(settings.model)
    (v,) = validation.validation_set(replace(settings, mix={"L1": 1.0}), model, anatomy)
    propose, radii_mm = validation.local_to_global, []
    monkeypatch.setattr(validation, "local_to_global", lambda found, mm: (radii_mm.append(mm), propose(found, mm))[1])
    validation.validate(trainer.GAPRNet(model), [v], torch.device("cpu"))
    unit_mm = float(v.pair.source.scale_mm[0])
    assert radii_mm == [pytest.approx(1.5 * float(v.pair.radius[0]) * unit_mm)]


def only(folder, **people):
    """A folder with the same meshes and another splits.json."""
    folder.mkdir()
    (folder / "splits.json").write_text(json.dumps({"train": [], "val": [], "test": [], **people}))
    return folder


def test_a_bone_without_a_subject_of_val_is_left_out_of_the_validation(settings, anatomy, tmp_path):
    own = only(tmp_path / "own", train=[f"p{i}" for i in range(9)])
    shutil.copy(anatomy / "femur_toy.npz", own)
    model, train = ModelConfig.from_yaml(settings.model), replace(settings, mix={"L1": 1.0}, validation_pairs=2)
    two = replace(train, bones=("femur", "tibia"))
    assert [v.bone for v in validation.validation_set(two, model, own)] == ["tibia", "tibia"]  # the parametric one
    with pytest.raises(ConfigError, match=r"split val with femur; got none in .*own; move some subjects to val"):
        validation.validation_set(train, model, own)
    assert validation.validation_set(replace(train, validation_pairs=0), model, own) == []


def test_a_run_that_was_refused_leaves_its_folder_to_the_next_one(settings, anatomy, tmp_path):
    with pytest.raises(WeightsError):
        trainer.train(replace(settings, initial=str(tmp_path / "nowhere.safetensors")), tmp_path / "run", anatomy)
    assert not (tmp_path / "run").exists()
    trainer.train(settings, tmp_path / "run", anatomy, minutes=0.0)
    with pytest.raises(ConfigError, match="begun"):
        trainer.train(replace(settings, seed=1), tmp_path / "run", anatomy)


def test_a_run_that_another_process_trains_is_refused(settings, anatomy, tmp_path):
    with files.alone_in(tmp_path / "run"), pytest.raises(ConfigError, match="another process"):
        trainer.train(settings, tmp_path / "run", anatomy)


@pytest.mark.parametrize(("change", "said"), [
    ({"pairs": 3}, "a batch of 4 or more; got 3 pairs; raise --pairs"),
    ({"bones": ("femur", "horn")}, "a parametric model of horn; got neither; leave it out of `bones`"),
    ({"mix": {"L1-far10": 1.0}}, "L1-far10"),  # points far away: the network never sees such a pair
    *[({"mix": mix}, "mix of the protocols") for mix in ({"L9": 1.0}, {"wrong": 1.0}, {"L1": 0.0})],
])  # fmt: skip
def test_a_run_that_cannot_be_is_refused_and_leaves_no_folder(settings, anatomy, tmp_path, change, said):
    with pytest.raises(ConfigError, match=said):
        trainer.train(replace(settings, **change), tmp_path / "run", anatomy)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("make", "said"), [
    (lambda: TrainConfig(bones=()), "bones to train on; got none"),
    (lambda: TrainConfig.from_dict({"lerning_rate": 1}), "lerning_rate"),
    (lambda: distributed.Group(0, 3, torch.device("cpu")).share(8, 2), "2 x 3"),
])  # fmt: skip
def test_settings_that_cannot_be_are_refused(make, said):
    assert distributed.Group(0, 2, torch.device("cpu")).share(8, 2) == 2
    with pytest.raises(ConfigError, match=said):
        make()


def test_a_resumed_run_equals_an_uninterrupted_one_bit_by_bit(settings, anatomy, tmp_path):
    whole = trainer.train(settings, tmp_path / "whole", anatomy)
    for _ in range(3):
        parts = trainer.train(settings, tmp_path / "parts", anatomy, minutes=0.0)  # one step per call
    first, second = weights.load(whole)[0], weights.load(parts)[0]
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
    logs = [list(csv.DictReader((tmp_path / name / "log.csv").open())) for name in ("whole", "parts")]
    assert [r["loss"] for r in logs[0]] == [r["loss"] for r in logs[1]] and len(logs[0]) == 3
    assert {r["protocol"] for r in csv.DictReader((tmp_path / "whole" / "validation.csv").open())} == {
        "L1",
        "paper",
        "all",
    }
    with pytest.raises(ConfigError, match="begun"):
        trainer.train(replace(settings, seed=1), tmp_path / "whole", anatomy)


@pytest.mark.parametrize("left", ["none", "cut", "of an earlier step"])
def test_a_finished_run_that_was_killed_before_its_weights_gets_them(settings, anatomy, tmp_path, left):
    run = tmp_path / "run"
    trainer.train(settings, run, anatomy, minutes=0.0)
    earlier = (run / "weights.safetensors").read_bytes()
    whole = trainer.train(settings, run, anatomy)
    wanted, log = weights.load(whole)[0], (run / "log.csv").read_bytes()
    whole.write_bytes(earlier if left == "of an earlier step" else whole.read_bytes()[:-100])
    if left == "none":
        whole.unlink()
    found, card = weights.load(trainer.train(settings, run, anatomy))
    assert all(torch.equal(a, b) for a, b in zip(wanted.parameters(), found.parameters(), strict=True))
    assert card["step"] == 3 and card["subjects"] > 0 and (run / "log.csv").read_bytes() == log
    before = whole.read_bytes()
    assert trainer.train(settings, run, anatomy).read_bytes() == before


def test_a_run_can_begin_with_the_weights_of_another_one(settings, anatomy, tmp_path):
    first = trainer.train(replace(settings, pairs=4), tmp_path / "first", anatomy)
    going_on = replace(settings, initial=str(first), learning_rate=1e-12, ema=0.0, pairs=4)
    second = trainer.train(going_on, tmp_path / "second", anatomy)
    before, after = weights.load(first)[0], weights.load(second)[0]
    for a, b in zip(before.parameters(), after.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=1e-6)
    provenance = json.loads((tmp_path / "second" / "provenance.json").read_text())
    assert len(provenance[0]["initial"]) == 16

    wider = yaml.safe_load(Path(settings.model).read_text()) | {"width": 16}
    (tmp_path / "wider.yaml").write_text(yaml.safe_dump(wider))
    with pytest.raises(ConfigError, match="initial weights"):
        trainer.train(replace(going_on, model=str(tmp_path / "wider.yaml")), tmp_path / "third", anatomy)


def test_a_training_can_begin_with_the_shipped_weights():
    shipped = REPOSITORY / "gapr_core/weights/gapr_net.safetensors"
    config = load(TrainConfig, REPOSITORY / "config/train.yaml", [f"initial={shipped}"])
    begun, before = start.begin(config, config.network()).state_dict(), weights.load(shipped)[0].state_dict()
    assert all(torch.equal(tensor, before[tensor_name]) for tensor_name, tensor in begun.items())


def test_a_run_whose_gradients_are_never_finite_ends_with_an_error(settings, anatomy, tmp_path, monkeypatch):
    compute = trainer.compute_losses

    def spoilt(*arguments):
        losses, *rest = compute(*arguments)
        return replace(losses, coarse=losses.coarse * float("nan")), *rest

    monkeypatch.setattr(trainer, "compute_losses", spoilt)
    with pytest.raises(FloatingPointError, match="10 steps in a row"):
        trainer.train(replace(settings, pairs=48), tmp_path / "run", anatomy)


@pytest.fixture
def run(settings, anatomy, tmp_path):
    """A run before its first step, its gradients all 0.01."""
    made = trainer.Run(replace(settings, validation_pairs=0), tmp_path / "run", anatomy, distributed.start("cpu"), {})
    made.optimizer.param_groups[0]["lr"] = 0.01
    for parameter in made.network.parameters():
        parameter.grad = torch.full_like(parameter, 0.01)
    return made


def values(network):
    return torch.cat([parameter.detach().flatten() for parameter in network.parameters()]).clone()


def test_the_first_steps_hardly_count_the_weights_that_the_run_began_with(run):
    """Of step s, from 0 on, the average keeps (1 + s) / (10 + s), until that is more than `ema`."""
    begun = values(run.network)
    run._move(0)
    first = values(run.network)
    assert not torch.equal(first, begun)
    torch.testing.assert_close(values(run.ema), 0.1 * begun + 0.9 * first)
    before = values(run.ema)
    run._move(10**6)
    ema = run.config.ema
    torch.testing.assert_close(values(run.ema), ema * before + (1.0 - ema) * values(run.network))


def test_a_step_whose_gradients_are_not_finite_changes_no_weight_and_the_next_one_does(run):
    before = values(run.network)
    next(run.network.parameters()).grad[0] = float("inf")
    run._move(0)
    assert torch.equal(values(run.network), before) and run.lost == 1
    for parameter in run.network.parameters():
        parameter.grad = torch.full_like(parameter, 0.01)
    run._move(1)
    assert torch.isfinite(values(run.network)).all() and not torch.equal(values(run.network), before) and not run.lost


def test_every_micro_batch_draws_its_patches_by_a_seed_of_its_own(settings, anatomy, tmp_path, monkeypatch):
    """By its number in the run, on from where the run stopped: 4 of them, two to a step."""
    compute, seeds = trainer.compute_losses, []

    def heard(network, pair, generator, *more):
        seeds.append(generator.initial_seed())
        return compute(network, pair, generator, *more)

    monkeypatch.setattr(trainer, "compute_losses", heard)
    for _ in range(2):  # one step a call
        trainer.train(replace(settings, pairs=8, validation_pairs=0, seed=5), tmp_path, anatomy, minutes=0.0)
    assert seeds == [5 + 7919 * number for number in range(4)]


def test_a_run_goes_on_without_the_weights_that_it_began_with(settings, anatomy, tmp_path):
    first = trainer.train(replace(settings, pairs=4), tmp_path / "first", anatomy)
    going_on = replace(settings, initial=str(first))
    trainer.train(going_on, tmp_path / "second", anatomy, minutes=0.0)
    first.unlink()
    trainer.train(going_on, tmp_path / "second", anatomy)
    entries = json.loads((tmp_path / "second" / "provenance.json").read_text())
    assert entries[0]["initial"] and entries[1]["initial"] is None


def test_workers_make_the_same_pairs_in_the_same_order(settings, anatomy):
    model = ModelConfig.from_yaml(settings.model)
    alone, helped = (
        list(batches.micro_batches(replace(settings, workers=w, pairs=8), model, anatomy, 1, 0, 1)) for w in (0, 1)
    )
    assert len(alone) == len(helped) == 3
    assert all(torch.equal(a.overlaps, b.overlaps) for a, b in zip(alone, helped, strict=True))


@pytest.mark.timeout(400)
def test_two_processes_under_torchrun_learn_what_one_learns(settings, anatomy, tmp_path):
    """DistributedDataParallel on gloo: the same pairs and patches, so the same weights but for the order of sums."""
    one = trainer.train(settings, tmp_path / "one", anatomy)
    (tmp_path / "run.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(settings.to_dict()))))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2",
               "-m", "gapr_core.cli", "train", "--config", str(tmp_path / "run.yaml"), "--anatomy", str(anatomy),
               "--out", str(tmp_path / "two")]  # fmt: skip
    environment = os.environ | {"OMP_NUM_THREADS": "1", "TMPDIR": str(tmp_path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-5000:]
    first, second = weights.load(one)[0], weights.load(tmp_path / "two" / "weights.safetensors")[0]
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=2e-4)
    losses = [curves.read_csv(tmp_path / run / "log.csv") for run in ("one", "two")]
    for a, b in zip(*losses, strict=True):
        assert b == pytest.approx(a | {"seconds": b["seconds"]}, rel=2e-3)
    of_one = json.loads((tmp_path / "one" / "subjects_0.json").read_text())
    of_two = [json.loads((tmp_path / "two" / f"subjects_{rank}.json").read_text()) for rank in range(2)]
    assert Counter(of_one) == Counter(of_two[0]) + Counter(of_two[1]) and all(of_two)
    assert weights.load(tmp_path / "two" / "weights.safetensors")[1]["subjects"] == len(of_one)


def leaves(value):
    """The tensors inside nested dataclasses and tuples."""
    found = []
    mapped(value, lambda tensor: found.append(tensor) or tensor)
    return found


def test_a_bone_from_the_shared_folder_gives_the_same_pairs_bit_by_bit(settings, anatomy, tmp_path):
    model = settings.network()
    drawn, shared, other = (TrainingPairs(settings, model, anatomy, cache=c) for c in (None, tmp_path, tmp_path))
    first = [drawn.pair(number) for number in range(3)]
    second = [shared.pair(number) for number in range(3)]
    written = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    third = [other.pair(number) for number in range(3)]
    assert written and {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")} == written
    for pairs in (second, third):
        for a, b in zip(first, pairs, strict=True):
            assert all(torch.equal(p, q) for p, q in zip(leaves(a), leaves(b), strict=True))
            assert a.source.coarse.lengths == b.source.coarse.lengths and a.subjects == b.subjects
    prune(tmp_path, settings, 10**6)
    assert not list(tmp_path.glob("*.npz"))


def test_other_meshes_and_other_parametric_bones_have_a_shared_folder_of_their_own(
    settings, anatomy, tmp_path, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    other = shutil.copytree(anatomy, tmp_path / "other")
    first = batches.bones_folder(tmp_path / "run", settings, anatomy)
    assert batches.bones_folder(tmp_path / "run", settings, other) == first  # the same bones, elsewhere
    with np.load(other / "femur_toy.npz") as data:
        arrays = {name: data[name] for name in data.files}
    np.savez(other / "femur_toy.npz", **arrays | {"points": 1.1 * arrays["points"]})
    found = {first, *(batches.bones_folder(tmp_path / "run", settings, folder) for folder in (other, None))}
    monkeypatch.setattr(provenance, "parametric_version", lambda: "another one")
    found.add(batches.bones_folder(tmp_path / "run", settings, None))
    assert len(found) == 4


def test_the_learning_rate_rises_then_falls_to_its_final_share():
    config = TrainConfig(learning_rate=1.0, warmup=0.1, final_rate=0.05)
    rates = [trainer.learning_rate(config, s / 100) for s in range(101)]
    assert rates[0] < 0.02 and max(rates) == pytest.approx(1.0) and rates[100] == pytest.approx(0.05)
    assert rates[:10] == sorted(rates[:10]) and rates[10:] == sorted(rates[10:], reverse=True)


def test_drawn_people_vary_as_the_people_do():
    """By the covariance of a sample of three, whose divisor is two."""
    rng = np.random.default_rng(0)
    people = rng.normal(size=(3, 2, 3)) * 10.0
    model = ShapeModel(people.mean(axis=0), people - people.mean(axis=0), np.zeros((1, 3), dtype=int))
    drawn = np.array([model.draw(rng).points.ravel() for _ in range(6000)])
    wanted = np.cov(people.reshape(3, 6).T)
    np.testing.assert_allclose(np.cov(drawn.T), wanted, atol=0.08 * np.diag(wanted).max())


def test_a_varied_bone_keeps_its_faces_outward(toy):
    from scipy.spatial import ConvexHull

    from gapr_core.data.solid import volume_mm3

    points = toy.bone(300)
    faces = ConvexHull(points).simplices
    corners = points[faces]
    inward = (
        np.einsum("ij,ij->i", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners.mean(1))
        < 0
    )
    faces[inward] = faces[inward][:, ::-1]
    for seed in range(4):
        assert volume_mm3(vary(Surface(points, faces, None), np.random.default_rng(seed))) > 0


def test_pairs_that_share_a_target_learn_what_they_learn_alone(settings, anatomy):
    model = ModelConfig.from_yaml(settings.model)
    batch = TrainingPairs(settings, model, anatomy)[1]
    assert batch.which == (0, 0) and len(batch.distinct) == 1
    torch.manual_seed(0)
    net = trainer.GAPRNet(model)
    shared = trainer.compute_losses(net, batch, torch.Generator().manual_seed(0))[0].total
    alone = trainer.compute_losses(net, replace(batch, distinct=None), torch.Generator().manual_seed(0))[0].total
    torch.testing.assert_close(shared, alone)
