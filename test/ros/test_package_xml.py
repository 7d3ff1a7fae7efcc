"""package.xml names what the ROS side imports, by the keys that rosdep knows."""

from __future__ import annotations

import ast
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()
DEPENDENCIES = {entry.text for kind in ("depend", "exec_depend") for entry in MANIFEST.findall(kind)}
FILES = [path for folder in ("gapr_ros", "msg_adapters", "launch") for path in sorted((ROOT / folder).rglob("*.py"))]
OWN = {"gapr_core", "gapr_ros", "msg_adapters"}
# where rosdep's key is not the name of the Python package, or its Debian name
KEYS = {
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "open3d": "python3-open3d-pip",
    "rich": "python3-rich",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "tf2_ros": "tf2_ros_py",  # tf2_ros is the C++ package
    "torch": "python3-torch",
    "tqdm": "python3-tqdm",
    "yaml": "python3-yaml",
}


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.split(".")[0]


def test_everything_that_the_ros_side_imports_is_asked_for_by_its_rosdep_key():
    found = {name for path in FILES for name in imports(path)} - OWN - set(sys.stdlib_module_names)
    assert {"rclpy", "sensor_msgs", "launch", "tf2_ros", "rosbags"} <= found
    assert {KEYS.get(name, name) for name in found} <= DEPENDENCIES


@pytest.mark.parametrize(
    "key", ["tf2_ros_py", "python3-torch", "python3-open3d-pip", "python3-rosbags-pip", "python3-numba", "launch_ros"]
)
def test_a_key_that_was_wrong_or_missing_before_is_there(key):
    assert key in DEPENDENCIES
    assert "tf2_ros" not in DEPENDENCIES, "that is the C++ package: Python's is tf2_ros_py"
