"""Whatever is wrong with a command line or its files: one line on stderr, exit code 1, and no file is harmed."""

import json
import subprocess
import sys

import numpy as np
import pytest

from gapr_core import cli, config
from gapr_core.benchmark import methods
from gapr_core.commands import options
from gapr_core.commands.settings import USERS
from gapr_core.runtime import settings

CLOUD = np.random.default_rng(0).normal(size=(400, 3)) * [60.0, 20.0, 12.0]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The files that the command lines below name, as the working folder."""
    monkeypatch.chdir(tmp_path)
    np.save("cloud.npy", CLOUD)
    np.savetxt("points.csv", CLOUD, delimiter=",")
    for name in ("pairs", "bad", "flat", "text", "empty", "run", "torn", "other", "full"):
        (tmp_path / name).mkdir()
    np.savez("pairs/a.npz", source=CLOUD[:100], target=CLOUD, transform=np.eye(4))
    (tmp_path / "bad" / "a.npz").write_bytes(b"PK\x03\x04 no archive")
    np.savez("flat/a.npz", source=CLOUD[:, 0], target=CLOUD)
    np.savez("text/a.npz", source=np.array(["a", "b"]), target=CLOUD, transform="no matrix")
    (tmp_path / "broken.yaml").write_text("a: [")
    (tmp_path / "twice.yaml").write_text("seed: 1\nseed: 2")
    (tmp_path / "list.yaml").write_text("- 1")
    (tmp_path / "range.yaml").write_text("min_confidence: 7")
    (tmp_path / "answers.json").write_text('{"a": 3}')
    (tmp_path / "run" / "plan.json").write_text('{"pairs": 3}')
    (tmp_path / "torn" / "plan.json").write_text("{")
    (tmp_path / "other" / "records.jsonl").write_text('{"pair": 1}\n')
    (tmp_path / "full" / "records.jsonl").symlink_to("/dev/full")
    return tmp_path


REGISTER = "register --source cloud.npy --target cloud.npy"
WRONG = """
nothing
register
register --source cloud.npy
REGISTER --units inch
register --source none.ply --target cloud.npy
register --source cloud.npy --target empty
REGISTER --label Femur
REGISTER --out pose.mat
REGISTER --residuals a.csv
REGISTER --axes up
REGISTER --landmarks none.fcsv none.fcsv
REGISTER --tip 1,2
REGISTER --tip 1,2,3
REGISTER --tool 1
REGISTER --reference 0
REGISTER --topic /points
REGISTER --clouds 0:1
register --source points.csv --target cloud.npy --tip 1,2,3
REGISTER --targets none.fcsv
REGISTER --method gpr
REGISTER --method os:system
REGISTER --method os:nothing
REGISTER --method no_such_module:make
REGISTER --method json:JSONDecoder
REGISTER --method :
REGISTER --config none.yaml
REGISTER --config broken.yaml
REGISTER --config list.yaml
REGISTER --config twice.yaml
REGISTER --config range.yaml
REGISTER --config .
REGISTER --set min_confidence=7
REGISTER --set min_confidence
REGISTER --set nothing=1
REGISTER --set search.keep=1.5
REGISTER --method icp --set min_confidence=0.9
REGISTER --method icp --json .
REGISTER --method icp --json cloud.npy/a.json
REGISTER --method icp --json /proc/a.json
evaluate --pairs none --out o.json
evaluate --pairs empty --out o.json
evaluate --pairs cloud.npy --out o.json
evaluate --pairs pairs --out answers.json --method icp
evaluate --pairs pairs --out . --method icp
evaluate --pairs pairs --out /proc/o.json --method icp
pivot points.csv --json points.csv
pivot points.csv --json .
evaluate --pairs pairs --out o.json --limit 0
evaluate --pairs pairs --out o.json --limit x
evaluate --pairs pairs --out o.json --method gpr
benchmark --out o
benchmark --pairs empty --out o
benchmark --pairs bad --out o
benchmark --pairs flat --out o
benchmark --pairs text --out o
benchmark --methods icp --pairs pairs --out o --jobs 0
benchmark --methods icp --pairs pairs --out o --threads 0
benchmark --methods icp --pairs pairs --out o --shard 0/2
benchmark --methods icp --pairs pairs --out o --methods gpr
benchmark --methods icp --pairs pairs --out o --methods ,
benchmark --methods icp --pairs pairs --out other
benchmark --methods icp --pairs pairs --out cloud.npy
benchmark merge --out o
benchmark merge none --out o
benchmark merge run --out o
benchmark merge torn --out o
benchmark join run --out o
make-pairs --split all --protocol L9 --out o
make-pairs --split all --protocol L1 --count 0 --out o
make-pairs --split all --protocol L1 --bones skull --out o
make-pairs --split all --protocol L1 --meshes none --out o
make-pairs --split all --protocol L1 --anatomy none --out o
make-pairs --split all --protocol L1 --out cloud.npy
make-pairs --split all --protocol L1 --out torn_pairs
train
train --out o --config none.yaml
train --out o --config broken.yaml
train --out o --config range.yaml
train --out o --minutes -1
train --out o --minutes nan
train --out o --minutes 0
train --out o --minutes soon
ablate --out o --pairs 4 --minutes nan
train --plot none
train --plot pairs pairs
ablate --out o --pairs x
ablate --out o --pairs 4 --plan broken.yaml
ablate --out o --pairs 4 --plan list.yaml
ablate --out o --pairs 4 --plan none.yaml
ablate --out o --pairs 4 --jobs 0
ablate --out o --pairs 0
"""


def run(line):
    """Exit code, as a shell sees it."""
    try:
        return cli.main(line.split())
    except SystemExit as exit:
        return exit.code


@pytest.mark.parametrize("line", ["", *WRONG.replace("REGISTER", REGISTER).split("\n")[1:-1]])
def test_a_wrong_command_line_is_one_line_and_exit_code_1(folder, capsys, line):
    (folder / "torn_pairs").mkdir()
    (folder / "torn_pairs" / "manifest.json").write_text('{"recipe"')
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert run(line) == 1
    said = capsys.readouterr().err
    assert said.count("gapr: ") == 1 and "Traceback" not in said, said
    assert said.endswith("\n") and "\n" not in said[said.index("gapr: ") :].rstrip("\n")
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("option", ["--tip nan,0,0", "--tip 0,1e400,0", "--viewpoint 0,0,inf"])
def test_a_place_that_is_not_finite_is_not_blamed_on_a_file(folder, capsys, option):
    assert run(f"{REGISTER} {option}") == 1
    name, value = option.split()
    assert f"argument {name}: three finite numbers X,Y,Z, not '{value}'" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--source", "--target", "--out"])
def test_a_variable_of_the_shell_that_is_not_set_is_no_folder(folder, capsys, option):
    line = ["register", "--source", "cloud.npy", "--target", "cloud.npy", option, ""]
    with pytest.raises(SystemExit) as end:
        cli.main(line)
    assert end.value.code == 1 and "expected a path, got an empty text" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["register --source cloud.npy --target cloud.npy --method",
                                     "evaluate --pairs pairs --out o.json --method",
                                     "benchmark --pairs pairs --out o --methods"])  # fmt: skip
def test_an_unknown_method_is_answered_with_the_same_list_everywhere(folder, capsys, command):
    assert run(f"{command} gpr") == 1
    said = capsys.readouterr().err
    listed = ", ".join(methods.names())
    assert listed in said and {"gapr", "gapr_search", "gapr_network", "gapr_tracker", "icp"} <= set(methods.names())


def test_a_full_disk_is_one_line(folder, capsys, monkeypatch):
    from gapr_core.benchmark import runner

    monkeypatch.setattr(runner, "_methods", {})
    monkeypatch.setattr(runner, "_run_pool", lambda tasks, *_: (runner.run_task(tasks.popleft()) for _ in list(tasks)))
    assert run("benchmark --methods icp --pairs pairs --out full") == 1
    assert "No space left" in capsys.readouterr().err


def test_settings_lists_what_a_user_touches_and_with_all_the_rest(capsys):
    assert run("settings") == 0
    few = capsys.readouterr().out
    assert "| min_confidence | 0.5 | 0 to 1 |" in few and "| sensor.kind |" in few
    assert few.count("\n| ") < 25 and "refinement" not in few
    assert run("settings --all") == 0
    assert "| refinement." in capsys.readouterr().out
    names = [row.name for row in settings.table(config.RegistrarConfig)]
    assert all(any(name.startswith(user) for name in names) for user in USERS if user != "other_bone_prior")


def test_a_setting_from_a_file_and_one_from_the_command_line_reach_the_method(folder):
    import argparse

    parser = argparse.ArgumentParser()
    options.add_method(parser)
    (folder / "mine.yaml").write_text("min_confidence: 0.75\nnum_threads: 1\n")
    args = parser.parse_args(["--method", "gapr_search", "--config", "mine.yaml", "--set", "num_threads=7"])
    method = methods.make(args.method, options.registrar_config(args))
    assert method.config.min_confidence == 0.75 and method.config.num_threads == 7


def test_a_missing_library_names_the_extra_that_installs_it(capsys, monkeypatch):
    def absent(args):
        raise ModuleNotFoundError("No module named 'jinja2'", name="jinja2.graph_objects")

    monkeypatch.setattr("gapr_core.commands.settings.run", absent)
    assert run("settings") == 1
    assert "pip install 'gapr_ros[reports]'" in capsys.readouterr().err


@pytest.mark.parametrize(("library", "command", "install"), [
    ("diagnostic_msgs.msg", "register", "'gapr_ros[ros]'"), ("rich", "demo", "'gapr_ros[ros]'"),
    ("torch", "train", "'gapr_ros[training]'"), ("torch", "register", "'gapr_ros[network]'"),
    ("distributed", "train", "distributed"),
])  # fmt: skip
def test_the_extra_of_a_command_has_all_that_it_needs(library, command, install):
    assert cli._which_extra(ModuleNotFoundError(name=library), command).endswith(f"pip install {install}")


@pytest.mark.parametrize(
    ("command", "said"), [("settings", "stopped"), ("evaluate", "stopped; the same command goes on")]
)
def test_a_command_that_is_stopped_says_only_what_it_has_kept(capsys, monkeypatch, command, said):
    def stopped(args):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"gapr_core.commands.{command}.run", stopped)
    assert cli.main([command, *(["--pairs", "a", "--out", "b"] if command == "evaluate" else [])]) == 130
    assert capsys.readouterr().err.startswith(f"gapr: {said}" + "\n" * (command == "settings"))


@pytest.mark.parametrize("module", ["gapr_core.cli", "gapr_core.errors", "numpy", "scipy.spatial", "numba"])
def test_a_command_that_is_stopped_while_it_loads_says_so_in_one_line(tmp_path, module):
    (tmp_path / "cloud.xyz").write_text("0 0 0\n50 0 0\n0 80 0\n")
    script = f"""
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a suite in the background ignores it
class Press:
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Press())
from gapr_core.__main__ import main
sys.argv = ["gapr", "register", "--source", "cloud.xyz", "--target", "cloud.xyz"]
sys.exit(main())
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "gapr: stopped\n")


