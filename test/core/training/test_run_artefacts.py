"""Curves and provenance: what a run leaves as well as its weights."""

from __future__ import annotations

import json
import logging
import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import save_file

from gapr_core import cli
from gapr_core.errors import ConfigError, WeightsError
from gapr_core.model import weights
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.training import curves, distributed, export, provenance, run_folder
from gapr_core.training.checkpoint import load_checkpoint, save_checkpoint
from gapr_core.training.config import TrainConfig, read_config

PNG = b"\x89PNG\r\n"
LOG = "step,pairs,seconds,rate,norm,loss,coarse,fine,early\n"
SCORES = "pairs,seconds,protocol,coarse_inliers,fine_inliers,first,near,among\n"


@pytest.fixture
def run(tmp_path):
    """A folder with 40 steps of 8 pairs and two validations over two protocols."""
    folder = tmp_path / "run"
    folder.mkdir()
    steps = [f"{s},{8 * s},{s}.5,0.0005,1.0,4.0,{2 - s / 40},{3 - s / 40},1.0\n" for s in range(1, 41)]
    (folder / "log.csv").write_text(LOG + "".join(steps))
    scores = [f"{p},9.0,{name},0.5,0.2,0.25,0.5,1.0\n" for p in (160, 320) for name in ("L1", "all", "paper")]
    (folder / "validation.csv").write_text(SCORES + "".join(scores))
    return folder


def lines(figure, panel):
    return [line for line in figure.axes[panel].get_lines() if len(line.get_xdata())]


def test_the_curves_of_a_run_show_what_its_files_say(run):
    drawn = curves.figure([curves.read(run, "run")])
    rate, recall = lines(drawn, 1)[0], {line.get_label(): line for line in lines(drawn, 3)}
    assert set(recall) == {"L1", "paper", "all protocols"}
    np.testing.assert_allclose(recall["L1"].get_xydata(), [[160, 0.25], [320, 0.25]])
    np.testing.assert_allclose(rate.get_xydata(), [[8 * s, 0.5] for s in range(1, 41)])
    assert all(axes.get_xlabel() and axes.get_ylabel() and axes.get_title(loc="left") for axes in drawn.axes)


def test_the_line_of_one_protocol_is_not_below_that_of_all(run):
    text = (run / "validation.csv").read_text().splitlines(keepends=True)
    (run / "validation.csv").write_text("".join(line for line in text if ",paper," not in line))
    assert [line.get_label() for line in lines(curves.figure([curves.read(run, "run")]), 3)] == ["L1"]


def test_curves_are_drawn_from_files_that_are_half_written_and_say_so(run, tmp_path, caplog):
    whole = curves.read(run, "run")
    for name, rest in (("log.csv", "41,328,41.5,0.0005,1.0,4.0,0.9,0.9,1"), ("validation.csv", "480,9.0,L1,0.5\n")):
        with (run / name).open("a") as file:
            file.write(rest)
    with caplog.at_level(logging.WARNING):
        cut = curves.read(run, "run")
    assert caplog.text.count("1 incomplete line") == 2
    np.testing.assert_array_equal(cut.steps["pairs"], whole.steps["pairs"])
    assert len(cut.scores["L1"]["pairs"]) == 2
    assert curves.draw([run], tmp_path / "a.png").read_bytes().startswith(PNG)


def test_steps_that_were_done_again_after_a_crash_count_once(run):
    with (run / "log.csv").open("a") as file:
        file.write("31,248,50.0,0.0005,1.0,4.0,7.0,7.0,1.0\n")
    steps = curves.read(run, "run").steps
    assert steps["step"].tolist() == list(range(1, 32)) and steps["coarse"][-1] == 7.0


def test_a_running_mean_leaves_out_what_is_not_finite():
    values = np.array([1.0, np.nan, 3.0, 5.0, np.nan, np.nan, np.nan])
    np.testing.assert_allclose(curves.smooth(values, 1), [1.0, 2.0, 4.0, 4.0, 5.0, np.nan, np.nan])


