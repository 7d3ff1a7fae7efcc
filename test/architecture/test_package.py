"""The package as ROS and pip see it."""

import os
import re
import signal
import subprocess
import sys
import tarfile
import xml.etree.ElementTree as ElementTree
import zipfile
from importlib.metadata import PathDistribution, entry_points
from pathlib import Path

import pytest

import gapr_core

pytestmark = pytest.mark.timeout(600)  # building compiles all loops: minutes on a machine that is busy

ROOT = Path(__file__).parents[2]
PACKAGES = ("gapr_core", "msg_adapters", "gapr_ros")
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()


def setup_py(field):
    return re.search(rf'(?i)\b{field} ?= ?"([^"]+)"', (ROOT / "setup.py").read_text())[1]


@pytest.mark.parametrize("field", ["version", "license", "maintainer", "url"])
def test_package_xml_and_setup_py_agree_on(field):
    assert MANIFEST.find(field).text == setup_py(field)


def test_the_version_is_the_same_in_setup_py_package_xml_the_library_and_the_changelog():
    latest = re.search(r"^(\d+\.\d+\.\d+) \(", (ROOT / "CHANGELOG.rst").read_text(), flags=re.MULTILINE)[1]
    assert setup_py("version") == MANIFEST.find("version").text == gapr_core.__version__ == latest


def test_every_entry_point_leads_to_something_that_can_be_called():
    ours = [
        e
        for group in ("console_scripts", "gapr.commands", "gapr.sources")
        for e in entry_points(group=group)
        if e.dist.name.replace("-", "_") == "gapr_ros"
    ]
    assert {"gapr", "register_node", "bag_replay", "demo", "mcap", "db3"} <= {e.name for e in ours}
    for entry in ours:
        loaded = entry.load()
        promised = {"gapr.commands": ("add_arguments", "run"), "gapr.sources": ("read", "UNIT")}.get(entry.group)
        assert all(hasattr(loaded, name) for name in promised) if promised else callable(loaded)


def test_kiss_matcher_is_not_asked_for_on_a_python_that_it_has_no_wheel_for():
    asked = re.findall(r'"(kiss-matcher[^"]*)"', (ROOT / "setup.py").read_text())
    assert asked == ["kiss-matcher; python_version < '3.13'"]


def test_every_folder_of_code_is_a_package_and_gets_installed():
    folders = {path.parent for name in PACKAGES for path in (ROOT / name).rglob("*.py")}
    assert len(folders) > 5
    assert not [str(folder.relative_to(ROOT)) for folder in folders if not (folder / "__init__.py").is_file()]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A colcon workspace with this package, built."""
    return build(tmp_path_factory.mktemp("workspace"))


def build(base, *options):
    """A workspace in `base`."""
    folders = [f"--{kind}-base={base / kind}" for kind in ("build", "install")]
    colcon = [sys.executable, "-m", "colcon", f"--log-base={base / 'log'}", "build", *folders, *options]
    run = subprocess.run([*colcon, "--base-paths", str(ROOT)], cwd=base, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    return base


def test_colcon_build_gives_an_executable_that_ros2_run_finds(workspace):
    prefix = workspace / "install" / "gapr_ros"
    assert (prefix / "share/ament_index/resource_index/packages/gapr_ros").is_file()
    assert (prefix / "share/gapr_ros/package.xml").is_file()
    assert (prefix / "share/gapr_ros/config/register_node.yaml").is_file()
    for name in ("register_node", "bag_replay", "gapr"):
        assert os.access(prefix / "lib/gapr_ros" / name, os.X_OK)


def test_a_workspace_of_links_runs_the_code_in_place(tmp_path):
    program = build(tmp_path, "--symlink-install") / "install/gapr_ros/lib/gapr_ros/register_node"
    where = "python3 -c 'import gapr_ros.register_node as r; print(r.__file__)'"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    command = f"source install/setup.bash && {where} && {program} --help"
    run = subprocess.run(["bash", "-c", command], cwd=tmp_path, env=environment, capture_output=True, text=True)
    file, usage = run.stdout.splitlines()[:2]
    assert tmp_path in Path(file).parents and Path(file).resolve() == ROOT / "gapr_ros/register_node.py"
    assert usage.startswith("usage: register_node")


def test_everything_that_the_code_reads_is_installed_with_it(workspace):
    (site,) = (workspace / "install/gapr_ros/lib").glob("python*/site-packages")
    files = [path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.is_file()]
    files = [path.relative_to(ROOT) for path in files if "__pycache__" not in path.parts]
    assert len(files) > 50
    assert not [str(path) for path in files if not (site / path).is_file()]


REGISTER = """
import numpy as np
from gapr_core import Accumulator, Registrar, Tracker
from gapr_core.data.parametric import make_bone

