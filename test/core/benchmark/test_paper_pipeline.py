"""The paper's pipeline as a method and its tables as commands, with a network of the size of a test."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import yaml

from gapr_core import cli
from gapr_core.benchmark import methods
from gapr_core.benchmark.paper_pipeline import PaperPipeline
from gapr_core.commands import paper
from gapr_core.data.parametric import make_bone
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.metrics import pose_error
from gapr_core.model import weights
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.registration.proposals.network import SHIPPED

TINY = ModelConfig(name="tiny", width=8, global_width=16, superpoints=(12, 24), test_pairs=16, reposition_top=8)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    torch.manual_seed(0)
    weights.save(GAPRNet(TINY), path)
    return path


def test_the_pipeline_finds_the_pose_of_a_clean_pair_with_the_shipped_network():
    pair = make_pair("paper", Specimen(make_bone("pelvis", 4), "pelvis", "parametric_4"), 3)
    method = methods.make("gapr_paper")
    result = method.register(pair.source, method.prepare(pair.target))
    error = pose_error(result.T_target_source, pair.T_target_source, pair.source)
    assert result.method == "gapr_paper" and error.within(10.0, 10.0)  # nothing refines it


def test_a_name_may_bring_its_weights_and_a_refinement(tiny):
    assert methods._with_weights("gapr_paper@a/b+c.safetensors+point_to_plane") == (
        "gapr_paper+point_to_plane",
        "a/b+c.safetensors",
    )
    method = methods.make(f"gapr_paper@{tiny}")
    assert isinstance(method, PaperPipeline) and method.network.config == TINY and method.name == f"gapr_paper@{tiny}"
    assert methods.make(f"gapr_paper@{tiny}+point_to_plane").name == f"gapr_paper@{tiny}+point_to_plane"
    methods.check([f"gapr_paper@{tiny}", "gapr_paper"])
    with pytest.raises(ConfigError, match="gapr_paper"):
        methods.check(["gapr_papier@x"])


def test_a_source_that_nothing_matches_is_a_refusal_with_a_reason(tiny):
    method = methods.make(f"gapr_paper@{tiny}")
    target = np.random.default_rng(1).normal(size=(900, 3)) * 50.0
    result = method.register(np.random.default_rng(0).normal(size=(20, 3)) * 1e-3, target)
    assert result.T_target_source is None and result.reason


def test_table_one_is_one_command(tiny, tmp_path):
    arguments = ["paper", "--table", "1", "--weights", str(tiny), "--bones", "femur", "--count", "1"]
    assert cli.main([*arguments, "--out", str(tmp_path)]) == cli.OK
    text = (tmp_path / "table.md").read_text()
    assert "gapr_paper@" in text and "GAPR-Net" in text and "icp" in text
    manifest = json.loads((tmp_path / "pairs" / "manifest.json").read_text())
    assert manifest["recipe"]["split"] == "test" and manifest["recipe"]["protocols"] == ["paper"]


def test_tables_one_to_three_use_the_weights_that_ship_or_those_named(tiny, tmp_path, monkeypatch):
    used = []
    monkeypatch.setattr(paper, "benchmark", lambda pairs, methods, out, jobs, ours: used.append((methods[0], ours)))
    for number, named in enumerate(([], ["--weights", str(tiny)])):
        arguments = ["paper", "--table", "3", "--bones", "femur", "--count", "1", *named]
        assert cli.main([*arguments, "--out", str(tmp_path / str(number))]) == cli.OK
    assert used == [("gapr_paper", "gapr_paper"), (f"gapr_paper@{tiny}", f"gapr_paper@{tiny}")]


def test_without_weights_or_budget_the_command_says_what_is_missing(tmp_path, capsys):
    for arguments, wanted in ((["--table", "2", "--weights", "none"], "--weights"), (["--table", "5"], "--pairs")):
        assert cli.main(["paper", *arguments, "--out", str(tmp_path / "x")]) == cli.BAD_INPUT
        assert wanted in capsys.readouterr().err


def test_tables_four_and_five_are_rows_of_the_plan():
    from gapr_core.training.config import default_plan, read_plan

    plan = read_plan(default_plan().parent / "ablation_paper.yaml")
    assert {row.table for row in plan} == {table for tables in paper.TRAINED.values() for table in tables}


def test_table_four_trains_every_row_and_examines_it_with_ransac(tmp_path, monkeypatch):
    from gapr_core.training.ablation import cli as ablation

    asked = {}

    def ablate(plan, config, out, folder, recipe, seeds, jobs, minutes, pose):
        asked.update(rows=[v.model.stem for v in plan], config=config, recipe=recipe, pose=pose)
        return 3

    monkeypatch.setattr(ablation, "ablate", ablate)
    settings = tmp_path / "own.yaml"
    settings.write_text(yaml.safe_dump({"mix": {"paper": 1.0}}))
    assert cli.main(["paper", "--table", "4", "--pairs", "8", "--config", str(settings), "--out", str(tmp_path)]) == 0
    assert len(asked["rows"]) == 6 and asked["pose"] == "ransac" and asked["config"].pairs == 8
    assert asked["recipe"].protocols == ("paper",) and asked["recipe"].split == "test"


def test_our_methods_take_weights_of_ones_own_with_a_warning_and_another_name_in_records(tmp_path, caplog):
    own = tmp_path / "own.safetensors"
    own.write_bytes(SHIPPED.read_bytes())
    name = methods.OURS + f"@{own}"
    method = methods.make(name)
    assert not method.proposers[0].is_shipped and "fitted to the shipped weights" in caplog.text
    assert methods.is_own(name) and methods.made_of(name) not in ("", methods.made_of(methods.OURS))
    with pytest.raises(ConfigError, match="weights for a method with a network; got gapr_search"):
        methods.make(f"gapr_search@{own}")