def test_a_line_after_a_crash_takes_the_place_of_the_one_that_was_cut_off(tmp_path):
    path = tmp_path / "log.csv"
    run_folder.append(path, {"pairs": 8, "loss": 1.0})
    path.write_bytes(path.read_bytes() + b"16,0.")
    run_folder.append(path, {"pairs": 24, "loss": 2.0})
    assert curves.read_csv(path) == [{"pairs": 8.0, "loss": 1.0}, {"pairs": 24.0, "loss": 2.0}]


def test_a_picture_that_cannot_be_drawn_is_a_warning_and_no_error(tmp_path, caplog):
    run_folder.draw_curves(tmp_path / "nowhere")
    assert "no curves of" in caplog.text and "log.csv" in caplog.text


def test_the_command_lays_runs_over_each_other_under_names_that_differ(run, tmp_path, capsys):
    other = tmp_path / "other" / "run"
    other.parent.mkdir()
    other.symlink_to(run)
    assert curves.labels([tmp_path / "run", tmp_path / "x" / "run"])[1] == "x/run"
    assert cli.main(["train", "--plot", str(run), str(run), "--out", str(tmp_path / "two.png")]) == 0
    assert (tmp_path / "two.png").read_bytes().startswith(PNG) and "two.png" in capsys.readouterr().out
    assert cli.main(["train", "--plot", str(run), str(run)]) == cli.BAD_INPUT
    assert cli.main(["train"]) == cli.BAD_INPUT


def test_every_resumption_adds_an_entry_and_keeps_the_earlier_ones(tmp_path):
    for step in (0, 7):
        entries = provenance.append(tmp_path, TrainConfig(), None, step, 1)
    assert [e["step"] for e in entries] == [0, 7] == [e["step"] for e in json.loads(provenance_of(tmp_path))]
    assert entries[1]["cpu"] and entries[1]["threads"] >= 1 and entries[1]["data"]["anatomy"] is None
    assert len(provenance.summary([tmp_path])) == 1


def provenance_of(folder):
    return (folder / provenance.FILE).read_text()


def test_the_commit_is_the_one_that_git_names_or_none():
    asked = subprocess.run(["git", "rev-parse", "HEAD"], cwd=provenance.Path(provenance.__file__).parent,
                           capture_output=True, text=True)  # fmt: skip
    found = provenance.commit()
    assert found is None if asked.returncode else found.removesuffix("-dirty") == asked.stdout[:12]


def test_the_hash_of_the_data_knows_people_and_meshes_but_not_the_folder(tmp_path):
    def folder(name, people, mesh):
        (tmp_path / name).mkdir()
        (tmp_path / name / "femur_a.npz").write_bytes(mesh)
        (tmp_path / name / "splits.json").write_text(json.dumps({"train": people, "val": ["v"], "test": ["t"]}))
        return provenance.data(["femur"], tmp_path / name)["anatomy"]

    first = folder("a", ["p", "q"], b"mesh")
    assert first == folder("b", ["q", "p"], b"mesh")
    assert len({first, folder("c", ["p"], b"mesh"), folder("d", ["p", "q"], b"other")}) == 3


def test_a_run_begun_before_a_setting_existed_goes_on_and_another_one_is_refused(tmp_path):
    """As in the folders of older commits: no provenance.json, fewer entries, the yaml elsewhere."""
    begun = {"train": replace(TrainConfig(), model="old/best.yaml").to_dict(), "model": ModelConfig().to_dict()}
    del begun["train"]["share"], begun["model"]["mutual_k"]
    (tmp_path / "config.json").write_text(json.dumps(begun))
    run_folder.check(tmp_path, replace(TrainConfig(), model="new/best.yaml"), ModelConfig())
    for config, model in ((TrainConfig(share=3), ModelConfig()), (TrainConfig(), ModelConfig(mutual_k=4))):
        with pytest.raises(ConfigError, match="begun"):
            run_folder.check(tmp_path, config, model)


