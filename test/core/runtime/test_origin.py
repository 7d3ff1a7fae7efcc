"""Where an answer comes from."""

import shutil
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
    assert head.startswith(origin.commit().removesuffix("-dirty"))


@pytest.mark.skipif(shutil.which("git") is None, reason="it makes a repository with a tag: apt install git")
def test_a_tag_does_not_hide_the_commit(tmp_path, monkeypatch):

    def git(*words):
        named = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        done = subprocess.run(["git", "-C", str(tmp_path), *named, *words], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    (tmp_path / "gapr_core" / "runtime").mkdir(parents=True)
    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "first")
    git("tag", "-a", "v1.0.0", "-m", "a release")
    monkeypatch.setattr(origin, "__file__", str(tmp_path / "gapr_core" / "runtime" / "origin.py"))
    assert origin.commit() == git("rev-parse", "HEAD")[:12]


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
