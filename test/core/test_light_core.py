"""The library as `pip install` without extras gives it: every optional library is absent."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
ABSENT = (
    "torch",
    "safetensors",
    "open3d",
    "matplotlib",
    "jinja2",
    "rich",
    "vtkmodules",
    "small_gicp",
    "rosbags",
    "rclpy",
)


BLOCK = """
import sys
from importlib.abc import MetaPathFinder

class Absent(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in ABSENT:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
from gapr_core.cli import main
"""


def python(code):
    """Code that knows `main`, in a Python in which the optional libraries cannot be imported."""
    code = BLOCK.replace("ABSENT", repr(ABSENT)) + code
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)


def run(*arguments):
    return python(f"sys.exit(main({[str(each) for each in arguments]}))")


@pytest.fixture
def files(tmp_path, femur):
    points, normals = femur.sample(9000, np.random.default_rng(0))
    np.savez(tmp_path / "full.npz", points=femur.points, faces=femur.faces)
    np.save(tmp_path / "partial.npy", points[normals[:, 1] < -0.2])
    return ["--source", tmp_path / "partial.npy", "--target", tmp_path / "full.npz"]


def test_the_search_registers_a_cloud_without_any_optional_library(files, tmp_path):
    done = run("register", *files, "--method", "gapr_search", "--json", tmp_path / "out.json")
    assert done.returncode == 0, done.stderr
    pose = np.array(json.loads((tmp_path / "out.json").read_text())["transform"])
    assert np.abs(pose - np.eye(4)).max() < 0.5


@pytest.mark.parametrize("method", ["gapr", "gapr_network", "gapr_tracker"])
def test_without_torch_the_network_is_refused_and_the_search_is_named(files, method):
    done = run("register", *files, "--method", method)
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and "--method gapr_search" in done.stderr


def test_a_report_without_its_libraries_names_the_extra(files, tmp_path):
    done = run("benchmark", "--pairs", tmp_path, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert "gapr: " in done.stderr and "pip install 'gapr_ros[reports]'" in done.stderr


COMMANDS = ["register", "benchmark", "train", "paper", "settings", "check-points"]
HELP = f"""
for command in {COMMANDS}:
    try:
        main([command, "--help"])
    except SystemExit as ended:
        assert ended.code == 0, command
"""


def test_help_is_given_without_any_optional_library():
    done = python(HELP)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert all(f"usage: gapr {command}" in done.stdout for command in COMMANDS)


def test_a_notebook_offers_the_public_names_before_they_are_used():
    asked = "import gapr_core, sys; print('Registrar' in dir(gapr_core), 'numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]
