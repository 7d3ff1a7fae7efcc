"""`gapr check-points`: from the answer of `gapr register --json` and touched points to a verdict."""

import json
from dataclasses import replace

import numpy as np
import pytest

from gapr_core import Registrar, check_points, cli
from gapr_core.commands.answer import read_json
from gapr_core.formats import markups
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus

T = se3.from_rotation_translation(se3.random_rotation(np.random.default_rng(3)), np.array([30.0, -20.0, 10.0]))
OK = RegistrationResult(
    RegistrationStatus.OK, T, np.diag([0.04] * 3 + [1e-5] * 3), 0.93, 0.5, 1.0, factor95=1.3, centre_mm=np.zeros(3)
)


@pytest.fixture
def folder(tmp_path, monkeypatch, femur_cloud):
    """A bone, its accepted pose, and thirty touched points in the frame of the source."""
    monkeypatch.chdir(tmp_path)
    np.save("bone.npy", femur_cloud)
    touched = femur_cloud[np.random.default_rng(0).choice(len(femur_cloud), 30, replace=False)]
    np.savetxt("touched.txt", se3.apply(np.linalg.inv(T), touched))
    (tmp_path / "pose.json").write_text(json.dumps(OK.to_json()))
    return tmp_path


def run(*more, points="touched.txt", pose="pose.json"):
    return cli.main(["check-points", "--points", points, "--target", "bone.npy", "--pose", pose, *more])


def test_what_register_wrote_is_read_as_it_was(folder):
    again = read_json(folder / "pose.json")
    assert again.ok and again.factor95 == 1.3 and again.confidence == 0.93
    for name in ("T_target_source", "covariance", "centre_mm"):
        assert np.array_equal(getattr(again, name), getattr(OK, name))


def test_a_right_pose_holds_with_exit_code_0(folder, capsys):
    assert run("--json", "found.json") == 0
    shown, found = capsys.readouterr().out, json.loads((folder / "found.json").read_text())
    assert shown.startswith("HOLDS  30 points") and "30. " in shown
    assert found["verdict"] == "HOLDS" and len(found["distance_mm"]) == len(found["expected_mm"]) == 30
    assert found["unseen_mm"] < 4.0 and found["tre95_mm"] < found["unseen_mm"]


def test_a_vague_pose_that_is_shown_to_be_off_does_not_hold(folder, capsys):
    vague = replace(OK, covariance=np.diag([25.0] * 3 + [1e-3] * 3))
    (folder / "vague.json").write_text(json.dumps(vague.to_json()))
    np.savetxt("moved.txt", np.loadtxt("touched.txt") + T[:3, :3].T @ [6.0, 0.0, 0.0])
    assert run("--json", "found.json", points="moved.txt", pose="vague.json") == 2
    shown, found = capsys.readouterr().out, json.loads((folder / "found.json").read_text())
    assert shown.startswith("CONTRADICTED") and f"is {found['shown_mm']:.1f} mm off over the bone" in shown
    assert found["shown_mm"] == pytest.approx(6.0, abs=0.5) and found["tre95_mm"] > found["shown_mm"]
    assert run("--within", "9", points="moved.txt", pose="vague.json") == 0
    assert run(pose="vague.json") == 0


def test_points_that_say_little_name_the_next_place_and_exit_with_2(folder, capsys):
    np.savetxt("three.txt", np.loadtxt("touched.txt")[:3])
    assert run(points="three.txt") == 2
    assert "touch more points, the next one at (" in capsys.readouterr().out


@pytest.mark.parametrize("places", [[0], [0, 0], [0, 1, 2, 3]])
def test_few_points_and_near_ones_are_no_reason_to_acquire_more_or_to_change_the_unit(folder, capsys, places):
    near = np.loadtxt("touched.txt")[0] + [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]]
    np.savetxt("near.txt", near[places])
    markups.save("near.mrk.json", markups.Markups(near[places], tuple("abcd"[: len(places)])))
    for name in ("near.txt", "near.mrk.json"):
        assert run(points=name) == 2
        shown = capsys.readouterr()
        assert f"{len(places)} point" in shown.out and not shown.err, shown


def test_points_in_metres_are_asked_for_their_unit(folder, caplog):
    """They are no bone's size either, but no touched points lie so near each other."""
    np.savetxt("metres.txt", np.loadtxt("touched.txt") / 1000.0)
    assert run(points="metres.txt") == 2
    assert "all points of metres.txt are within" in caplog.text and "name it with --points-units" in caplog.text
    caplog.clear()
    assert run("--points-units", "m", points="metres.txt") == 0
    assert "within" not in caplog.text


