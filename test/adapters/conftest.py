"""These tests need the ROS message packages (`pip install .[ros]`, or a sourced ROS)."""

from importlib.util import find_spec

ROS_IS_MISSING = find_spec("sensor_msgs") is None
collect_ignore_glob = ["test_*.py"] if ROS_IS_MISSING else []


def pytest_report_header() -> str:
    return "ROS messages: " + ("missing, test/adapters is left out" if ROS_IS_MISSING else "found")
