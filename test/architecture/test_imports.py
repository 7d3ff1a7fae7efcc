"""Who may import whom, and what an import costs."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from imported import imported_roots

ROOT = Path(__file__).parents[2]
PACKAGES = ("gapr_core", "msg_adapters", "gapr_ros")


def third_party(package):
    names = {name for path in (ROOT / package).rglob("*.py") for name in imported_roots(path)}
    return names - set(sys.stdlib_module_names) - set(PACKAGES)


def loaded_by(statement):
    """Names of all modules that are loaded after the statement, in a fresh Python."""
    code = f"import sys; {statement}; print(' '.join(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(run.stdout.split())


def test_the_import_contracts_hold():
    run = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command; lint_imports_command()"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout + run.stderr


def test_importing_the_core_loads_neither_torch_nor_open3d_nor_numba():
    loaded = loaded_by("import gapr_core")
    assert "gapr_core" in loaded
    assert loaded.isdisjoint({"torch", "open3d", "numba", "matplotlib", "jinja2", "vtkmodules", "rclpy"})


def test_the_shipped_registrar_loads_no_library_of_statistics_or_pictures():
    loaded = loaded_by("from gapr_core import Registrar; Registrar.from_pretrained()")
    assert loaded.isdisjoint({"scipy.stats", "open3d", "matplotlib", "vtkmodules"})


def test_the_command_line_answers_without_loading_torch_or_open3d():
    loaded = loaded_by("from gapr_core.cli import main")
    assert loaded.isdisjoint({"torch", "open3d", "numba", "rclpy"})


def test_message_adapters_import_numpy_and_messages_only():
    others = {name for name in third_party("msg_adapters") if name != "numpy" and not is_message_package(name)}
    assert not others


def is_message_package(name):
    return name.endswith(("_msgs", "_srvs", "_interfaces"))


DISTRIBUTIONS = {
    "PIL": "pillow",
    "igl": "libigl",
    "yaml": "pyyaml",
    "skimage": "scikit-image",
    "vtkmodules": "vtk",
    "small_gicp": "small_gicp",
    "kiss_matcher": "kiss-matcher",
}
FROM_ROS = {"rclpy", "tf2_ros", "ament_index_python", "rpyutils"}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_library_that_is_imported_is_declared_in_setup_py(package):
    declared = set(re.findall(r'"([A-Za-z0-9_-]+)(?:[<>=~!;][^"]*)?"', (ROOT / "setup.py").read_text()))
    imported = {name for name in third_party(package) if name not in FROM_ROS and not is_message_package(name)}
    assert {DISTRIBUTIONS.get(name, name) for name in imported} <= declared


@pytest.mark.parametrize("name", ["rclpy", *sorted(n for n in third_party("gapr_ros") if is_message_package(n))])
def test_every_ros_package_that_is_imported_is_declared_in_package_xml(name):
    assert f"<exec_depend>{name}</exec_depend>" in (ROOT / "package.xml").read_text()