def test_a_pose_that_does_not_hold_exits_with_2_and_says_what_to_do(folder, capsys):
    moved = np.loadtxt("touched.txt") + [0.0, 0.0, 8.0]
    np.savetxt("moved.txt", np.vstack([moved, [900.0, 0.0, 0.0]]))
    assert run("--json", "found.json", points="moved.txt") == 2
    shown = capsys.readouterr().out
    assert shown.startswith("CONTRADICTED") and "31. no surface is near" in shown and "register again" in shown
    assert json.loads((folder / "found.json").read_text())["distance_mm"][30] is None
    np.savetxt("elsewhere.txt", moved + 4000.0)
    assert run(points="elsewhere.txt") == 2
    shown = capsys.readouterr().out
    assert "are they in the frame of the source, and in its unit" in shown and "register again" not in shown


def test_points_of_markups_are_called_as_there_though_some_were_not_placed(folder, capsys):
    points = np.loadtxt("touched.txt")[:4]
    points[2] += [0.0, 40.0, 0.0]
    markups.save("m.mrk.json", markups.Markups(points, ("head", "neck", " far\none ", "")))
    content = json.loads((folder / "m.mrk.json").read_text())
    content["markups"][0]["controlPoints"][0] |= {"positionStatus": "undefined"}
    content["markups"][0]["controlPoints"][3]["label"] = None
    (folder / "m.mrk.json").write_text(json.dumps(content))
    run(points="m.mrk.json")
    shown = [line for line in capsys.readouterr().out.splitlines() if line[:3] in ("1. ", "2. ", "3. ")]
    assert [line.rpartition(":")[0] for line in shown] == ["1. neck", "2. far one", ""]


@pytest.mark.parametrize(
    ("in_source", "said"),
    [
        (lambda touched: se3.apply(T, touched), "are they in the frame of the target?"),
        (lambda touched: touched * [-1.0, -1.0, 1.0], "name their axes as those of the source (--points-axes)"),
        (lambda touched: touched[:, [1, 2, 0]] + [0.0, 150.0, 0.0], "are they in the frame of the source, and in its"),
    ],
    ids=["target frame", "other axes", "another frame"],
)
def test_most_points_far_from_the_bone_are_asked_for_their_frame_and_not_for_another_registration(
    folder, capsys, in_source, said
):
    touched = np.loadtxt("touched.txt")
    np.savetxt("other.txt", np.vstack([in_source(touched), touched[:1]]))
    assert run(points="other.txt") == 2
    shown = capsys.readouterr().out
    assert said in shown and "register again" not in shown and "one with no surface near" not in shown, shown


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "expected the answer of a registration; got pose.json"),
        ("[1]", "the answer of a registration in pose.json"),
        ('{"status": "OK"}', "no 'transform' in it"),
        (
            json.dumps(RegistrationResult(RegistrationStatus.AMBIGUOUS, reason="two fit").to_json()),
            "AMBIGUOUS: two fit",
        ),
        (json.dumps(OK.to_json() | {"transform": np.diag([2.0, 2, 2, 1]).tolist()}), "a rigid transform in pose.json"),
        (json.dumps(OK.to_json() | {"covariance": [[1.0]]}), "finite numbers (6, 6) in pose.json; got (1, 1)"),
        (json.dumps(OK.to_json() | {"centre_mm": ["a", 0, 0]}), "numbers (3,) in pose.json"),
        (json.dumps(OK.to_json() | {"confidence": None}), "the answer of a registration in pose.json"),
        (json.dumps(OK.to_json() | {"confidence": [0.9]}), "the answer of a registration in pose.json"),
        (json.dumps(OK.to_json() | {"confidence": np.nan}), "got factor95 1.3 and confidence nan"),
        (json.dumps(OK.to_json() | {"factor95": np.nan}), "got factor95 nan and confidence 0.93"),  # any point held
        (json.dumps(OK.to_json() | {"factor95": 0.0}), "got factor95 0 and confidence 0.93"),
    ],
)
def test_another_file_than_an_accepted_answer_is_one_line(folder, capsys, content, said):
    (folder / "pose.json").write_text(content)
    assert run() == 1
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_an_answer_that_bad_input_leaves_is_named(folder, capsys):
    assert run("--json", "found.json") == 0
    capsys.readouterr()
    assert run("--json", "found.json", points="none.txt") == 1
    said = "found.json is not written, and what is there is of an earlier run\n"
    assert capsys.readouterr().out == said
    (folder / "pose.json").write_text(json.dumps(RegistrationResult(RegistrationStatus.AMBIGUOUS).to_json()))
    assert run("--json", "found.json") == 1 and capsys.readouterr().out == said


def test_the_answer_does_not_go_over_what_it_was_made_of(folder, capsys):
    assert run("--json", "pose.json") == 1
    assert "which belongs to --pose" in capsys.readouterr().err


@pytest.mark.parametrize("within", ["nan", "-1", "0", "x"])
def test_an_error_that_matters_is_a_number_above_0(folder, capsys, within):
    with pytest.raises(SystemExit, match="1"):
        run(f"--within={within}")
    assert "expected a number above 0" in capsys.readouterr().err


def test_the_library_has_it_under_one_name(femur_cloud):
    target = Registrar().prepare(femur_cloud)
    found = check_points(se3.apply(np.linalg.inv(T), femur_cloud[::200]), target, OK)
    assert str(found).startswith("HOLDS")
