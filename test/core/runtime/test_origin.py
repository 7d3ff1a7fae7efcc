"""Where an answer comes from."""

import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from gapr_core.runtime import origin

ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class Config:
    seed: int = 0


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="the commit is read from a git clone, and this is none")
def test_the_commit_is_that_of_the_source_tree():
    head = subprocess.run(["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True).stdout
    found = origin.commit().removesuffix("-dirty").rpartition("-g")[2]  # after a tag: v1-3-gHASH
    assert head.startswith(found)


def test_other_settings_and_other_weights_are_other_answers(tmp_path, monkeypatch):
    (tmp_path / "a.json").write_text("1")
    monkeypatch.setattr(origin, "WEIGHTS", tmp_path)
    first = origin.of_answers(Config())
    assert origin.of_answers(Config()) == first
    assert origin.of_answers(Config(seed=1))["settings"] != first["settings"]
    (tmp_path / "card.md").write_text("text only")
    assert origin.of_answers(Config()) == first
    (tmp_path / "a.json").write_text("2")
    assert origin.of_answers(Config())["weights"] != first["weights"]
