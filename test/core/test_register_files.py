"""`gapr register`: what is checked before the work, and what a finished pose leaves behind."""

import json
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

from gapr_core import Registrar, cli, commands
from gapr_core.benchmark import methods
from gapr_core.commands import checks
from gapr_core.formats.markups import Markups, save
from gapr_core.results import RegistrationResult, RegistrationStatus, Residuals

POINTS = np.random.default_rng(0).uniform(-100.0, 100.0, (60, 3))
FACES = [[0, 1, 2], [3, 4, 5]]


class Known:
    """A method that answers at once, and counts how often it was asked."""

    name, asked, more = "known", 0, {}

    def prepare(self, target, units="mm"):
        return target

    def register(self, source, target, initial=None):
        Known.asked += 1
        return RegistrationResult(RegistrationStatus.OK, np.eye(4), confidence=0.9, **Known.more)


FULL = {
    "covariance": np.eye(6) * 1e-4,
    "centre_mm": np.zeros(3),
    "residuals": Residuals(POINTS, np.zeros(len(POINTS)), np.ones(len(POINTS), bool)),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Files of a case as the working folder, and a method that says all that GAPR says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "known_method", SimpleNamespace(make=Known))
    monkeypatch.setattr(Known, "asked", 0)
    monkeypatch.setattr(Known, "more", FULL)
    np.save("s.npy", POINTS)
    np.savetxt("s.txt", POINTS)
    rows = [" ".join(map(str, point)) for point in POINTS] + [" ".join(map(str, (3, *face))) for face in FACES]
    for name, comment in (("bone", "a bone"), ("lps", "SPACE=LPS"), ("ras", "SPACE=RAS")):
        head = ["ply", "format ascii 1.0", f"comment {comment}", f"element vertex {len(POINTS)}"]
        head += [f"property float {axis}" for axis in "xyz"]
        head += [f"element face {len(FACES)}", "property list uchar int vertex_indices", "end_header"]
        (tmp_path / f"{name}.ply").write_text("\n".join([*head, *rows]) + "\n")
    save(tmp_path / "p.mrk.json", Markups(POINTS[:4], ("a", "b", "c", "d")))
    (tmp_path / "a_file").write_text("")
    np.savetxt("start.txt", np.eye(4))
    return tmp_path


def register(line, target="bone.ply", source="s.npy"):
    command = f"register --source {source} --target {target} --method known_method:make {line}"
    try:
        return cli.main(command.split())
    except SystemExit as stop:
        return stop.code


IN_LPS = ["--out p.tfm", "--slicer scene", "--residuals r.ply", "--targets p.mrk.json",
          "--landmarks p.mrk.json p.mrk.json", "--initial start.txt"]  # fmt: skip


@pytest.mark.parametrize("option", IN_LPS)
def test_files_in_lps_of_a_bone_without_axes_are_warned_of(folder, caplog, option):
    said = f"{option.split()[-1]} assumes that bone.ply is in LPS. If it is RAS, give --axes ras"
    assert register(option, source="lps.ply") == 0 and said in caplog.text
    caplog.clear()
    assert register(f"{option} --axes as_is", source="lps.ply") == 0 and said in caplog.text
    for target, more in (("bone.ply", "--axes ras"), ("bone.ply", "--axes lps"), ("lps.ply", ""), ("ras.ply", "")):
        caplog.clear()
        assert register(f"{option} {more}", target, "lps.ply") == 0 and "is in LPS. If" not in caplog.text


@pytest.mark.parametrize("option", IN_LPS)
def test_files_in_lps_of_a_bone_that_is_turned_to_ras_are_refused(folder, capsys, option):
    assert register(f"{option} --axes lps_to_ras") == 1 and Known.asked == 0
    assert f"--axes lps or ras with {option.split()[0]}, which is LPS" in capsys.readouterr().err


