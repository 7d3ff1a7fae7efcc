"""Val and test subjects are poisoned with NaN: whatever is learned from must stay finite."""

import json

import numpy as np
import pytest

from gapr_core.calibration import pairs, streams
from gapr_core.calibration.pairs import Task
from gapr_core.data import anatomy
from gapr_core.data.parametric import make_bone
from gapr_core.errors import InvalidPointCloudError
from gapr_core.model.config import ModelConfig
from gapr_core.training.config import TrainConfig
from gapr_core.training.dataset import People, TrainingPairs
from gapr_core.training.shapes import ShapeModel

TRAIN, HELD_OUT = [f"train{i}" for i in range(5)], ["val0", "val1", "test0", "test1"]


@pytest.fixture(scope="module")
def poisoned(tmp_path_factory):
    """A folder of femurs and tibias, corresponded, in which every held-out vertex is NaN."""
    folder = tmp_path_factory.mktemp("anatomy")
    rng = np.random.default_rng(0)
    people = [*HELD_OUT[:2], *TRAIN, *HELD_OUT[2:]]
    for bone in ("femur", "tibia"):
        surface = make_bone(bone, 3)
        shapes = np.stack([surface.points * (1.0 + 0.05 * rng.normal(size=3)) for _ in people])
        shapes[[person in HELD_OUT for person in people]] = np.nan
        np.savez(folder / f"{bone}_made.npz", points=shapes, faces=surface.faces, person=np.array(people))
    splits = {"train": TRAIN, "val": HELD_OUT[:2], "test": HELD_OUT[2:]}
    (folder / "splits.json").write_text(json.dumps(splits))
    return folder


def test_the_poison_is_noticed_by_whoever_draws_from_everybody(poisoned):
    (everybody,) = anatomy.corresponded(poisoned, "femur")
    with pytest.raises(np.linalg.LinAlgError):
        ShapeModel.of(everybody)
    with pytest.raises(InvalidPointCloudError, match="NaN"):
        People("femur", poisoned, "all")


def test_training_shapes_never_touch_val_or_test_subjects(poisoned):
    people = People("femur", poisoned, "train")
    assert {specimen.person for specimen in people.real} == set(TRAIN)
    assert all(len(model.deviations) == len(TRAIN) and np.isfinite(model.mean).all() for model in people.models)
    for synthetic in (0.0, 1.0):
        assert all(np.isfinite(people.draw(number, synthetic, 0).surface.points).all() for number in range(20))


def test_what_the_trainer_draws_never_touches_val_or_test_subjects(poisoned):
    drawn = TrainingPairs(TrainConfig(bones=("femur", "tibia")), ModelConfig(), poisoned)
    assert all(np.isfinite(people.draw(number, 0.5, 0).surface.points).all()
               for people in drawn.people for number in range(20))  # fmt: skip


def test_calibration_pairs_never_touch_val_or_test_subjects_and_say_whose_bone_they_are(poisoned, monkeypatch):
    monkeypatch.setattr(pairs, "BONES", ("femur", "tibia"))
    monkeypatch.setattr(pairs, "PARAMETRIC_PEOPLE", 1)
    monkeypatch.setattr(pairs, "DRAWN_PEOPLE", {True: 3, False: 1})
    monkeypatch.setattr(pairs, "SEEN_AS", {"L2": {"L2": 1.0, "L1": 1.0}})
    monkeypatch.setattr(pairs, "_KEPT", {})
    named = set()
    for number in range(40):
        drawn = pairs.draw(Task(str(poisoned), "train", 0, number))
        assert np.isfinite(drawn.pair.source).all() and np.isfinite(drawn.pair.target).all()
        named |= set(drawn.people)
    for number in range(8):
        _, _, people, frames = streams.draw_stream(Task(str(poisoned), "train", 0, number, "stream"))
        assert all(np.isfinite(frame.source).all() and np.isfinite(frame.target).all() for frame in frames)
        named |= set(people)
    assert named & set(TRAIN) and not named & set(HELD_OUT)
    assert {person.split("_")[0] for person in named - set(TRAIN)} == {"drawn", "parametric"}
