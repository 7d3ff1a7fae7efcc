"""What every test needs: few threads, and ROS graphs that do not see each other or anything outside."""

import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent / "ros"))
import domain  # noqa: E402

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"  # a message field of the wrong type is an error, not garbage
domain.claim()
settings.register_profile("the same every time", derandomize=True)  # `make fuzz` draws other cases
settings.load_profile("the same every time")


@pytest.fixture(autouse=True, scope="session")
def ros_logs(tmp_path_factory):
    """Keep the logs of the nodes under test with the test's other files."""
    os.environ["ROS_LOG_DIR"] = str(tmp_path_factory.mktemp("ros_logs"))
