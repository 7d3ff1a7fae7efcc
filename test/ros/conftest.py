"""Fixtures of the ROS tests; they need rclpy (`pip install .[ros]`, or a sourced ROS)."""

from __future__ import annotations

import gc
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

ROS_IS_MISSING = find_spec("rclpy") is None
collect_ignore_glob = ["test_*.py"] if ROS_IS_MISSING else []
FAILED_TO_START = pytest.StashKey[bool]()


def pytest_collection_modifyitems(items) -> None:
    """Nodes start in seconds, on a busy machine in minutes."""
    for item in items:
        if Path(__file__).parent in item.path.parents and item.get_closest_marker("timeout") is None:
            item.add_marker(pytest.mark.timeout(500))


def pytest_report_header() -> str:
    return "rclpy: " + ("missing, test/ros is left out" if ROS_IS_MISSING else "found")


@pytest.fixture(scope="session", autouse=True)
def _what_lives_before_any_node_is_not_looked_through_again():
    """Every test collects the nodes of the one before: among all objects of the other tests that takes seconds."""
    gc.collect()
    gc.freeze()


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


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """A failed test shows what its nodes wrote."""
    report = yield
    if report.failed:
        for node in _running_nodes():
            code = node.process.poll()
            state = "running" if code is None else f"ended with {code}"
            report.sections.append((f"{node.log_path.name}, {state}", node.log[-5000:]))
    if report.when == "setup":
        item.stash[FAILED_TO_START] = report.failed
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """Whatever becomes of a test, the processes that it started end with it, or with the fixture that keeps them."""
    before = _running_nodes()
    result = yield
    for node in _running_nodes():
        if node not in before and (item.stash.get(FAILED_TO_START, False) or not node.keeps):
            node.kill()
    return result


def _running_nodes() -> list:
    harness = sys.modules.get("harness")
    return list(harness.NodeProcess.running) if harness else []
