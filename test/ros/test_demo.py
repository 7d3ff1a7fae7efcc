"""`gapr demo`, from the command line to the report, and what it does when things go wrong."""

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from harness import context
from rclpy.time import Time
from std_msgs.msg import Header

from gapr_core.data.pool import parametric_specimen
from gapr_core.data.scenes.stream import SceneMotion, simulate
from gapr_core.geometry import se3
from gapr_ros.demo import cli as demo
from gapr_ros.demo import guided, interrupt
from gapr_ros.demo import report as demo_report
from gapr_ros.demo.act import Act, DemoError, act_of_pairs, probe_sweep, write_bag
from gapr_ros.demo.children import child
from gapr_ros.demo.observer import Advice, Answer, Observer, Used
from gapr_ros.demo.report import Row
from gapr_ros.demo.running import as_arguments
from gapr_ros.node import units
from msg_adapters import matrix_to_pose, xyz_to_cloud

RUN = (
    "import argparse, sys; from gapr_ros.demo import cli; p = argparse.ArgumentParser(); cli.add_arguments(p); "
    "sys.exit(cli.run(p.parse_args()))"
)


@pytest.mark.parametrize("out", ["/proc/d", "a_file", "a_file/d"])
def test_a_folder_that_cannot_be_made_is_one_line_before_the_work(tmp_path, monkeypatch, capsys, out):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_file").touch()
    parser = argparse.ArgumentParser()
    demo.add_arguments(parser)
    assert demo.run(parser.parse_args(["--out", out])) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert f"expected a path that can be written; got {out}" in said and "choose another path" in said
    assert "Errno" not in said and "Making" not in said


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
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    assert "right poses" in output and "WRONG" not in output
    assert (tmp_path / "bag" / "metadata.yaml").is_file() and (tmp_path / "demo_femur.stl").is_file()
    assert (tmp_path / "report.png").stat().st_size > 20_000
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "From a bag to a trusted pose" in page and 'alt="points on the bone"' in page
    assert not processes_naming(str(tmp_path))


def own_nodes(folder):
    return [command for command in processes_naming("gapr_ros.register_node") if str(folder) in command]


def test_ctrl_c_ends_the_demo_and_its_node(tmp_path):
    process = start("--out", str(tmp_path), "--frames", "30")
    deadline = time.monotonic() + 200.0
    while not (ours := own_nodes(tmp_path)) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert ours
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=200)
    assert process.returncode == 130, output
    assert "Traceback" not in output
    assert not own_nodes(tmp_path)


def test_ctrl_c_that_a_library_swallows_is_raised_again():
    interrupt.check()
    before = signal.getsignal(signal.SIGINT)
    with interrupt.heeded():
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            interrupt.check()
    assert signal.getsignal(signal.SIGINT) is before
    with interrupt.heeded():
        interrupt.check()


@pytest.mark.parametrize(
    ("act", "named"), [([], "demo_femur.stl"), ([], "none.safetensors"), (["--guided"], "none.safetensors")]
)
def test_a_node_that_cannot_start_ends_the_demo_with_its_reason(tmp_path, monkeypatch, act, named):
    if named == "demo_femur.stl":
        monkeypatch.setattr("gapr_ros.demo.act.write_stl", lambda surface, path: path.write_text("this is no mesh"))
    else:
        act = [*act, "--weights", str(tmp_path / named)]
    monkeypatch.setenv("ROS_DOMAIN_ID", os.environ["ROS_DOMAIN_ID"])
    parser = argparse.ArgumentParser()
    demo.add_arguments(parser)
    lines = []
    monkeypatch.setattr("rich.console.Console.print", lambda self, *text, **_: lines.extend(map(str, text)))
    assert demo.run(parser.parse_args([*act, "--out", str(tmp_path), "--frames", "2"])) == 1
    assert named in " ".join(lines)


def test_the_demo_replaces_a_bag_of_its_own_and_no_other(tmp_path):
    act = Act("femur", None, tmp_path, (CLOUD,), (TRUTH,), 0.1, "", "")
    for _ in range(2):
        write_bag(act, tmp_path / "bag", "mcap")
    assert (tmp_path / "bag" / "metadata.yaml").is_file()
    mine = tmp_path / "mine" / "recording.mcap"
    mine.parent.mkdir()
    mine.write_bytes(b"of an afternoon in the laboratory")
    with pytest.raises(DemoError, match="which no demo wrote; choose another --out"):
        write_bag(act, mine.parent, "mcap")
    assert mine.read_bytes() == b"of an afternoon in the laboratory"