def test_axes_may_be_named_in_capitals(folder, caplog, capsys):
    assert register("--out pose.tfm --axes RAS") == 0 and "give --axes ras" not in caplog.text
    assert register("--axes SRA") == 1
    assert "one of auto, lps, as_is, ras, lps_to_ras; got 'sra'; name one of them" in capsys.readouterr().err


@pytest.mark.parametrize(("source", "is_known"), [
    ("s.npy", False), ("bone.ply", False), ("sweep", False), ("lps.ply", True), ("ras.ply", True), ("p.mrk.json", True),
])  # fmt: skip
def test_landmarks_of_a_source_without_axes_are_warned_of(folder, caplog, source, is_known):
    (folder / "sweep").mkdir()
    np.savetxt(folder / "sweep" / "0.txt", POINTS)
    save(folder / "q.mrk.json", Markups(POINTS[:4], ("a", "b", "c", "d")))
    line = "--landmarks q.mrk.json p.mrk.json"
    assert register(line, "lps.ply", source) == 0
    assert (f"q.mrk.json assumes that {source} is in LPS" in caplog.text) == (not is_known)
    caplog.clear()
    assert register("", "lps.ply", source) == 0 and "is in LPS. If" not in caplog.text


@pytest.mark.parametrize(
    ("source", "is_known"), [("s.npy", False), ("bone.ply", False), ("lps.ply", True), ("p.mrk.json", True)]
)
@pytest.mark.parametrize("line", ["--out p.tfm", "--out p.h5", "--slicer scene"])
def test_a_transform_for_slicer_of_a_cloud_without_axes_is_warned_of(folder, caplog, source, is_known, line):
    """Arrays that 3D Slicer's Python gives are RAS, and their transform was for LPS in silence."""
    pytest.importorskip("SimpleITK", reason=".h5 is optional: pip install '.[medical]'")
    said = (
        f"{line.split()[1]} assumes that {source} is in LPS. If it came from Slicer's Python (RAS), add --source-axes"
    )
    assert register(line, "lps.ply", source) == 0 and (said in caplog.text) == (not is_known)
    caplog.clear()
    if not is_known:
        assert register(f"{line} --source-axes lps", "lps.ply", source) == 0 and "is in LPS. If" not in caplog.text
        assert register("--out p.txt", "lps.ply", source) == 0 and "is in LPS. If" not in caplog.text


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("turned", [True, False])
def test_landmarks_that_lie_on_their_cloud_only_with_other_axes_are_warned_of(folder, caplog, which, turned):
    """The source in RAS coordinates, and landmarks that say LPS, 180 deg apart: their own residual never shows it."""
    aside = POINTS + [300.0, 100.0, 0.0]
    np.save("s.npy", aside)
    head = (folder / "lps.ply").read_text().split("end_header\n")[0]
    rows = [" ".join(map(str, point)) for point in aside] + [" ".join(map(str, (3, *face))) for face in FACES]
    (folder / "lps.ply").write_text("\n".join([f"{head}end_header", *rows]) + "\n")
    files = ["q.mrk.json", "p.mrk.json"]
    for number, name in enumerate(files):
        points = aside[:4] * ([-1.0, -1.0, 1.0] if turned and number == which else [1.0, 1.0, 1.0])
        save(folder / name, Markups(points, ("a", "b", "c", "d")))
    assert register(f"--landmarks {' '.join(files)}", "lps.ply") == 0
    said = [f"{name} is " in caplog.text and "with x and y negated" in caplog.text for name in files]
    assert said == [turned and number == which for number in range(2)]


@pytest.mark.parametrize(("at", "place", "is_warned"), [
    ([200.0, 100.0, 0.0], [-200.0, -100.0, 0.0], True), ([20.0, 10.0, 0.0], [-20.0, -10.0, 0.0], False),
    ([200.0, 100.0, 0.0], [0.0, 0.0, 300.0], False),
])  # fmt: skip
def test_landmarks_that_are_near_or_as_far_with_other_axes_are_not_warned_of(folder, caplog, at, place, is_warned):
    save(folder / "q.mrk.json", Markups(np.tile(place, (4, 1)), ("a", "b", "c", "d")))
    args = Namespace(landmarks=[Path("q.mrk.json")], source=Path("s.npy"), target=Path("t.npy"))
    checks.warn_of_landmarks(args, np.array([at]), np.array([at]))
    assert ("with x and y negated" in caplog.text) is is_warned