def test_a_refusal_of_other_settings_names_them(tmp_path):
    (tmp_path / "config.json").write_text(
        json.dumps({"train": TrainConfig().to_dict(), "model": ModelConfig().to_dict()})
    )
    with pytest.raises(ConfigError, match="seed 1 instead of 0, heads 2 instead of 4; give those, or choose a new"):
        run_folder.check(tmp_path, TrainConfig(seed=1), ModelConfig(heads=2))
    with pytest.raises(ConfigError, match="pairs 8 instead of 24000, batch 4 instead of 8, .* and 1 more; give"):
        run_folder.check(tmp_path, TrainConfig(pairs=8, batch=4, micro_batch=2, pool=9, seed=1), ModelConfig())


def test_a_run_goes_on_with_the_bones_and_subjects_that_it_was_begun_with(tmp_path):

    def anatomy(name, people, mesh=b"mesh"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "femur_a.npz").write_bytes(mesh)
        (tmp_path / name / "splits.json").write_text(json.dumps({"train": people, "val": ["v"], "test": []}))
        return tmp_path / name

    run, own = tmp_path / "run", anatomy("own", ["p", "q"])
    for folder in (own, anatomy("moved", ["p", "q"])):
        run_folder.claim(run, TrainConfig(), ModelConfig(), folder, 0, 1)
    others = {"parametric bones alone where .* has had 2 train subjects": None,
              "3 train subjects in .* has had 2": anatomy("leaks", ["p", "q", "t"]),
              "2 train subjects in .* has had 2 train": anatomy("other", ["p", "q"], b"other")}  # fmt: skip
    for message, folder in others.items():
        with pytest.raises(ConfigError, match=message + ".*; give --anatomy as it was"):
            run_folder.claim(run, TrainConfig(), ModelConfig(), folder, 7, 1)
    assert len(provenance.entries(run)) == 2


@pytest.mark.parametrize(("file", "content", "call"), [
    *[("config.json", content, lambda folder: run_folder.check(folder, TrainConfig(), ModelConfig()))
      for content in ("{", "", "{}", "[1]")],
    *[(provenance.FILE, content, call)
      for content in ("[", "{}", '"a"', "[1]")
      for call in (lambda folder: provenance.append(folder, TrainConfig(), None, 0, 1),
                   lambda folder: provenance.summary([folder]))],
])  # fmt: skip
def test_files_of_a_run_that_are_damaged_are_refused_by_their_name(tmp_path, file, content, call):
    (tmp_path / file).write_text(content)
    what = "settings" if file == "config.json" else "provenance"
    with pytest.raises(ConfigError, match=f"the {what} of a training run; got .*{file} .*; restore it"):
        call(tmp_path)


def flipped(data, at):
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


@pytest.mark.parametrize("damage", ["random", "cut", "empty", "of something else", "a bit of the step", "a bit"])
def test_a_checkpoint_that_is_damaged_is_refused_by_its_name(toy, tmp_path, damage):
    network, ema = (GAPRNet(toy.small_config(superpoints=(10, 20), width=8, global_width=16)) for _ in range(2))
    optimizer, path = torch.optim.AdamW(network.parameters()), tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, network, ema, optimizer, {"step": 1})
    assert load_checkpoint(path, network, ema, optimizer) == {"step": 1}
    whole = path.read_bytes()
    bits = {"a bit": flipped(whole, len(whole) - 5), "a bit of the step": flipped(whole, whole.index(b"step") + 8)}
    made = {"random": np.random.default_rng(0).bytes(500), "cut": whole[:-9], **bits}
    path.write_bytes(made.get(damage, b""))
    if damage == "of something else":
        save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(WeightsError, match="a checkpoint of this configuration; got .*checkpoint.safetensors: .*; re"):
        load_checkpoint(path, network, ema, optimizer)


