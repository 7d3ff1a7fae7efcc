"""The driver of the ablations: every row, whole after any interruption, and the same again."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

from gapr_core import cli
from gapr_core.data.make_pairs import Recipe
from gapr_core.data.pair import Pair
from gapr_core.errors import ConfigError
from gapr_core.model import weights
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.model.pyramid import matching_radius, target_frame
from gapr_core.training import config as training_config
from gapr_core.training.ablation import cli as ablation
from gapr_core.training.ablation import table as ablation_table
from gapr_core.training.config import TrainConfig, default_plan, read_plan, trained_as

EXAM = Recipe(("paper", "L2"), ("femur",), 2, 0, "test", 2, "anatomy")
BUDGET = TrainConfig(bones=("femur",), mix={"paper": 1.0}, pairs=4, batch=2, micro_batch=2, pool=1, validation_pairs=1)


@pytest.fixture(scope="module")
def plan(toy, tmp_path_factory):
    """Two tables of tiny networks, three rows, of which two are the same network."""
    folder = tmp_path_factory.mktemp("plan")
    (folder / "model").mkdir()
    small = toy.small_config(superpoints=(10, 20), width=8, global_width=16, train_pairs=6)
    for name, final in (("standard", "vanilla"), ("ours", "pga"), ("ours_again", "pga")):
        values = replace(small, name=name, final_cross=final, repositioning="none").to_dict()
        plain = {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}
        (folder / "model" / f"{name}.yaml").write_text(yaml.safe_dump(plain))
    (folder / "ablation.yaml").write_text(
        "Cross (table IV):\n"
        "- {label: standard, model: standard, paper: 91.2}\n"
        "- {label: ours, model: ours, paper: 94.2}\n"
        "Transformer:\n- {label: ours too, model: ours_again}\n"
    )
    return folder / "ablation.yaml"


@pytest.fixture(scope="module")
def whole(plan, anatomy, tmp_path_factory):
    """A comparison that nothing interrupted."""
    out = tmp_path_factory.mktemp("whole")
    assert ablation.ablate(read_plan(plan), BUDGET, out, anatomy, EXAM) == 0
    return out


def rows(out):
    return json.loads((out / "table.json").read_text())["rows"]


@pytest.mark.slow
def test_a_stopped_driver_goes_on_and_comes_to_the_same_table(plan, whole, anatomy, tmp_path, monkeypatch):
    """Every training is stopped after each of its two steps."""
    real, begun = ablation.train, []

    def one_step(config, folder, anatomy, minutes):
        begun.append(folder.name)
        return real(config, folder, anatomy, minutes=0.0)

    monkeypatch.setattr(ablation, "train", one_step)
    monkeypatch.setattr(ablation_table.curves, "draw", lambda folders, out, names=(): out)  # slow
    assert ablation.ablate(read_plan(plan), BUDGET, tmp_path, anatomy, EXAM) == 2
    assert len(rows(tmp_path)) == len(rows(whole)) and not rows(tmp_path)[0]["pairs"]
    assert "| standard | – |" in (tmp_path / "table.md").read_text()
    assert ablation.ablate(read_plan(plan), BUDGET, tmp_path, anatomy, EXAM) == 0
    assert begun == ["standard_seed0", "ours_seed0"] * 2
    assert rows(tmp_path) == rows(whole)
    steps = [line.split(",")[0] for line in (tmp_path / "ours_seed0" / "log.csv").read_text().split()]
    assert steps == ["step", "1", "2"]
    assert [e["step"] for e in json.loads((tmp_path / "ours_seed0" / "provenance.json").read_text())] == [0, 1]


def test_the_same_command_again_trains_nothing_and_writes_the_same_files(plan, whole, anatomy, monkeypatch):
    monkeypatch.setattr(ablation, "train", lambda *_: pytest.fail("trained again"))
    names = ("table.md", "table.json", "table.csv")
    before = [(whole / name).read_bytes() for name in names]
    assert ablation.ablate(read_plan(plan), BUDGET, whole, anatomy, EXAM) == 0
    assert [(whole / name).read_bytes() for name in names] == before


def test_the_table_has_every_row_with_intervals_and_the_papers_figure_apart(whole):
    found = {(r["network"], r["protocol"]): r for r in rows(whole)}
    assert set(found) == {(n, p) for n in ("standard", "ours", "ours too") for p in ("paper", "L2", "all")}
    assert [found["standard", p]["paper_rr_percent"] for p in ("paper", "L2", "all")] == [91.2, None, None]
    assert [found["ours", p]["pairs"] for p in ("paper", "L2", "all")] == [2, 2, 4]
    for row in found.values():
        assert all(0.0 <= row[f"{n}_low"] <= row[n] <= row[f"{n}_high"] <= 1.0 for n in ablation_table.FIGURES)
    text = (whole / "table.md").read_text()
    assert "compare the order" in text and "5 real train subjects" in text and "4 training pairs" in text
    assert (whole / "curves_cross.png").exists() and (whole / "curves_transformer.png").exists()
    assert len((whole / "table.csv").read_text().splitlines()) == 1 + len(found)


def test_a_network_that_stands_in_two_tables_is_trained_once(whole):
    assert sorted(f.name for f in whole.iterdir() if f.is_dir()) == ["ours_seed0", "pairs", "standard_seed0"]
    ours, again = ([r for r in rows(whole) if r["network"] == n] for n in ("ours", "ours too"))
    assert [r["coarse"] for r in ours] == [r["coarse"] for r in again]


def test_a_folder_with_other_settings_is_refused(plan, whole, anatomy):
    with pytest.raises(ConfigError, match="begun"):
        ablation.ablate(read_plan(plan), replace(BUDGET, pairs=6), whole, anatomy, EXAM)
    with pytest.raises(ConfigError, match="recipe"):
        ablation.ablate(read_plan(plan), BUDGET, whole, anatomy, replace(EXAM, count=3))


def test_an_examination_with_poses_found_in_another_way_or_of_other_pairs_is_refused(plan, whole, anatomy, tmp_path):
    out = shutil.copytree(whole, tmp_path / "out")
    with pytest.raises(ConfigError, match="--pose ransac; got local_to_global in .*exam.json; choose a new --out"):
        ablation.ablate(read_plan(plan), BUDGET, out, anatomy, EXAM, pose="ransac")
    exam = out / "ours_seed0" / "exam.json"
    written = json.loads(exam.read_text())
    assert written.pop("pose") == "local_to_global"
    exam.write_text(json.dumps(written))  # as earlier versions wrote it
    assert ablation.ablate(read_plan(plan), BUDGET, out, anatomy, EXAM) == 0
    exam.write_text(json.dumps(written | {"pairs": "others"}))
    with pytest.raises(ConfigError, match="of the pairs in .*; got one of others"):
        ablation.ablate(read_plan(plan), BUDGET, out, anatomy, EXAM)


def test_a_protocol_without_a_true_pose_is_refused_before_anything_is_trained(plan, anatomy, tmp_path, monkeypatch):
    monkeypatch.setattr(ablation, "train", lambda *_: pytest.fail("trained"))
    without = replace(EXAM, protocols=("paper", "scene-wrong", "wrong"))
    with pytest.raises(ConfigError, match="a true pose; got scene-wrong, wrong; leave them out"):
        ablation.ablate(read_plan(plan), BUDGET, tmp_path, anatomy, without)


def test_a_table_without_rows_is_named(tmp_path):
    (tmp_path / "plan.yaml").write_text("T: 3\n")
    with pytest.raises(ConfigError, match="a list of rows for each table in .*plan.yaml; got 3 under T"):
        read_plan(tmp_path / "plan.yaml")
    (tmp_path / "plan.yaml").write_text("T:\n")
    assert read_plan(tmp_path / "plan.yaml") == []


def test_the_weights_carry_where_they_come_from(whole):
    card = weights.load(whole / "ours_seed0" / "weights.safetensors")[1]
    (entry,) = card["provenance"]
    assert {"commit", "gapr", "torch", "platform", "cpu", "threads", "data"} <= set(entry) and card["step"] == 2


def test_the_examination_is_of_other_people_than_the_training(whole):
    people = {p["person"] for p in json.loads((whole / "pairs" / "manifest.json").read_text())["pairs"]}
    assert people == {"p7", "p8"}  # of the split `test`


def test_the_plan_that_ships_holds_the_papers_tables():
    plan = read_plan(default_plan())
    papers = [v.paper for v in plan if "table" in v.table]
    assert papers == [88.8, 91.9, 94.2, 91.2, 90.0, 94.2, None, 80.8, 92.4, 91.5, 92.9, 91.1, 94.2]
    ours = [v for v in plan if v.table == "What we changed"]
    assert len(ours) == 5 and all(v.paper is None for v in ours)
    assert len(set(trained_as(plan).values())) == 15
    assert all(ModelConfig.from_yaml(v.model).name == v.model.stem for v in plan)


def test_without_the_plan_that_ships_every_command_is_answered_with_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setattr(training_config, "__file__", str(tmp_path / "a" / "b" / "c.py"))
    monkeypatch.setattr(training_config.sysconfig, "get_path", lambda name: str(tmp_path))
    with pytest.raises(ConfigError, match="got none installed; install gapr_ros again, with its data; gapr ablate ta"):
        default_plan()


def test_a_table_that_cannot_be_written_leaves_the_one_before_as_it_is(plan, tmp_path, monkeypatch):
    ablation_table.write(tmp_path, read_plan(plan), BUDGET, EXAM, seeds=1)
    before = (tmp_path / "table.csv").read_bytes()

    def refuse(*_):
        raise OSError(28, "No space left")

    monkeypatch.setattr(csv.DictWriter, "writerows", refuse)
    with pytest.raises(ConfigError, match="table.csv .No space left"):
        ablation_table.write(tmp_path, read_plan(plan), BUDGET, EXAM, seeds=1)
    assert (tmp_path / "table.csv").read_bytes() == before


def test_the_command_wants_a_budget(capsys, tmp_path):
    with pytest.raises(SystemExit):
        cli.main(["ablate", "--out", str(tmp_path)])
    assert "--pairs" in capsys.readouterr().err


def exam(folder, recalls):
    folder.mkdir()
    same = dict.fromkeys(ablation_table.FIGURES, 0.5) | {"protocol": "paper"}
    records = [same | {"pair": name, "person": name[0], "rr_4_5": recall} for name, recall in recalls.items()]
    (folder / "exam.json").write_text(json.dumps({"records": records}))
    return folder


def test_a_row_is_compared_with_the_last_one_on_the_same_pairs_of_the_same_seeds(plan, tmp_path):
    first, last = read_plan(plan)[:2]
    own = [exam(tmp_path / "a0", {"p1": 1.0, "q1": 0.0, "q2": 1.0}), exam(tmp_path / "a1", {"p1": 1.0})]
    other = [exam(tmp_path / "b0", {"q2": 0.0, "p1": 0.0, "q1": 0.0, "q3": 1.0}), tmp_path / "b1"]  # b1 is not finished
    found = ablation_table.difference(first, last, "paper", {first: own, last: other})
    assert (found["network"], found["last"], found["seeds"], found["pairs"]) == ("standard", "ours", 1, 3)
    assert found["rr_4_5"] == pytest.approx(2.0 / 3.0, abs=1e-4) and found["coarse"] == 0.0
    assert found["rr_4_5_low"] == pytest.approx(0.5) and found["rr_4_5_high"] == pytest.approx(1.0)  # q alone, p alone
    swapped = ablation_table.difference(last, first, "paper", {first: own, last: other})
    assert swapped["rr_4_5"] == -found["rr_4_5"]
    nothing = ablation_table.difference(first, last, "L2", {first: own, last: other})
    assert nothing["pairs"] == 0 and nothing["rr_4_5"] is None


def test_the_table_shows_the_differences(whole):
    text = (whole / "table.md").read_text()
    assert text.count("Less the last row, on the same pairs with the same seeds (ours):") == 3
    assert {r["network"] for r in json.loads((whole / "table.json").read_text())["differences"]} == {"standard"}


def test_a_pose_of_the_examination_agrees_with_what_lies_within_one_and_a_half_matching_radii(toy, monkeypatch):
    config = toy.small_config(superpoints=(10, 20), width=8, global_width=16)
    target = toy.bone(600)
    pair = Pair(toy.view(target), target, np.eye(4), "a", "femur", "p1", "paper")
    propose, radii_mm = ablation.local_to_global, []

    def heard(found, radius_mm):
        radii_mm.append(radius_mm)
        return propose(found, radius_mm)

    monkeypatch.setattr(ablation, "local_to_global", heard)
    record = ablation.examine(GAPRNet(config).eval(), pair)
    assert record["pair"] == "a" and set(ablation_table.FIGURES) <= record.keys()
    frame = target_frame(target, config)
    assert radii_mm == [pytest.approx(1.5 * matching_radius(frame) * frame.scale_mm)]