@pytest.fixture
def hints(monkeypatch):
    """What the method was given besides source and target, the last time that it was asked."""
    given = {}

    def look(self, source, target, initial=None, viewpoint=None):
        given.update(source=source, initial=initial, viewpoint=viewpoint)
        return RegistrationResult(RegistrationStatus.OK, np.eye(4), confidence=0.9, **FULL)

    monkeypatch.setattr(Known, "register", look)
    return given


def test_a_start_in_a_file_goes_to_the_method_and_one_the_other_way_round_is_warned_of(folder, caplog, hints):
    T = np.eye(4)
    T[:3, 3] = [400.0, 0.0, 0.0]
    np.save("aside.npy", POINTS - T[:3, 3])
    for T_given, is_warned in ((T, False), (np.linalg.inv(T), True)):
        caplog.clear()
        np.savetxt("start.txt", T_given)
        assert register("--initial start.txt", "lps.ply", "aside.npy") == 0
        assert np.array_equal(hints["initial"], T_given)
        assert ("and its inverse 0 mm: is it the other way round?" in caplog.text) is is_warned
    assert register("--initial start.txt --landmarks p.mrk.json p.mrk.json") == 1
    assert register("--initial start.txt --out start.txt") == 1, "it is read"


@pytest.mark.parametrize(("line", "at_mm", "said"), [
    ("--landmarks s t", 300.0, ""),
    ("--landmarks t s", 300.0, "t.mrk.json is near t.npy, and s.mrk.json near s.npy: are the files of --landmarks ex"),
    ("--landmarks t s", 40.0, ""),
    ("--landmarks t t", 300.0, ""),
])  # fmt: skip
def test_landmarks_that_are_exchanged_are_warned_of(folder, caplog, line, at_mm, said):
    """No residual shows it: landmarks fit in either order. One file alone may be of a part that was not seen."""
    clouds = {"s": np.zeros((1, 3)), "t": np.array([[0.0, 0.0, at_mm]])}
    for name, points in clouds.items():
        save(folder / f"{name}.mrk.json", Markups(points, ("a",)))
    landmarks = [Path(f"{name}.mrk.json") for name in line.split()[1:]]
    args = Namespace(source=Path("s.npy"), target=Path("t.npy"), landmarks=landmarks)
    checks.warn_of_frames(args, clouds["s"], clouds["t"])
    assert [said in message for message in caplog.messages] == [True] * bool(said)


def test_what_bad_input_leaves_of_an_earlier_run_is_named(folder, capsys):
    line = "--out p.tfm --residuals r.json --slicer scene"
    assert register(line, source="none.npy") == 1 and not capsys.readouterr().out
    assert register(line, "lps.ply", "lps.ply") == 0
    capsys.readouterr()
    assert register(line, source="none.npy") == 1
    shown = capsys.readouterr()
    old = [f"{name} is not written, and what is there is of an earlier run" for name in ("p.tfm", "r.json", "scene")]
    assert shown.out.splitlines() == old and shown.err.count("\n") == 1


@pytest.mark.parametrize("option", ["--residuals r.json", "--residuals r.ply", "--slicer scene", ""])
def test_distances_of_fewer_points_than_the_source_has_are_said_to_be_so(folder, capsys, option):
    np.save("more.npy", np.vstack([POINTS, POINTS]))
    for source, is_said in (("s.npy", False), ("more.npy", bool(option))):
        assert register(option, "lps.ply", source) == 0
        assert ("distances are of 60 of 120 points" in capsys.readouterr().out) is is_said


