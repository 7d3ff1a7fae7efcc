"""`gapr demo`, from the command line to the report, and what it does when things go wrong."""

import argparse
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from gapr_core.geometry import se3
from gapr_ros import demo, demo_report
from gapr_ros.children import child
from gapr_ros.demo_report import Row
from gapr_ros.observer import Answer

RUN = "import argparse, sys; from gapr_ros import demo; p = argparse.ArgumentParser(); demo.add_arguments(p); " \
      "sys.exit(demo.run(p.parse_args()))"  # fmt: skip


def start(*arguments):
    return subprocess.Popen(
        [sys.executable, "-c", RUN, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def processes_naming(text):
    """Command lines of running processes that contain the text."""
    found = []
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{pid}/cmdline", "rb") as file:
                command = file.read().decode(errors="replace")
        except OSError:
            continue
        if text in command and int(pid) != os.getpid():
            found.append(command)
    return found


def test_the_demo_finds_right_poses_and_writes_its_report(tmp_path):
    process = start("--out", str(tmp_path), "--frames", "8", "--period", "1.0")
    output, _ = process.communicate(timeout=110)
    assert process.returncode == 0, output
    assert "right poses" in output and "WRONG" not in output
    assert (tmp_path / "bag" / "metadata.yaml").is_file() and (tmp_path / "femur.stl").is_file()
    assert (tmp_path / "report.png").stat().st_size > 20_000
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "From a bag to a trusted pose" in page and "Plotly.newPlot(" in page
    assert not processes_naming(str(tmp_path))


def own_nodes(folder):
    return [command for command in processes_naming("gapr_ros.register_node") if str(folder) in command]


def test_ctrl_c_ends_the_demo_and_its_node(tmp_path):
    process = start("--out", str(tmp_path), "--frames", "30")
    deadline = time.monotonic() + 80.0
    while not (ours := own_nodes(tmp_path)) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert ours
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 130, output
    assert "Traceback" not in output
    assert not own_nodes(tmp_path)


def test_a_node_that_cannot_start_ends_the_demo_with_its_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "write_stl", lambda surface, path: path.write_text("this is no mesh"))
    monkeypatch.setenv("ROS_DOMAIN_ID", os.environ["ROS_DOMAIN_ID"])
    parser = argparse.ArgumentParser()
    demo.add_arguments(parser)
    lines = []
    monkeypatch.setattr("rich.console.Console.print", lambda self, *text, **_: lines.extend(map(str, text)))
    assert demo.run(parser.parse_args(["--out", str(tmp_path), "--frames", "2"])) == 1
    assert "femur.stl" in " ".join(lines)


def test_an_unknown_bone_is_one_clear_line(tmp_path):
    process = start("--out", str(tmp_path), "--bone", "banana")
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "banana" in output and "femur" in output and "Traceback" not in output


def test_a_child_that_ignores_ctrl_c_is_ended_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr("gapr_ros.children.PATIENCE_S", 0.5)
    (tmp_path / "stubborn.py").write_text(
        "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); print('up', flush=True); time.sleep(60)"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with child("stubborn", [], tmp_path / "log") as process:
        while "up" not in (tmp_path / "log").read_text():
            time.sleep(0.05)
    assert process.returncode == -signal.SIGKILL


CLOUD = np.random.default_rng(0).normal(0.0, 30.0, (300, 3))
TRUTH = se3.exp([10.0, 20.0, 30.0, 0.3, 0.2, 0.1])


def judged(*answers):
    scene = SimpleNamespace(
        sweep=SimpleNamespace(clouds=(CLOUD,) * len(answers), T_target_source=TRUTH), stamp_ms=lambda frame: frame
    )
    return demo_report.judge(scene, {k: answer for k, answer in enumerate(answers) if answer is not None})


def moved(shift_mm, turn_deg):
    twist = [shift_mm, 0.0, 0.0, 0.0, 0.0, np.radians(turn_deg)]
    return Answer(T_target_source=se3.exp(twist, se3.apply(TRUTH, CLOUD).mean(axis=0)) @ TRUTH, confidence=0.9)


def test_poses_are_judged_against_the_truth():
    rows = judged(moved(0.0, 0.0), moved(3.9, 0.0), moved(4.1, 0.0), moved(0.0, 4.9), moved(0.0, 5.1))
    assert [row.mark for row in rows] == ["ok", "ok", "bad", "ok", "bad"]
    assert rows[1].error_mm == pytest.approx(3.9) and rows[3].error_deg == pytest.approx(4.9)


def test_the_demo_passes_only_when_poses_came_and_none_was_wrong():
    refused = Answer(refusal="ambiguous: another pose fits as well")
    assert demo_report.passed(judged(refused, moved(1.0, 1.0), None))
    assert not demo_report.passed(judged(refused, None))
    assert not demo_report.passed(judged(moved(1.0, 1.0), moved(90.0, 0.0)))


def test_a_row_says_what_became_of_its_cloud():
    cells = [row.cells()[2] for row in judged(Answer(refusal="stale: old"), None, moved(50.0, 0.0))]
    assert cells == ["refused: stale: old", Row(1, 0, None).cells()[2], "WRONG pose"]
    assert "newer cloud" in cells[1]
