"""What the documentation shows is true: its Python examples run, its links lead somewhere, its words exist."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from gapr_core.cli import main
from gapr_core.data import parametric
from gapr_core.geometry import se3
from gapr_core.results import RegistrationStatus
from gapr_ros.demo import write_stl
from gapr_ros.refusal import Reason

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


@pytest.fixture
def bone_and_cloud(tmp_path, monkeypatch):
    """The files that the examples name: a femur, and a view of it from the front, moved."""
    bone, rng = parametric.make_bone("femur", 1), np.random.default_rng(0)
    points, normals = bone.sample(9000, rng)
    seen = points[normals[:, 1] < -0.2] + rng.normal(0.0, 0.3, (int((normals[:, 1] < -0.2).sum()), 3))
    T_source_target = se3.exp([30.0, -20.0, 50.0, 0.5, -0.4, 1.0])
    write_stl(bone, tmp_path / "femur_ct.stl")
    np.save(tmp_path / "partial.npy", se3.apply(T_source_target, seen))
    monkeypatch.chdir(tmp_path)
    return seen


def test_the_python_examples_run_and_find_the_pose(bone_and_cloud):
    names = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    assert names["result"].ok, names["result"]
    assert np.linalg.norm(names["aligned"] - bone_and_cloud, axis=1).max() < 2.0
    assert names["again"].ok


def test_every_link_leads_to_a_file_of_the_repository():
    for page in PAGES:
        for link in re.findall(r"\]\((?!https?:|#)([^)#]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / link).exists(), f"{page.name}: {link}"


def test_every_status_and_every_reason_is_explained():
    conventions = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    for word in [*RegistrationStatus, *Reason]:
        assert f"`{word}`" in conventions, f"{word} is not in docs/conventions.md"


def test_every_make_target_that_is_named_exists():
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    named = set(re.findall(r"(?:^|`)make ([a-z]+)", text, flags=re.MULTILINE))
    assert {"demo", "test", "lint"} <= named <= targets


def test_the_options_that_the_readme_shows_exist(capsys):
    lines = [shlex.split(line, comments=True) for block in blocks("bash") for line in block.splitlines()]
    commands = [line for line in lines if line and line[0] == "gapr"]
    assert len(commands) >= 3
    for _, name, *words in commands:
        with pytest.raises(SystemExit, match="0"):
            main([name, "--help"])
        options = set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
        assert {word for word in words if word.startswith("--")} <= options


def test_the_python_versions_are_those_of_setup_py():
    assert 'python_requires=">=3.10,<3.14"' in (ROOT / "setup.py").read_text()
    assert "Python from 3.10 to 3.13" in README
