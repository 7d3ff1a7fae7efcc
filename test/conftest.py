"""What every test needs: few threads, and ROS graphs that do not see each other or anything outside."""

import os

import domain
import numpy as np
import pytest
from hypothesis import settings

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"  # a message field of the wrong type is an error, not garbage
domain.claim()
settings.register_profile("the same every time", derandomize=True)  # `make fuzz` draws other cases
settings.load_profile("the same every time")


@pytest.fixture
def image():
    """(60, 80, 3) mm: a wavy surface as a pinhole camera sees it from (100, 50, -400); NaN where it saw nothing."""
    row, column = np.mgrid[:60, :80]
    x, y = (column - 36.0) / 400.0, (row - 33.0) / 400.0
    depth = 450.0 + 20.0 * np.sin(40.0 * x) * np.cos(30.0 * y)
    grid = np.stack([x * depth, y * depth, depth], axis=2) + [100.0, 50.0, -400.0]
    grid[::7, ::5] = np.nan
    return grid


@pytest.fixture(autouse=True, scope="session")
def ros_logs(tmp_path_factory):
    """Keep the logs of the nodes under test with the test's other files."""
    os.environ["ROS_LOG_DIR"] = str(tmp_path_factory.mktemp("ros_logs"))