def test_one_file_for_source_and_target_is_warned_of(folder, caplog):
    (folder / "link.ply").symlink_to(folder / "bone.ply")
    assert register("", source="bone.ply", target="lps.ply") == 0 and "one file" not in caplog.text
    assert register("", source="link.ply") == 0 and "source and target are one file, link.ply" in caplog.text


def test_landmarks_that_fit_no_pose_are_warned_of(folder, caplog):
    names = ("a", "b", "c", "d")
    save(folder / "other.mrk.json", Markups(POINTS[[1, 0, 3, 2]], names))
    save(folder / "near.mrk.json", Markups(POINTS[:4] + [[0, 5, 0], [5, 0, 0], [0, 0, 5], [-5, 0, 0]], names))
    assert register("--landmarks p.mrk.json near.mrk.json") == 0 and "fit no pose" not in caplog.text
    assert register("--landmarks p.mrk.json other.mrk.json") == 0
    assert "the landmarks fit no pose" in caplog.text and "another order" in caplog.text


def test_a_planned_target_without_a_name_is_printed_by_its_number_and_each_in_a_line(folder, capsys):
    save(folder / "p.mrk.json", Markups(POINTS[:3], ("entry", " ", "a\nb")))
    assert register("--targets p.mrk.json --json x.json") == 0
    lines = [line.partition(":")[0] for line in capsys.readouterr().out.splitlines() if "expected error" in line]
    assert lines == ["entry", "target 2", "a b"]
    assert [t["label"] for t in json.loads((folder / "x.json").read_text())["targets"]] == lines


def test_a_target_too_far_for_any_number_is_refused_before_the_work(folder, capsys):
    save(folder / "p.mrk.json", Markups(np.array([[1.0, 2.0, 1e308]]), ("a",)))
    assert register("--targets p.mrk.json --out p.tfm") == 1 and Known.asked == 0
    assert "got p.mrk.json with others" in capsys.readouterr().err


@pytest.mark.parametrize(("line", "is_warned"), [
    ("--out p.tfm", True), ("--out p.h5", True), ("--slicer scene", True), ("--out p.txt", False), ("", False),
    ("--out p.tfm --source-axes RAS", False), ("--out p.tfm --source-axes lps", False),
])  # fmt: skip
def test_a_transform_for_slicer_of_a_trackers_numbers_is_warned_of(folder, caplog, hints, line, is_warned):
    """3D Slicer shows them live as RAS: the transform of the numbers as they are was two metres off there."""
    pytest.importorskip("SimpleITK", reason=".h5 is optional: pip install '.[medical]'")
    rows = "".join(f"OK,1,0,0,0,{x},{y},{z}\n" for x, y, z in POINTS)
    Path("probe.csv").write_text(f"State,Q0,Qx,Qy,Qz,Tx,Ty,Tz\n{rows}")
    assert register(f"--tip 0,0,0 {line}", "lps.ply", "probe.csv") == 0
    assert ("probe.csv is taken as LPS. 3D Slicer shows a live tracker" in caplog.text) is is_warned
    np.testing.assert_allclose(hints["source"], POINTS * ([-1, -1, 1] if "RAS" in line else [1, 1, 1]), atol=1e-9)
    caplog.clear()
    assert register(line, "lps.ply", "lps.ply") == 0 and "taken as LPS" not in caplog.text


def test_the_axes_of_a_source_that_are_named_are_asked_for_no_more(folder, caplog, capsys):
    line = "--landmarks p.mrk.json p.mrk.json --source-axes"
    assert register(f"{line} lps", "lps.ply") == 0 and "is in LPS. If" not in caplog.text
    assert register("--source-axes ras", "lps.ply", "p.mrk.json") == 1
    assert "ras for p.mrk.json, which has its own" in capsys.readouterr().err


def test_json_says_what_made_the_answer(folder):
    assert register("--json x.json") == 0
    answer = json.loads(Path("x.json").read_text())
    assert answer["method"] == "known_method:make" and answer["calibrated"] is False
    assert answer["version"].startswith("0.") and answer["settings"]
    assert answer["weights"] == methods.made_of("known_method:make") != methods.made_of("gapr")