def test_the_demo_does_not_write_over_a_bone_of_its_user(tmp_path, monkeypatch):
    mine = [tmp_path / "femur.stl", tmp_path / "tibia.stl"]
    for path in mine:
        path.write_bytes(b"of a CT")
    act = probe_sweep("femur", 1, 2, 1.0, tmp_path)
    follow_scripted(monkeypatch, tmp_path, [(Answer(refusal="tf_missing: ..."), None)])  # on a tibia
    assert [path.read_bytes() for path in mine] == [b"of a CT"] * 2
    assert act.path.is_file() and (tmp_path / "demo_tibia.stl").is_file()


@pytest.mark.parametrize("words", ["--frames 0", "--frames x", "--seed -1", "--seed x", "--period 0", "--period 0.0004",
                                   "--period nan", "--period inf", "--period x"])  # fmt: skip
def test_a_number_that_no_demo_can_use_is_refused_in_one_line(capsys, words):
    """Answers are known by their stamps in ms: with a period of 0 one pose was shown for every cloud."""
    parser = argparse.ArgumentParser()
    demo.add_arguments(parser)
    option, value = words.split()
    with pytest.raises(SystemExit):
        parser.parse_args([option, value])
    said = capsys.readouterr().err
    assert f"argument {option}: expected " in said and f"got {value!r}" in said


def test_an_unknown_bone_is_one_clear_line(tmp_path, capsys):
    parser = argparse.ArgumentParser()
    demo.add_arguments(parser)
    assert demo.run(parser.parse_args(["--out", str(tmp_path), "--bone", "banana"])) == 1
    output = capsys.readouterr().out
    assert "banana" in output and "femur" in output


def test_a_child_that_ignores_ctrl_c_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr("gapr_ros.demo.children.PATIENCE_S", 0.5)
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


def act_of(*clouds, **more):
    surface = parametric_specimen("femur", 1).surface
    return Act("femur", surface, Path("femur.stl"), clouds, (TRUTH,) * len(clouds), 1.0, "title", "lead", **more)


def judged(*answers):
    act = act_of(*(CLOUD for _ in answers))
    return demo_report.judge(act, {act.stamp_ms(k): answer for k, answer in enumerate(answers) if answer is not None})


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


@pytest.mark.slow
def test_the_second_act_finds_right_poses_in_a_wound(tmp_path):
    process = start("--scene", "--out", str(tmp_path), "--frames", "6", "--period", "4.0")
    output, _ = process.communicate(timeout=280)
    assert process.returncode == 0, output
    assert "right %" in output and "WRONG" not in output
    assert 20_000 < (tmp_path / "report.png").stat().st_size < 1_000_000
    assert "What the camera sees" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_third_act_ends_with_a_bone_that_is_known(tmp_path):
    process = start("--guided", "--out", str(tmp_path))
    output, _ = process.communicate(timeout=280)
    assert process.returncode == 0, output
    assert "look 2" in output and "WRONG" not in output
    assert "Where to look next" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_acts_exclude_each_other(capsys):
    parser = argparse.ArgumentParser()
    demo.add_arguments(parser)
    assert [parser.parse_args(words).act for words in ([], ["--scene"], ["--guided"])] == ["sweep", "scene", "guided"]
    with pytest.raises(SystemExit):
        parser.parse_args(["--scene", "--guided"])
    assert "not allowed with" in capsys.readouterr().err


def test_parameters_are_written_as_ros_reads_them():
    assert as_arguments({"guide": True}) == ["-p", "guide:=true"]


def test_the_truth_of_a_scene_lays_its_bone_on_the_file_of_the_bone():
    specimen = parametric_specimen("tibia", 3)
    act = act_of_pairs(specimen, Path("tibia.stl"), list(simulate(specimen, 2, SceneMotion(frames=3))), 2.0)
    assert act.node_parameters["viewpoint"] == "origin"
    for cloud, truth, is_bone in zip(act.clouds, act.truths, act.is_bone, strict=True):
        off = specimen.distance(se3.apply(truth, cloud))
        assert np.median(off[is_bone]) < 1.0 < np.median(off[~is_bone])
        assert (cloud[:, 2] > 300.0).all(), "in the camera's own frame, which looks along z"


def used_of(answer, used, is_taken):
    answer.used = Used(used, is_taken)
    return answer