def test_a_baseline_is_said_to_have_no_calibrated_confidence(folder, capsys):
    said = "icp is a baseline: its confidence is its share of inliers, not calibrated"
    assert run(f"{REGISTER} --method icp --json x.json") == 0 and said in capsys.readouterr().out
    assert json.loads((folder / "x.json").read_text())["calibrated"] is False
    assert run("evaluate --pairs pairs --out poses.json --method icp") == 0 and said in capsys.readouterr().out
    assert run("register --help") == 0 and "share of inliers, not calibrated" in " ".join(
        capsys.readouterr().out.split()
    )
    run(f"{REGISTER} --method gapr_search --json x.json")
    assert "is a baseline" not in capsys.readouterr().out
    assert json.loads((folder / "x.json").read_text())["calibrated"] is True


def test_a_pair_in_another_unit_is_named_and_no_argument_of_python(folder, caplog):
    """And where none of the pairs can be read, nothing was evaluated."""
    np.savez("pairs/b.npz", source=CLOUD[:100] / 1000.0, target=CLOUD / 1000.0)
    assert run("evaluate --pairs pairs --out poses.json --method icp") == 0
    assert "the first of 1 pairs that cannot be read: b.npz: expected a bone" in caplog.text
    assert "it looks like m: convert it to mm" in caplog.text and "units=" not in caplog.text
    assert run("evaluate --pairs bad --out poses.json --method icp") == 1


def test_a_source_that_looks_like_the_target_is_said(folder, caplog):
    np.savez("bone.npz", points=CLOUD, faces=[[0, 1, 2], [3, 4, 5]])
    run("register --source bone.npz --target cloud.npy --method icp")
    assert "exchange them if bone.npz is the whole bone" in caplog.text
    caplog.clear()
    run("register --source cloud.npy --target bone.npz --method icp")
    assert "exchange" not in caplog.text


def test_the_list_of_commands_has_a_line_for_each():
    assert [name for name, module in cli.modules().items() if cli._first_line(module) == "not installed"] == []
