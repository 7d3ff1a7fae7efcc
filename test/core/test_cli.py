"""The command's contracts: exit codes, JSON, one line for bad input."""

import importlib
import json
import os
import shlex
import subprocess
import sys
import time

import numpy as np
import pytest

import gapr_core
from gapr_core import cli
from gapr_core.benchmark import methods
from gapr_core.commands import evaluate
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.geometry import se3


@pytest.fixture(scope="module")
def pair(femur):
    return make_pair("L1", Specimen(femur, "femur", "parametric-3", "parametric"), seed=5)


@pytest.fixture
def files(tmp_path, pair):
    np.save(tmp_path / "partial.npy", pair.source)
    np.save(tmp_path / "full.npy", pair.target)
    return ["--source", str(tmp_path / "partial.npy"), "--target", str(tmp_path / "full.npy")]


def test_the_package_runs_as_the_command():
    done = subprocess.run([sys.executable, "-m", "gapr_core", "--version"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.strip().endswith(gapr_core.__version__)


def test_register_prints_a_pose_and_writes_it_as_json(tmp_path, files, pair, capsys):
    assert cli.main(["register", *files, "--json", str(tmp_path / "out.json")]) == 0
    assert capsys.readouterr().out.startswith("OK  confidence")
    answer = json.loads((tmp_path / "out.json").read_text())
    assert {"transform", "confidence", "status", "covariance", "seconds"} <= set(answer)
    rte_mm, rre_deg = se3.pose_error(np.array(answer["transform"]), pair.T_target_source, pair.source)
    assert rte_mm < 0.5 and rre_deg < 0.5


def test_a_refusal_exits_with_2_and_has_no_transform(tmp_path, files, capsys):
    np.save(tmp_path / "partial.npy", np.random.default_rng(0).uniform(0, 40, (500, 3)))
    assert cli.main(["register", *files, "--json", str(tmp_path / "out.json")]) == 2
    answer = json.loads((tmp_path / "out.json").read_text())
    assert answer["transform"] is None and answer["status"] != "OK" and answer["reason"]
    assert answer["tre_mm"] is None and answer["tre95_mm"] is None and answer["covariance"] is None


def test_evaluate_answers_every_pair_without_the_truth(tmp_path, pair, capsys, caplog):
    folder = tmp_path / "pairs"
    folder.mkdir()
    np.savez(folder / "a.npz", source=pair.source, target=pair.target)  # no transform to look at
    np.savez(folder / "b.npz", source=pair.source[:5], target=pair.target)
    (folder / "c.npz").write_bytes(b"damaged")
    assert cli.main(["evaluate", "--pairs", str(folder), "--out", str(tmp_path / "poses.json")]) == 0
    poses = json.loads((tmp_path / "poses.json").read_text())
    assert poses["a"]["status"] == "OK" and np.shape(poses["a"]["transform"]) == (4, 4)
    assert poses["a"]["seconds"] > 0 and poses["a"]["prepare_seconds"] > 0
    assert poses["b"] | {"transform": None, "status": "TOO_FEW_POINTS"} == poses["b"]
    assert poses["c"]["status"] == "INVALID_INPUT" and poses["c"]["confidence"] == 0.0
    assert "3 pairs, 1 OK, 1 TOO_FEW_POINTS, 1 INVALID_INPUT" in capsys.readouterr().out
    assert "cannot be read: expected" in caplog.text and "c.npz" in caplog.text


def test_evaluate_goes_on_where_it_stopped(tmp_path, pair):
    folder = tmp_path / "pairs"
    folder.mkdir()
    for name in "ab":
        np.savez(folder / f"{name}.npz", source=pair.source[:5], target=pair.target)
    run = ["evaluate", "--pairs", str(folder), "--out", str(tmp_path / "poses.json")]
    assert cli.main([*run, "--limit", "1"]) == 0
    first = json.loads((tmp_path / "poses.json").read_text())
    assert cli.main(run) == 0
    both = json.loads((tmp_path / "poses.json").read_text())
    assert set(both) == {"a", "b"} and both["a"] == first["a"]


def test_an_interrupted_evaluation_has_written_what_it_had_answered(tmp_path, pair, monkeypatch):
    (tmp_path / "pairs").mkdir()
    for name in "abc":
        np.savez(tmp_path / "pairs" / f"{name}.npz", source=pair.source[:5], target=pair.target)
    answer = evaluate._answer

    def interrupted(path, method):
        if path.stem == "c":
            raise KeyboardInterrupt
        return answer(path, method)

    monkeypatch.setattr(evaluate, "_answer", interrupted)
    cli.main(["evaluate", "--pairs", str(tmp_path / "pairs"), "--out", str(tmp_path / "poses.json")])
    assert set(json.loads((tmp_path / "poses.json").read_text())) == {"a", "b"}


def test_two_runs_of_evaluate_lose_no_answers_of_each_other(tmp_path, pair):
    out, running = tmp_path / "new" / "poses.json", []
    for name in "ab":
        (tmp_path / name).mkdir()
        for number in range(6):
            np.savez(tmp_path / name / f"{name}{number}.npz", source=pair.source[:5], target=pair.target)
        words = ["evaluate", "--pairs", str(tmp_path / name), "--out", str(out), "--method", "icp"]
        running.append(subprocess.Popen([sys.executable, "-m", "gapr_core.cli", *words], cwd=tmp_path))
    assert [run.wait() for run in running] == [0, 0]
    assert sorted(json.loads(out.read_text())) == [f"{name}{number}" for name in "ab" for number in range(6)]


def test_evaluate_spends_little_of_its_time_on_writing(tmp_path, monkeypatch):
    (tmp_path / "pairs").mkdir()
    for number in range(40):
        np.savez(tmp_path / "pairs" / f"{number}.npz", source=np.zeros((5, 3)), target=np.zeros((5, 3)))
    written, sizes = evaluate._written, []

    def slowly(path, new):
        sizes.append(len(new))
        time.sleep(0.1)
        return written(path, new)

    monkeypatch.setattr(evaluate, "WRITE_SECONDS", 0.0)
    monkeypatch.setattr(evaluate, "_written", slowly)
    monkeypatch.setattr(evaluate, "_answer", lambda *_: time.sleep(0.002) or {"status": "INVALID_INPUT", "reason": ""})
    run = ["evaluate", "--pairs", str(tmp_path / "pairs"), "--out", str(tmp_path / "o.json"), "--method", "icp"]
    cli.main(run)
    assert sum(sizes) == 40 and len(sizes) <= 4, sizes
    assert len(json.loads((tmp_path / "o.json").read_text())) == 40


def test_evaluate_finds_a_place_that_cannot_be_written_before_the_work(tmp_path, pair, capsys, monkeypatch):
    asked = []
    monkeypatch.setattr(evaluate, "_answer", lambda path, method: asked.append(path))
    (tmp_path / "pairs").mkdir()
    np.savez(tmp_path / "pairs" / "a.npz", source=pair.source, target=pair.target)
    (tmp_path / "file").touch()
    out = ["--out", str(tmp_path / "file" / "o.json"), "--method", "icp"]
    assert cli.main(["evaluate", "--pairs", str(tmp_path / "pairs"), *out]) == 1
    assert not asked and "what should be its folder is a file" in capsys.readouterr().err


def test_the_seconds_of_evaluate_are_without_the_first_call_and_without_preparing(
    tmp_path, pair, monkeypatch, on_own_clock
):
    method = on_own_clock(evaluate)
    monkeypatch.setitem(methods.OWN, "gapr", lambda config, weights: method)
    (tmp_path / "pairs").mkdir()
    for name in "ab":
        np.savez(tmp_path / "pairs" / f"{name}.npz", source=pair.source, target=pair.target)
    assert cli.main(["evaluate", "--pairs", str(tmp_path / "pairs"), "--out", str(tmp_path / "o.json")]) == 0
    answers = json.loads((tmp_path / "o.json").read_text())
    assert [(each["prepare_seconds"], each["seconds"]) for each in answers.values()] == [(2.0, 7.0)] * 2


def test_evaluate_answers_a_pair_again_that_is_another_one_now(tmp_path, pair):
    folder, out = tmp_path / "pairs", tmp_path / "poses.json"
    folder.mkdir()
    np.savez(folder / "a.npz", source=pair.source, target=pair.target)
    assert cli.main(["evaluate", "--pairs", str(folder), "--out", str(out)]) == 0
    before = json.loads(out.read_text())["a"]["transform"]
    np.savez(folder / "a.npz", source=pair.source + [50.0, 0.0, 0.0], target=pair.target)
    assert cli.main(["evaluate", "--pairs", str(folder), "--out", str(out)]) == 0
    after = json.loads(out.read_text())["a"]["transform"]
    expected = np.array(before) @ se3.exp([-50.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(after, expected, atol=0.5)


@pytest.mark.parametrize("text", ["", "no json", "[1, 2]", '{"a": 3}'])
def test_evaluate_does_not_write_over_what_is_not_its_own(tmp_path, pair, capsys, text):
    (tmp_path / "pairs").mkdir()
    np.savez(tmp_path / "pairs" / "a.npz", source=pair.source, target=pair.target)
    (tmp_path / "poses.json").write_text(text)
    command = ["evaluate", "--pairs", str(tmp_path / "pairs"), "--out", str(tmp_path / "poses.json")]
    assert cli.main(command) == 1
    assert (tmp_path / "poses.json").read_text() == text
    assert "poses.json" in capsys.readouterr().err


def test_evaluate_refuses_every_kind_of_damaged_pair_and_goes_on(tmp_path, pair):
    folder, out = tmp_path / "pairs", tmp_path / "poses.json"
    folder.mkdir()
    np.savez(folder / "whole.npz", source=pair.source, target=pair.target)
    whole = (folder / "whole.npz").read_bytes()
    (folder / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (folder / "bent.npz").write_bytes(whole[:2000] + bytes(100) + whole[2100:])
    (folder / "empty.npz").write_bytes(b"")
    (folder / "folder.npz").mkdir()
    (folder / "gone.npz").symlink_to(folder / "nowhere")
    with (folder / "single.npz").open("wb") as file:
        np.save(file, pair.source)
    assert cli.main(["evaluate", "--pairs", str(folder), "--out", str(out), "--limit", "9"]) == 0
    answers = json.loads(out.read_text())
    assert answers.pop("whole")["status"] == "OK"
    assert {answer["status"] for answer in answers.values()} == {"INVALID_INPUT"} and len(answers) == 6


def test_evaluate_answers_again_what_other_settings_have_answered(tmp_path, pair):
    (tmp_path / "pairs").mkdir()
    np.savez(tmp_path / "pairs" / "a.npz", source=pair.source[:5], target=pair.target)
    run = ["evaluate", "--pairs", str(tmp_path / "pairs"), "--out", str(tmp_path / "o.json"), "--method", "gapr_search"]
    answers = []
    for more in ([], ["--set", "source.fewest_points=40"], ["--set", "source.fewest_points=40"]):
        assert cli.main([*run, *more]) == 0
        answers.append(json.loads((tmp_path / "o.json").read_text())["a"])
    assert answers[0]["settings"] != answers[1]["settings"] and "40" in answers[1]["reason"]
    assert answers[1] == answers[2]  # not asked again
    assert answers[0]["version"].startswith("0.") and answers[0]["weights"]
    assert answers[0]["tre95_mm"] is None and answers[0]["covariance"] is None


def test_evaluate_answers_again_what_a_method_of_other_code_has_answered(tmp_path, pair, monkeypatch):
    (tmp_path / "pairs").mkdir()
    np.savez(tmp_path / "pairs" / "a.npz", source=pair.source, target=pair.target)
    monkeypatch.syspath_prepend(str(tmp_path))
    run = ["evaluate", "--pairs", str(tmp_path / "pairs"), "--out", str(tmp_path / "o.json"), "--method", "mine:make"]
    asked = tmp_path / "asked"
    code = f"""
from gapr_core.results import RegistrationResult, RegistrationStatus
class Mine:
    name = "mine"
    def prepare(self, target, units="mm"): return target
    def register(self, source, target):
        open({str(asked)!r}, "a").write("x")
        return RegistrationResult(RegistrationStatus.AMBIGUOUS, reason="REASON")
make = Mine
"""
    for reason, times in (("one", 2), ("one", 2), ("another", 4)):  # the first pair is asked twice, to load code
        (tmp_path / "mine.py").write_text(code.replace("REASON", reason))
        monkeypatch.delitem(sys.modules, "mine", raising=False)
        importlib.invalidate_caches()
        assert cli.main(run) == 0
        assert json.loads((tmp_path / "o.json").read_text())["a"]["reason"] == reason
        assert len(asked.read_text()) == times


@pytest.mark.parametrize("is_unbuffered", [False, True])
def test_the_pose_is_written_though_nobody_reads_the_output(tmp_path, files, is_unbuffered):
    command = shlex.join([sys.executable, "-m", "gapr_core.cli", "register", *files, "--method", "gapr_search"])
    environment = {**os.environ, **({"PYTHONUNBUFFERED": "1"} if is_unbuffered else {})}
    script = f"set -o pipefail; {command} --out {tmp_path / 'pose.tfm'} | true"
    ended = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert "Transform" in (tmp_path / "pose.tfm").read_text() and "BrokenPipe" not in ended.stderr


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_names_that_the_output_cannot_hold_are_said_nevertheless(tmp_path, encoding):
    script = "from gapr_core.runtime.console import say; say('\\u9aa8: 1.2 mm \\udce9')"
    environment = os.environ | {"PYTHONIOENCODING": encoding}
    ended = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True)
    assert ended.returncode == 0 and ended.stdout.endswith(b": 1.2 mm \\udce9\n"), ended.stderr