def test_points_share_the_lot_of_the_nearest_one_that_was_used():
    cloud = np.arange(6.0)[:, None] * [10.0, 0.0, 0.0]
    is_bone = np.array([True, True, True, False, False, False])
    used = cloud[[0, 1, 3, 4]] + [0.5, 0.0, 0.0]
    answer = used_of(moved(0.0, 0.0), used, np.array([True, False, True, False]))
    act = act_of(cloud, is_bone=(is_bone,))
    taken = demo_report.judge(act, {act.stamp_ms(0): answer})[0].taken
    assert taken.looked_at.tolist() == [True, True, False, True, True, False]
    assert taken.is_taken.tolist() == [True, False, False, True, False, False]
    assert taken.right_share == 0.5 and taken.cells() == ("50", "2", "50")


def test_of_a_refused_cloud_no_point_is_taken_for_bone():
    act = act_of(CLOUD, is_bone=(np.ones(len(CLOUD), dtype=bool),))
    refused = used_of(Answer(refusal="clutter: hardly any bone"), CLOUD, np.ones(len(CLOUD), dtype=bool))
    row = demo_report.judge(act, {act.stamp_ms(0): refused})[0]
    assert row.taken.looked_at.all() and not row.taken.is_taken.any()
    assert len(row.cells()) == len(demo_report.columns([row]))
    assert row.cells()[2:6] == ("100", "0", "", "refused: clutter: hardly any bone")


