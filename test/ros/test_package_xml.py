"""package.xml names all that the ROS side needs, by the keys that rosdep knows; pip installs the rest."""

from __future__ import annotations

import ast
import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from imported import imported_roots

ROOT = Path(__file__).parents[2]
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()
NEEDED = re.compile(r"^(?:CORE|NETWORK|DATA|REPORTS|BAGS) = (\[.*?\])", re.MULTILINE | re.DOTALL)
PIP_ONLY = ("libigl", "safetensors", "threadpoolctl")  # rosdep has no key for them
DEPENDENCIES = {entry.text for kind in ("depend", "exec_depend") for entry in MANIFEST.findall(kind)}
FILES = [path for folder in ("gapr_ros", "msg_adapters", "launch") for path in sorted((ROOT / folder).rglob("*.py"))]
OWN = {"gapr_core", "gapr_ros", "msg_adapters"}
# where rosdep's key is not the name of the Python package, or its Debian name
KEYS = {
    "jinja2": "python3-jinja2",
    "matplotlib": "python3-matplotlib",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "open3d": "python3-open3d-pip",
    "pillow": "python3-pil",
    "plyfile": "python3-plyfile-pip",
    "pyyaml": "python3-yaml",
    "rich": "python3-rich",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "tf2_ros": "tf2_ros_py",  # tf2_ros is the C++ package
    "torch": "python3-torch",
    "tqdm": "python3-tqdm",
    "yaml": "python3-yaml",
}


def test_everything_that_the_ros_side_imports_is_asked_for_by_its_rosdep_key():
    found = {name for path in FILES for name in imported_roots(path)} - OWN - set(sys.stdlib_module_names)
    assert {"rclpy", "sensor_msgs", "launch", "tf2_ros", "rosbags"} <= found
    assert {KEYS.get(name, name) for name in found} <= DEPENDENCIES


def test_every_library_that_pip_would_install_has_a_rosdep_key_or_is_named_as_left_to_pip():
    lists = NEEDED.findall((ROOT / "setup.py").read_text())
    libraries = {re.match(r"\w+", text)[0] for found in lists for text in ast.literal_eval(found)}
    assert len(lists) == 5 and {"numpy", "torch", "rosbags", *PIP_ONLY} <= libraries
    assert {KEYS[name] for name in libraries - set(PIP_ONLY)} <= DEPENDENCIES
    for page in ("package.xml", "docs/tutorials/ros.md"):
        assert all(name in (ROOT / page).read_text() for name in PIP_ONLY)
