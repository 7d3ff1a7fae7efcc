"""A pair's viewpoint reaches every method that can make use of it, and no other."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from shapes import ball_specimen

from gapr_core import cli
from gapr_core.benchmark import runner
from gapr_core.data.pair_files import save_pair
from gapr_core.data.protocols import make_pair
from gapr_core.errors import ConfigError

METHODS = """
import numpy as np
from gapr_core.results import RegistrationResult, RegistrationStatus

class Blind:
    name = "blind"

    def prepare(self, target, units="mm"):
        return target

    def register(self, source, target):
        return RegistrationResult(RegistrationStatus.OK, np.eye(4), confidence=0.5)

class Sighted(Blind):
    name = "sighted"

    def register(self, source, target, initial=None, viewpoint=None):
        pose = np.eye(4)
        pose[:3, 3] = [-1.0, -1.0, -1.0] if viewpoint is None else viewpoint
        return RegistrationResult(RegistrationStatus.OK, pose, confidence=0.5)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "sight_cases.py").write_text(METHODS)
    monkeypatch.syspath_prepend(str(tmp_path))
    pair = make_pair("L3", ball_specimen(), 0)
    pairs = tmp_path / "pairs"
    pairs.mkdir()
    save_pair(pairs / "none.npz", pair)
    save_pair(pairs / "seen.npz", replace(pair, metadata={**pair.metadata, "viewpoint": np.array([1.0, 2.0, 3.0])}))
    return pairs


def shift(transform):
    return np.array(transform)[:3, 3].tolist()


def test_the_benchmark_gives_the_viewpoint_to_a_method_that_takes_one(folder):
    answers = {
        (name, pair): runner.run_task(runner.Task(folder / f"{pair}.npz", f"sight_cases:{name}")).transform
        for name in ("Blind", "Sighted")
        for pair in ("none", "seen")
    }
    assert shift(answers["Sighted", "seen"]) == [1.0, 2.0, 3.0]
    assert shift(answers["Sighted", "none"]) == [-1.0, -1.0, -1.0]
    assert shift(answers["Blind", "seen"]) == [0.0, 0.0, 0.0]


def test_evaluate_gives_the_viewpoint_of_the_pair_file(folder, tmp_path):
    found = {}
    for name in ("Blind", "Sighted"):
        out = tmp_path / f"{name}.json"
        assert cli.main(["evaluate", "--pairs", str(folder), "--out", str(out), "--method", f"sight_cases:{name}"]) == 0
        found[name] = json.loads(out.read_text())
    assert shift(found["Sighted"]["seen"]["transform"]) == [1.0, 2.0, 3.0]
    assert shift(found["Sighted"]["none"]["transform"]) == [-1.0, -1.0, -1.0]
    assert shift(found["Blind"]["seen"]["transform"]) == [0.0, 0.0, 0.0]


def test_pairs_of_any_wrong_protocol_need_no_truth(folder):
    pair = replace(make_pair("L3", ball_specimen(), 0), T_target_source=np.full((4, 4), np.nan))
    runner.check_truth(replace(pair, protocol="scene-wrong"))
    with pytest.raises(ConfigError, match="true `transform`"):
        runner.check_truth(replace(pair, protocol="scene-C1"))
