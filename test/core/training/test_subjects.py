"""A training that draws a held-out subject ends; what was drawn is on record."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from gapr_core.data.pool import parametric_people, parametric_split
from gapr_core.errors import ConfigError
from gapr_core.model import weights
from gapr_core.training import dataset, trainer, validation
from gapr_core.training.config import TrainConfig
from gapr_core.training.subjects import Drawn

TRAIN = {"p0", "p1", "p2", "p3", "p4"}


@pytest.fixture(scope="module")
def settings(toy, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "toy.yaml"
    small = toy.small_config(superpoints=(10, 20), width=8, global_width=16, train_pairs=6).to_dict()
    path.write_text(yaml.safe_dump({k: list(v) if isinstance(v, tuple) else v for k, v in small.items()}))
    return TrainConfig(model=str(path), bones=("femur",), mix={"L1": 1.0}, pairs=8, batch=4, micro_batch=2, pool=3,
                       reuse=1, share=1, synthetic=0.3, validation_pairs=0)  # fmt: skip


def test_the_run_records_whose_bones_it_drew(settings, anatomy, tmp_path):
    written = trainer.train(settings, tmp_path, anatomy)
    drawn = json.loads((tmp_path / "subjects_0.json").read_text())
    assert drawn and drawn.keys() <= TRAIN and sum(drawn.values()) >= settings.pairs
    assert weights.load(written)[1]["subjects"] == len(drawn)


def test_a_training_that_draws_from_everybody_ends_with_an_error(settings, anatomy, tmp_path, monkeypatch):
    """The leak mutant: `split` ignored where the bones are read."""
    everybody = dataset.anatomy.surfaces
    monkeypatch.setattr(dataset.anatomy, "surfaces", lambda folder, bone, split="all": everybody(folder, bone))
    with pytest.raises(ConfigError, match="train split only.*p[5678]"):
        trainer.train(replace(settings, pairs=64), tmp_path, anatomy)


@pytest.mark.parametrize("real", [True, False])
def test_a_validation_on_test_subjects_ends_with_an_error_that_names_them(settings, anatomy, monkeypatch, real):
    """The leak mutant: `test` where `val` is meant."""
    folder, drawn, train = anatomy if real else None, validation.specimens, replace(settings, validation_pairs=1)
    validation.validation_set(train, train.network(), folder)
    monkeypatch.setattr(validation, "specimens", lambda bone, split, *more: drawn(bone, "test", *more))
    with pytest.raises(ConfigError, match="split val only; got p[78]" if real else "split val only; got parametric_"):
        validation.validation_set(train, train.network(), folder)


def test_meshes_of_nobody_in_the_split_train_are_no_reason_to_train_on_parametric_bones(anatomy, tmp_path):
    (tmp_path / "femur_toy.npz").write_bytes((anatomy / "femur_toy.npz").read_bytes())
    (tmp_path / "splits.json").write_text('{"train": ["P0", "P1"], "val": ["p5"], "test": []}')
    with pytest.raises(ConfigError, match=r"train with a femur; got meshes of p0, p1, p2 \.\.\. in .*splits.json"):
        dataset.People("femur", tmp_path, "train")


def test_a_shape_model_counts_for_everybody_it_is_made_of_and_a_real_bone_for_its_own_subject(anatomy):
    people = dataset.People("femur", anatomy, "train")
    assert set(people.draw_of(0, 1.0, 0)[1]) == TRAIN
    assert all(len(people.draw_of(number, 0.0, 0)[1]) == 1 for number in range(5))
    parametric = dataset.People("thoracic", None, "train")
    specimen, subjects = parametric.draw_of(0, 0.5, 0)
    assert subjects == (specimen.person,) and parametric_split(specimen.person) == "train"


def test_the_split_of_a_parametric_subject_is_known_from_its_name():
    for split in ("train", "val", "test"):
        people = set(parametric_people(split, 50))
        assert len(people) == 50 and {parametric_split(f"parametric_{number}") for number in people} == {split}
    assert parametric_split("llp26_2008_0054") is None and parametric_split("drawn_3") is None


def test_parametric_subjects_of_val_and_test_are_held_out_too(tmp_path):
    drawn = Drawn.of(None, tmp_path / "subjects.json")
    drawn.add(["parametric_0", "parametric_6"])
    with pytest.raises(ConfigError, match="parametric_3"):
        drawn.add(["parametric_3"])


def test_the_record_goes_on_where_an_earlier_call_stopped(tmp_path):
    path = Path(tmp_path / "subjects.json")
    for _ in range(2):
        drawn = Drawn.of(None, path)
        drawn.add(["parametric_0", "parametric_0", "parametric_1"])
        drawn.write()
    assert json.loads(path.read_text()) == {"parametric_0": 4, "parametric_1": 2}


def test_subjects_of_all_processes_count_once(tmp_path):
    first, second = (Drawn.of(None, tmp_path / f"subjects_{rank}.json") for rank in range(2))
    first.add(["parametric_0", "parametric_1"])
    second.add(["parametric_1", "parametric_2", "parametric_5"])
    assert first.count() == 2
    second.write()
    assert (first.count(), second.count()) == (4, 3)  # the first has written nothing yet


def test_a_pair_of_a_drawn_bone_names_everybody_whom_the_bone_was_drawn_from(settings, anatomy):
    pairs = dataset.TrainingPairs(replace(settings, synthetic=1.0), settings.network(), anatomy)
    assert set(pairs.pair(0).subjects) == TRAIN and len(pairs[0].subjects) == settings.micro_batch * len(TRAIN)
