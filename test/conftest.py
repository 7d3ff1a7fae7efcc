"""What every test needs: few threads, and ROS graphs that do not see each other or anything outside."""

import os

import pytest

WORKER = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(1 + (os.getppid() * 7 + int(WORKER)) % 100)  # 1..101; two runs at once rarely collide
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"  # a message field of the wrong type is an error, not garbage


@pytest.fixture(autouse=True, scope="session")
def ros_logs(tmp_path_factory):
    """Keep the logs of the nodes under test with the test's other files."""
    os.environ["ROS_LOG_DIR"] = str(tmp_path_factory.mktemp("ros_logs"))
