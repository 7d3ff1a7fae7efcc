"""Which ROS the node starts under, and what it says where it cannot."""

from __future__ import annotations

import pytest

from gapr_ros import register_node


@pytest.mark.parametrize("name", ["", "jazzy", "kilted", "rolling"])
def test_a_distribution_that_works_and_none_at_all_are_no_problem(name):
    assert register_node.distribution_problem({"ROS_DISTRO": name} if name else {}) == ""


@pytest.mark.parametrize("name", ["humble", "iron", "noetic"])
def test_an_older_distribution_ends_the_program_with_one_line_that_names_those_that_work(name, monkeypatch, capsys):
    monkeypatch.setenv("ROS_DISTRO", name)
    assert register_node.main([]) == 1
    error = capsys.readouterr().err
    assert error.startswith("register_node: expected a sourced ROS 2 jazzy or kilted or rolling, got " + name)
    assert error.count("\n") == 1