def test_a_viewpoint_of_a_source_that_is_turned_is_in_lps(folder, caplog, hints):
    assert register("--viewpoint 1,2,3", source="ras.ply") == 0 and list(hints["viewpoint"]) == [1.0, 2.0, 3.0]
    assert "--viewpoint is taken to be in LPS" in caplog.text
    caplog.clear()
    assert register("--viewpoint 1,2,3", source="lps.ply") == 0 and "--viewpoint" not in caplog.text
    assert register("--viewpoint 1,2,3 --source-axes ras") == 0 and "--viewpoint is taken to be in LPS" in caplog.text


@pytest.mark.parametrize(
    ("option", "expected_mm"),
    [("", (100.0, 50.0, -400.0)), ("--viewpoint none", None), ("--viewpoint 1,2,3", (1.0, 2.0, 3.0))],
)
def test_an_organised_cloud_says_where_its_camera_was(folder, image, hints, capsys, option, expected_mm):
    """Here in metres, as cameras write; a viewpoint that is given is one in mm."""
    write_pcd("camera.pcd", image / 1000.0)
    assert register(f"--source-units m {option}", source="camera.pcd") == 0
    said = "camera.pcd is an image seen from 100,50,-400 mm (--viewpoint none" in capsys.readouterr().out
    assert said is (not option)
    if expected_mm is None:
        assert hints["viewpoint"] is None
    else:
        np.testing.assert_allclose(hints["viewpoint"], expected_mm, atol=0.01)


def test_a_cloud_on_the_pixels_of_a_camera_in_the_origin_shows_it_and_a_mesh_does_not(
    folder, image, monkeypatch, capsys
):
    seen = []

    def look(self, source, target, viewpoint=None):
        seen.append(viewpoint)
        return RegistrationResult(RegistrationStatus.OK, np.eye(4), confidence=0.9, **FULL)

    monkeypatch.setattr(Known, "register", look)
    cloud = image[np.isfinite(image[..., 0])] - [100.0, 50.0, -400.0]
    np.save("s.npy", cloud)
    assert register("") == 0 and "s.npy is an image seen from 0,0,0 mm" in capsys.readouterr().out
    np.savez("s.npz", points=cloud, faces=[[0, 1, 2], [3, 4, 5]])
    assert register("", source="s.npz") == 0 and "seen from" not in capsys.readouterr().out
    np.testing.assert_array_equal(seen[0], np.zeros(3))
    assert seen[1] is None


@pytest.mark.parametrize(
    ("option", "made_of", "is_inferred"),
    [
        ("", {}, True),
        ("--viewpoint none", {}, False),
        ("", {"joined": True}, False),
        ("", {"faces": np.array(FACES)}, False),
    ],
)
def test_a_camera_is_not_looked_for_where_all_is_bone_or_seen_from_several_places(
    folder, monkeypatch, option, made_of, is_inferred
):
    asked = []

    class Own(Registrar):
        def prepare(self, target, units="mm"):
            return target

        def register(self, *_, **__):
            asked.append(self.config.clutter.infer_viewpoint)
            return RegistrationResult(RegistrationStatus.OK, np.eye(4), confidence=0.9, **FULL)

    monkeypatch.setattr(methods, "make", lambda name, config: Own(config))
    load = commands.options.load
    monkeypatch.setattr(commands.options, "load", lambda *given, **how: replace(load(*given, **how), **made_of))
    assert register(f"{option} --method gapr_search") == 0
    assert asked == [is_inferred]


def test_a_method_that_takes_no_viewpoint_registers_an_organised_cloud_without(folder, image, capsys):
    write_pcd("camera.pcd", image)
    assert register("", source="camera.pcd") == 0 and "seen from" not in capsys.readouterr().out


