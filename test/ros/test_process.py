"""The process of the node: how it ends."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gapr_ros import register_node

STOPPED_WHILE_STARTING = """
import sys, rclpy, rclpy.executors
from gapr_ros.node import lifecycle
from gapr_ros import register_node

def stopped_before(made):
    def make(*args, **kwargs):
        rclpy.shutdown()
        return made(*args, **kwargs)
    return make

if sys.argv[1] == "node":
    lifecycle.RegisterNode = stopped_before(lifecycle.RegisterNode)
else:
    rclpy.executors.SingleThreadedExecutor = stopped_before(rclpy.executors.SingleThreadedExecutor)
sys.exit(register_node.main(sys.argv[2:]))
"""


@pytest.mark.parametrize("before", ["node", "executor"])
def test_a_node_that_is_asked_to_stop_while_it_starts_ends_with_0_and_says_nothing(before):
    """A signal shuts the context down; what is made in it then raises errors of several words."""
    command = [sys.executable, "-c", STOPPED_WHILE_STARTING, before, "--ros-args", "-p", "autostart:=false"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0 and "register_node:" not in ended.stderr, ended.stderr


def test_help_shows_a_command_line_and_starts_no_node(capsys, monkeypatch):
    monkeypatch.setattr(register_node, "distribution_problem", pytest.fail)
    assert register_node.main(["--help"]) == 0
    assert "-p model_path:=" in capsys.readouterr().out


def test_without_rclpy_one_line_says_what_to_install(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert register_node.main([]) == 1
    error = capsys.readouterr().err
    assert "pip install '.[ros]'" in error and error.count("\n") == 1
