"""Every command that meets a damaged, empty or wrong-unit file of each format says so in one line, with exit code 1."""

from pathlib import Path

import mesh_samples
import numpy as np
import pytest
from patient_samples import native_samples, text_samples

from gapr_core.cli import main

WHOLE = mesh_samples.samples() | text_samples() | native_samples()
ONE_OF_EACH_LABEL_MAP = {"a.nii", "a.nii.gz", "packed.seg.nrrd", "raw.mha", "one.dcm"}  # each takes a process
OTHER_LABEL_MAPS = {"raw.nrrd", "packed.mha"}
TIP = "0,0,100"
DAMAGE = {
    "empty": lambda data: b"",
    "cut": lambda data: data[: len(data) // 2 - len(data) // 2 % 7 - 1],
    "of something else": lambda data: b"\x89PNG\r\n\x1a\n" + bytes(range(256)),
}
CASES = [
    (name, how)
    for name in sorted(WHOLE.keys() - OTHER_LABEL_MAPS)
    for how in DAMAGE
    if name not in ONE_OF_EACH_LABEL_MAP or how == "cut" or name == "a.nii.gz"
]
POINTS_A_LINE = (".xyz", ".txt", ".csv", ".fcsv")


def says_one_line(capsys, command):
    """The line on stderr of a command that ends with 1."""
    try:
        code = main(command)
    except SystemExit as stop:
        code = stop.code
    out, error = capsys.readouterr()
    assert code == 1 and error.startswith("gapr: ") and error.count("\n") == 1 and "Traceback" not in out + error, error
    return error


@pytest.fixture
def good(tmp_path):
    points, faces = mesh_samples.body()
    np.savez(tmp_path / "good.npz", points=points, faces=faces)
    return str(tmp_path / "good.npz")


def register(*named):
    source = Path(named[named.index("--source") + 1])
    tip = ["--tip", TIP] if source.name.startswith("tool") else []  # other files refuse one
    return ["register", "--method", "gapr_search", *tip, *named]


@pytest.mark.parametrize(("name", "how"), CASES)
def test_register_refuses_a_damaged_target_and_source_of_every_format(tmp_path, capsys, good, name, how):
    path = tmp_path / name
    damaged = DAMAGE[how](WHOLE[name])
    if name.endswith(POINTS_A_LINE):
        damaged = damaged.rstrip(b"\n")  # one that is cut between two lines is whole, as far as one can know
    path.write_bytes(damaged)
    assert name in says_one_line(capsys, register("--source", str(path), "--target", good))
    if name not in native_samples() and not name.startswith("tool"):
        assert name in says_one_line(capsys, register("--target", str(path), "--source", good))


@pytest.mark.parametrize("name", ["points.mrk.json", "points.fcsv"])
@pytest.mark.parametrize("how", DAMAGE)
def test_register_refuses_damaged_landmarks_and_plans(tmp_path, capsys, good, name, how):
    (tmp_path / "whole").mkdir()
    (tmp_path / "whole" / name).write_bytes(WHOLE[name])
    (tmp_path / name).write_bytes(DAMAGE[how](WHOLE[name]).rstrip(b"\n"))
    clouds = ["--source", good, "--target", good]
    says_one_line(capsys, register(*clouds, "--targets", str(tmp_path / name)))
    says_one_line(capsys, register(*clouds, "--landmarks", str(tmp_path / "whole" / name), str(tmp_path / name)))


@pytest.mark.parametrize("name", ["tool.csv", "tool.igs.mha"])
@pytest.mark.parametrize("how", DAMAGE)
def test_pivot_refuses_damaged_recordings_and_tools_that_are_not_in_them(tmp_path, capsys, name, how):
    path = tmp_path / name
    path.write_bytes(DAMAGE[how](WHOLE[name]).rstrip(b"\n"))
    assert name in says_one_line(capsys, ["pivot", str(path)])
    path.write_bytes(WHOLE[name])
    for tool in ("1", "-1"):
        assert name in says_one_line(capsys, ["pivot", str(path), "--tool", tool])


@pytest.mark.parametrize("how", DAMAGE)
def test_commands_that_read_folders_name_the_damaged_file(tmp_path, capsys, how):
    (tmp_path / "bones").mkdir()
    (tmp_path / "bones" / "one.stl").write_bytes(DAMAGE[how](WHOLE["binary.stl"]))
    command = ["make-pairs", "--meshes", str(tmp_path / "bones"), "--protocol", "L1", "--count", "1", "--split", "all"]
    assert "one.stl" in says_one_line(capsys, [*command, "--out", str(tmp_path / "pairs")])
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "one.npz").write_bytes(DAMAGE[how](WHOLE["cloud.npz"]))
    assert "one.npz" in says_one_line(capsys, ["demo", "--real", str(tmp_path / "real")])
