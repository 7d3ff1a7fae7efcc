"""Fixtures of the ROS tests; they need rclpy (`pip install .[ros]`, or a sourced ROS)."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

ROS_IS_MISSING = find_spec("rclpy") is None
collect_ignore_glob = ["test_*.py"] if ROS_IS_MISSING else []
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
sys.path.insert(0, str(Path(__file__).parent))  # for `import harness`


def pytest_report_header() -> str:
    return "rclpy: " + ("missing, test/ros is left out" if ROS_IS_MISSING else "found")


@pytest.fixture
def client():
    from harness import Client

    made = Client()
    yield made
    made.close()


@pytest.fixture(scope="session")
def blob_path(tmp_path_factory) -> Path:
    """A small model for tests in which no real registration happens."""
    points = np.random.default_rng(0).normal(size=(500, 3)) * [60.0, 20.0, 15.0]
    path = tmp_path_factory.mktemp("model") / "blob.npy"
    np.save(path, points)
    return path


@pytest.fixture
def method():
    from harness import StandIn

    return StandIn()