def test_a_checkpoint_on_a_full_disk_is_one_sentence_and_the_one_before_stays(toy, tmp_path, monkeypatch):
    network, ema = (GAPRNet(toy.small_config(superpoints=(10, 20), width=8, global_width=16)) for _ in range(2))
    optimizer, path = torch.optim.AdamW(network.parameters()), tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, network, ema, optimizer, {"step": 1})
    (tmp_path / "other.txt").touch()
    assert path.stat().st_mode == (tmp_path / "other.txt").stat().st_mode  # it was 0600: nobody else could read weights

    def full(tensors, name, metadata):
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(weights, "save_file", full)
    with pytest.raises(ConfigError, match=r"checkpoint.safetensors \(I/O error: No space left .*free some space"):
        save_checkpoint(path, network, ema, optimizer, {"step": 2})
    assert load_checkpoint(path, network, ema, optimizer) == {"step": 1}
    assert len(list(tmp_path.iterdir())) == 2


def test_what_a_yaml_names_is_found_from_any_working_folder(tmp_path, monkeypatch):
    root = Path(__file__).parents[3]
    monkeypatch.chdir(tmp_path)
    paper = read_config(root / "config" / "train_paper.yaml")
    assert paper.network() == ModelConfig.from_yaml(root / "config" / "model" / "faithful_small.yaml")
    monkeypatch.chdir(root)
    assert read_config(Path("config/train_paper.yaml")).model == "config/model/faithful_small.yaml"


def test_the_card_of_an_export_states_no_licence_of_data_that_the_run_did_not_have(tmp_path):

    def of(people):
        return {"provenance": [{"data": {"train_people": people}}]}

    assert export.card(of(0))["licences"] == {"all bones": export.PARAMETRIC}
    assert export.card(of(9))["licences"] == {"licences": export.NOT_STATED} and "9 train" in export.card(of(9))["data"]
    (tmp_path / "own.yaml").write_text("scans: CC BY 4.0\n")
    assert export.card(of(9), tmp_path / "own.yaml")["licences"] == {"scans": "CC BY 4.0"}
    assert len(export.card(of(48), Path(__file__).parents[3] / "config" / "licences.yaml")["licences"]) == 4


def test_a_device_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="a GPU that torch can use; got none, with torch .*; set device to auto"):
        distributed.start("cuda")
    with pytest.raises(ConfigError, match="device one of auto, cpu, cuda"):
        TrainConfig(device="gpu")


@pytest.mark.parametrize(("resume", "is_right"), [(None, True), ("", True), ("first", True), ("frist", False)])
def test_a_slice_that_is_to_go_on_from_a_folder_without_one_is_refused(tmp_path, resume, is_right):
    """With a mistyped path the training began from nothing, without a word."""
    python, script = tmp_path / "python", Path(__file__).parents[3] / "scripts" / "train_on_gpu.sh"
    python.write_text('#!/bin/sh\ncd "$5"\ntouch weights.safetensors\necho 1 | tee -a checkpoint.safetensors log.csv\n')
    python.chmod(0o755)

    def train(out, **given):
        given |= {"OUT": str(tmp_path / out), "RUN": str(tmp_path / f"{out}_run"), "PYTHON": str(python)}
        return subprocess.run(["bash", script], env={**os.environ, **given}, capture_output=True, text=True)

    assert train("first").returncode == 0
    given = {} if resume is None else {"RESUME": resume and str(tmp_path / resume)}
    second = train("second", **given)
    assert (second.returncode == 0) == is_right == (tmp_path / "second").exists(), second.stderr
    if is_right:
        steps = (tmp_path / "second_run" / "checkpoint.safetensors").read_text().split()
        assert len(steps) == (2 if resume else 1)
    else:
        assert f"as RESUME; got {tmp_path / resume} without run.tar.gz; correct the path, or" in second.stderr