rng, bone = np.random.default_rng(1), make_bone("tibia", 1)
points, normals = bone.sample(6000, rng)
seen, registrar = points[normals[:, 1] < -0.2], Registrar.from_pretrained()
print(registrar.__class__.register.__globals__["__file__"])
for method in (registrar, Registrar(), Tracker(registrar), Accumulator(Tracker(registrar), 3)):
    target = method.prepare(bone)
    for number in range(3):
        method.register(seen[number:], target)
registrar.register(np.concatenate([seen, seen + 50.0]), registrar.prepare(points), viewpoint=[0.0, -500.0, 0.0])
"""


def test_no_registration_of_an_installed_package_waits_for_a_compiler(workspace):
    (site,) = (workspace / "install/gapr_ros/lib").glob("python*/site-packages")
    before = {path: path.stat().st_mtime_ns for path in site.rglob("*.nb[ic]")}
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment |= {"PYTHONPATH": str(site)}
    run = subprocess.run(
        [sys.executable, "-c", REGISTER], cwd=workspace, env=environment, capture_output=True, text=True
    )
    assert run.returncode == 0 and str(site) in run.stdout, run.stdout + run.stderr
    assert len(before) > 40
    assert {path: path.stat().st_mtime_ns for path in site.rglob("*.nb[ic]")} == before


@pytest.mark.parametrize(("compiled", "tag"), [
    ("no", "py3-none-any"),
    pytest.param("yes", f"cp3{sys.version_info.minor}-none-linux_x86_64", marks=pytest.mark.slow),
])  # fmt: skip
def test_the_tag_of_a_wheel_tells_whether_it_holds_compiled_loops(tmp_path, compiled, tag):
    command = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(tmp_path), "build", "--build-base",
               str(tmp_path / "build"), "bdist_wheel", "-d", str(tmp_path)]  # fmt: skip
    environment = os.environ | {"GAPR_COMPILED": compiled}
    subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.endswith(f"-{tag}.whl")
    folder = zipfile.Path(wheel)
    assert any(name.endswith(".nbc") for name in folder.root.namelist()) is (compiled == "yes")
    (information,) = (each for each in folder.iterdir() if each.name.endswith(".dist-info"))
    metadata = PathDistribution(information).metadata
    assert metadata["Version"] in metadata.as_string() and "](docs/" not in metadata.as_string()


def test_a_source_archive_holds_what_builds_it(tmp_path):
    command = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(tmp_path), "sdist", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as packed:
        names = {Path(*Path(name).parts[1:]).as_posix() for name in packed.getnames()}
    assert {"setup.py", "pyproject.toml", "scripts/build_backend.py", "config/register_node.yaml"} <= names


def test_a_build_without_a_compiler_is_whole_and_says_what_it_lacks(tmp_path):
    """What an earlier build compiled is thrown away."""
    stale = tmp_path / "built/gapr_core/registration/__pycache__/kernels.step-1.py311.1.nbc"
    stale.parent.mkdir(parents=True)
    stale.touch()
    (tmp_path / "numba.py").write_text("raise ImportError('no compiler here')")
    command = [sys.executable, "setup.py", "build_py", "--build-lib", str(tmp_path / "built")]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert run.returncode == 0 and "the loops are not compiled" in run.stdout + run.stderr
    assert (tmp_path / "built/gapr_core/registration/fit/kernels.py").is_file()
    assert not list((tmp_path / "built").rglob("*.nbc"))


def test_the_node_that_colcon_built_starts_and_uses_the_installed_code(workspace):
    node = workspace / "install/gapr_ros/lib/gapr_ros/register_node"
    where = "python3 -c 'import gapr_ros; print(gapr_ros.__file__)'"
    command = f"source install/setup.bash; {where}; exec {node} --ros-args -p model_path:=/no/such/file.stl 2>&1"
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    process = subprocess.Popen(
        ["bash", "-c", command], cwd=workspace, env={**os.environ, "PATH": path}, stdout=subprocess.PIPE, text=True
    )
    lines = []
    for line in process.stdout:
        lines.append(line)
        if "file.stl" in line:  # the node is up, and says why it cannot be configured
            break
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)
    assert str(workspace / "install") in lines[0], lines
    assert "file.stl" in lines[-1], lines