def write_pcd(path, grid):
    height, width = grid.shape[:2]
    head = ["VERSION .7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F", "COUNT 1 1 1"]
    head += [f"WIDTH {width}", f"HEIGHT {height}", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {width * height}"]
    Path(path).write_bytes("\n".join([*head, "DATA binary", ""]).encode() + grid.astype("<f4").tobytes())


def test_a_target_in_centimetres_that_is_read_as_millimetres_is_warned_of(folder, capsys):
    np.save("s.npy", POINTS / 10.0)
    np.save("t.npy", POINTS / 10.0)
    assert register("", "t.npy") == 0 and "warning: The bone is 33.8 mm across, read in mm" in capsys.readouterr().out
    assert register("--units cm", "t.npy") == 0 and "across" not in capsys.readouterr().out


def test_a_cloud_in_metres_meets_a_mesh_in_millimetres(folder, monkeypatch, capsys):
    """As RealSense and ROS write clouds, and as meshes of CT come."""
    seen = SimpleNamespace(source=None)

    def look(self, source, target):
        seen.source = source
        return RegistrationResult(RegistrationStatus.OK, np.eye(4), confidence=0.9, **FULL)

    monkeypatch.setattr(Known, "register", look)
    np.save("s.npy", POINTS / 1000.0)
    assert register("", "bone.ply") == 1 and "--source-units m, of the source" in capsys.readouterr().err
    assert register("--source-units m", "bone.ply") == 0
    np.testing.assert_allclose(seen.source, POINTS, atol=1e-9)


def test_a_unit_of_the_source_that_it_does_not_take_is_warned_of(folder, caplog):
    assert register("--source-units m", "bone.ply", "p.mrk.json") == 0
    assert "--source-units m changes nothing: p.mrk.json is in mm" in caplog.text


def test_a_unit_that_no_file_takes_is_warned_of(folder, caplog):
    assert register("--units cm", "p.mrk.json", "p.mrk.json") == 0
    assert "--units cm changes nothing: p.mrk.json and p.mrk.json are in mm" in caplog.text
    caplog.clear()
    np.save("s.npy", POINTS / 10.0)
    assert register("--units cm", "p.mrk.json") == 0 and "changes nothing" not in caplog.text
    assert register("", "p.mrk.json", "p.mrk.json") == 0 and "changes nothing" not in caplog.text


def test_a_unit_that_a_recording_does_not_take_is_warned_of(folder, caplog):
    """Whether a .csv is one, its tip says."""
    rows = "".join(f"OK,1,0,0,0,{x},{y},{z}\n" for x, y, z in POINTS)
    Path("probe.csv").write_text(f"State,Q0,Qx,Qy,Qz,Tx,Ty,Tz\n{rows}")
    assert register("--tip 0,0,0 --source-units m", "bone.ply", "probe.csv") == 0
    assert "--source-units m changes nothing: probe.csv is in mm" in caplog.text


def test_residuals_as_json_say_no_axes(folder, caplog):
    assert register("--residuals r.json --axes lps_to_ras") == 0 and register("--residuals r.json") == 0
    assert "is in LPS. If" not in caplog.text


@pytest.mark.parametrize("line", [
    "--out s.txt", "--out ./s.txt", "--residuals bone.ply", "--targets p.mrk.json --json p.mrk.json",
    "--landmarks p.mrk.json p.mrk.json --json p.mrk.json", "--json x.html --report x.html", "--out link.txt",
    "--config a.json --json a.json", "--json o --slicer o", "--json o/scene.mrml --slicer o",
    "--out t/pose.tfm --slicer t", "--targets rec/targets.mrk.json --slicer rec",
])  # fmt: skip
def test_a_file_of_another_option_is_never_written_over(folder, capsys, line):
    (folder / "rec").mkdir()
    save(folder / "rec" / "targets.mrk.json", Markups(POINTS[:4], ("a", "b", "c", "d")))
    (folder / "link.txt").symlink_to(folder / "s.txt")
    (folder / "a.json").write_text("{}")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert register(line, source="s.txt") == 1 and Known.asked == 0
    assert "expected a file for --" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("name", ["scene.mrml", "pose.tfm", "off_bone.vtk", "targets.mrk.json"])
def test_files_of_others_in_the_folder_of_a_scene_are_never_written_over(folder, capsys, name):
    (folder / "mine").mkdir()
    (folder / "mine" / name).write_text("<MRML></MRML>")
    assert register("--slicer mine") == 1 and Known.asked == 0
    assert f"mine with {name}, not known to be written by GAPR; name another folder" in capsys.readouterr().err
    assert [path.name for path in (folder / "mine").iterdir()] == [name]
    assert (folder / "mine" / name).read_text() == "<MRML></MRML>"


def test_a_scene_of_gapr_is_written_over_until_somebody_saves_another_one_there(folder, capsys):
    (folder / "scene").mkdir()
    (folder / "scene" / "mine.txt").write_text("stays")
    assert register("--slicer scene") == 0 and register("--slicer scene") == 0
    mrml = folder / "scene" / "scene.mrml"
    ElementTree.parse(mrml).write(mrml)  # without its comment, as 3D Slicer saves it
    assert register("--slicer scene") == 1
    said = capsys.readouterr().err
    assert "registered.ply" in said and "targets.mrk.json" not in said and "mine.txt" not in said


@pytest.mark.parametrize("name", ["1.dcm", "IM0001"])
def test_a_folder_of_dicom_is_no_folder_for_a_scene(folder, capsys, name):
    (folder / "ct").mkdir()
    (folder / "ct" / name).write_bytes(bytes(128) + b"DICM" + bytes(16))
    assert register("--slicer ct") == 1 and Known.asked == 0
    assert "got ct with DICOM files" in capsys.readouterr().err and len(list((folder / "ct").iterdir())) == 1


def test_a_pose_does_not_become_a_slice_of_the_source(folder, capsys):
    (folder / "sweep").mkdir()
    np.savetxt(folder / "sweep" / "0.txt", POINTS)
    assert register("--out sweep/pose.txt", source="sweep") == 1
    assert "which belongs to --source" in capsys.readouterr().err
    assert register("--out sweep/pose.tfm", source="sweep") == 0


@pytest.mark.parametrize("option", ["--residuals r.ply", "--slicer scene", "--targets p.mrk.json"])
def test_a_method_that_does_not_say_what_is_asked_is_refused_before_the_work(folder, capsys, option):
    assert register(f"--method icp --out p.tfm {option}") == 1
    printed = capsys.readouterr()
    assert option.split()[0] in printed.err and not printed.out and not (folder / "p.tfm").exists()


@pytest.mark.parametrize("path", ["a_file/x.json", ".", "a_file/b/c/x.json", "/proc/x.json"])
def test_a_path_that_cannot_be_written_is_refused_before_the_work(folder, path):
    assert register(f"--json {path}") == 1 and Known.asked == 0
    assert not list(folder.glob("a_file*/"))


def test_a_path_in_folders_that_are_not_there_yet_is_made(folder):
    assert register("--json a/b/x.json --slicer c/d") == 0
    assert (folder / "a/b/x.json").is_file() and (folder / "c/d/scene.mrml").is_file()


@pytest.mark.parametrize("option", ["--residuals r.ply", "--slicer scene", "--targets p.mrk.json"])
def test_a_pose_is_printed_and_written_though_the_method_says_no_more(folder, capsys, monkeypatch, option):
    monkeypatch.setattr(Known, "more", {})
    assert register(f"--out p.tfm --json x.json {option}") == 1
    printed = capsys.readouterr()
    assert "[1. 0. 0. 0.]" in printed.out and "use --method gapr" in printed.err
    assert (folder / "p.tfm").is_file() and json.loads((folder / "x.json").read_text())["status"] == "OK"


def test_a_pose_is_printed_before_a_file_fails(folder, capsys, monkeypatch):
    monkeypatch.setattr("gapr_core.runtime.files.check_writable", lambda path: None)
    assert register("--json a_file/x.json") == 1
    assert "[1. 0. 0. 0.]" in capsys.readouterr().out