def test_the_report_of_a_scene_shows_what_was_taken(tmp_path):
    specimen = parametric_specimen("femur", 1)
    cloud, _ = specimen.sample(600, np.random.default_rng(0))
    cloud = cloud - cloud.mean(axis=0) + [0.0, 0.0, 450.0]
    is_bone = cloud[:, 0] > 0.0
    act = Act("femur", specimen.surface, Path(), (cloud, cloud), (np.eye(4),) * 2, 1.0, "a wound", "lead",
              is_bone=(is_bone, is_bone))  # fmt: skip
    answers = {act.stamp_ms(0): used_of(Answer(np.eye(4), confidence=0.9), cloud, is_bone)}
    rows = demo_report.judge(act, answers)
    assert [row.mark for row in rows] == ["ok", ""]
    demo_report.write(act, rows, tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "What the camera sees" in page and "data:image/png" in page and "<th>right %</th>" in page
    assert [column.header for column in demo_report.rich_table(rows).columns][:4] == [
        "frame",
        "bone %",
        "taken",
        "right %",
    ]
    assert (tmp_path / "report.png").stat().st_size < 300_000


@pytest.fixture
def observer():
    where = context()
    made = Observer(context=where)
    yield made
    made.destroy_node()
    where.try_shutdown()


def header(stamp_s):
    return Header(frame_id="camera", stamp=Time(nanoseconds=int(stamp_s * 1e9)).to_msg())


def status_of(values, stamp_s):
    pairs = [KeyValue(key=k, value=v) for k, v in values.items()]
    return DiagnosticArray(header=header(stamp_s), status=[DiagnosticStatus(values=pairs)])


def test_an_answer_is_put_together_from_what_the_node_publishes(observer):
    observer.note_sent("points", 1_700_000_002_000_000_000)
    values = {"reason": "", "detail": "", "confidence": "0.93", "tre": "0.0012", "tre95": "0.0021", "seconds": "0.812"}
    observer._on_status(status_of(values, 1_700_000_002))
    pose = PoseWithCovarianceStamped(header=header(1_700_000_002))
    pose.pose.pose = matrix_to_pose(units.ros_pose(TRUTH))
    observer._on_pose(pose)
    fields = {"distance": np.array([0.001, np.nan], "f4"), "inlier": np.array([1, 0], "u1")}
    observer._on_residuals(
        xyz_to_cloud(np.array([[0.1, 0, 0], [0, 0.2, 0]], "f4"), header(1_700_000_002), fields=fields)
    )
    observer.complete()
    answer = observer.answers[1_700_000_002_000]
    assert (answer.refusal, answer.confidence, answer.exec_ms) == ("", 0.93, 812.0)
    assert answer.tre_mm == pytest.approx(1.2) and answer.tre95_mm == pytest.approx(2.1)
    assert 0.0 <= answer.latency_ms < 60_000.0
    np.testing.assert_allclose(answer.T_target_source, TRUTH, atol=1e-5)
    np.testing.assert_allclose(answer.used.points, [[100, 0, 0], [0, 200, 0]], atol=1e-4)
    assert answer.used.is_taken.tolist() == [True, False]


def test_a_refusal_keeps_its_reason_and_has_no_pose(observer):
    values = {
        "reason": "clutter",
        "detail": "hardly any bone",
        "confidence": "0.2",
        "tre": "",
        "tre95": "",
        "seconds": "",
    }
    observer._on_status(status_of(values, 5))
    observer._on_status(status_of({"reason": "withdrawn"}, 6))
    assert len(observer.answers) == 1
    observer.complete()
    answer = observer.answers[5000]
    assert answer.refusal == "clutter: hardly any bone" and answer.T_target_source is None and answer.tre95_mm is None


def test_advice_is_the_bone_with_its_gain_and_the_middle_of_the_best_look(observer):
    assert observer.advice is None
    gain = {"intensity": np.array([0.0, 0.004], "f4")}
    observer._on_guidance(xyz_to_cloud(np.array([[0, 0, 0], [0, 0, 0.3]], "f4"), header(1), fields=gain))
    T = np.eye(4)
    T[2, 3] = 0.3
    observer._on_next_view(PoseStamped(header=header(1), pose=matrix_to_pose(T)))
    np.testing.assert_allclose(observer.advice.gain_mm, [0.0, 4.0], rtol=1e-6)
    np.testing.assert_allclose(observer.advice.points[1], [0, 0, 300.0], rtol=1e-6)
    np.testing.assert_allclose(observer.advice.centre, [0, 0, 300.0])
    observer.forget_advice()
    assert observer.advice is None


def follow_scripted(monkeypatch, folder, script, most=5):
    """`guided.follow` with a node that says what is in the script: (answer, advice) for each look."""
    said = SimpleNamespace(advice=None, forget_advice=lambda: None)

    class Scripted:
        def __init__(self, node, frame_id):
            self.left = iter(script)

        def ask(self, cloud, stamp_ms):
            answer, said.advice = next(self.left)
            return answer

    @contextlib.contextmanager
    def running(observer, where, parameters):
        yield SimpleNamespace(wait_until_ready=lambda: None)

    monkeypatch.setattr(guided, "running", running)
    monkeypatch.setattr(guided, "Sender", Scripted)
    console = SimpleNamespace(
        print=lambda *_, **__: None, status=lambda _: contextlib.contextmanager(lambda: iter([0]))()
    )
    probe = guided.make_probe("tibia", 2)
    return probe, guided.follow(probe, said, most, folder, console)


def towards(centre):
    return Advice(np.zeros((1, 3)), np.ones(1), centre)


def test_the_probe_goes_where_the_node_says_until_it_knows_enough(tmp_path, monkeypatch):
    ends = parametric_specimen("tibia", 2).surface.points
    top, bottom = ends[ends[:, 2].argmax()], ends[ends[:, 2].argmin()]
    right = guided.make_probe("tibia", 2).T_target_source
    script = [
        (Answer(refusal="ambiguous: ..."), towards(top)),
        (Answer(right, confidence=0.9, tre_mm=2.0, tre95_mm=3.0), towards(bottom)),
        (Answer(right, confidence=0.9, tre_mm=1.0, tre95_mm=2.0), towards(top)),
    ]
    probe, looks = follow_scripted(monkeypatch, tmp_path, script)
    newest = [se3.apply(probe.T_target_source, look.cloud[-look.newest :]).mean(axis=0) for look in looks]
    assert len(looks) == 3 and looks[-1].is_enough and not looks[1].is_enough
    assert np.linalg.norm(newest[1] - top) < 20.0 and np.linalg.norm(newest[2] - bottom) < 20.0
    assert [len(look.cloud) for look in looks] == [60, 120, 180]
    rows = guided.judged(probe, looks)
    assert [row.mark for row in rows] == ["hold", "ok", "ok"] and demo_report.passed(rows)
    guided.write(probe, looks, rows, tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Where to look next" in page and "after 3 looks" in page
    assert "right poses: 2." in guided.verdict(looks, rows)


def test_the_probe_stops_where_the_node_does_not_say_where_to_look(tmp_path, monkeypatch):
    script = [(Answer(refusal="degenerate: ..."), towards(np.zeros(3))), (Answer(refusal="tf_missing: ..."), None)]
    probe, looks = follow_scripted(monkeypatch, tmp_path, script)
    assert len(looks) == 2 and not demo_report.passed(guided.judged(probe, looks))
    probe, looks = follow_scripted(monkeypatch, tmp_path, script[:1] * 4, most=3)
    assert len(looks) == 3
