"""The caveats of a result: one text each, wherever the result is shown; and planned targets that are far or inside."""

import json
from dataclasses import replace

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig, SensorConfig, cli
from gapr_core.benchmark import methods
from gapr_core.config import ClutterConfig
from gapr_core.formats import markups, planning
from gapr_core.geometry import se3
from gapr_core.registration import caveats
from gapr_core.results import Effect, Finding, RegistrationResult, RegistrationStatus, ResultWarning
from gapr_core.surface import Surface

T = se3.exp([10.0, -20.0, 30.0, 0.3, -0.2, 0.5])
LOOSE = np.diag([0.01, 0.01, 0.01, 1e-6, 1e-6, np.radians(4.0) ** 2])
STATED = SensorConfig(kind="structured_light", tracking_mm=0.1)


def box(size):
    """A closed box around the origin, (3,) mm."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.asarray(size) / 2.0
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
             [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    return Surface(corners, np.array(faces))


def accepted(covariance=None, **more):
    covariance = 1e-6 * np.eye(6) if covariance is None else covariance
    return RegistrationResult(
        RegistrationStatus.OK, T, covariance, 0.93, 1.21, 2.34, 0.75, centre_mm=np.zeros(3), **more
    )


@pytest.fixture(scope="module")
def prepared(femur):
    return Registrar(RegistrarConfig(num_threads=1)).prepare(femur)


@pytest.mark.parametrize(("result", "sensor", "codes"), [
    (accepted(), SensorConfig(), ["sensor_unknown", "tracking_unknown"]),
    (accepted(), SensorConfig(kind="laser"), ["tracking_unknown"]),
    (accepted(), SensorConfig(kind="structured_light"), []),
    (accepted(), SensorConfig(tracking_mm=0.2), ["sensor_unknown"]),
    (accepted(), SensorConfig(tracking_deg=0.2), ["sensor_unknown"]),
    (accepted(LOOSE), STATED, ["turn_loose"]),
    (accepted(LOOSE / 4.0), STATED, []),
    (accepted(inferred_viewpoint=np.array([1.0, 2.0, 400.0])), STATED, ["viewpoint_inferred"]),
    (RegistrationResult(RegistrationStatus.AMBIGUOUS), SensorConfig(), []),
])  # fmt: skip
def test_a_result_is_warned_of_for_its_cause_alone(prepared, result, sensor, codes):
    found = caveats._warnings(result, prepared, RegistrarConfig(sensor=sensor))
    assert [warning.code for warning in found] == codes


def test_a_loose_turn_is_said_in_degrees_about_a_named_axis(prepared):
    (warning,) = caveats._warnings(accepted(LOOSE), prepared, RegistrarConfig(sensor=STATED))
    assert warning.text == "The bone may still turn about its long axis by 8 degrees."


def test_a_registrar_takes_a_path_an_array_and_a_surface_and_answers_the_same(tmp_path, femur, prepared):
    cloud = femur.sample(600, np.random.default_rng(5))[0]
    np.save(tmp_path / "probe.npy", cloud)
    registrar = Registrar(RegistrarConfig(num_threads=1, clutter=ClutterConfig(infer_viewpoint=False)))
    results = [registrar.register(source, prepared) for source in (tmp_path / "probe.npy", cloud, Surface(cloud))]
    assert len({str(result.T_target_source) for result in results}) == 1
    assert results[0].bone is prepared.surface and np.array_equal(results[0].source, cloud)
    assert [warning.code for warning in results[0].warnings] == ["sensor_unknown", "tracking_unknown"]


class StandIn:
    """Answers with every warning and finding that the test gives it."""

    name, answer = "gapr", None

    def __init__(self, config, weights):
        pass

    def prepare(self, target, units="mm"):
        return target

    def register(self, source, target):
        return self.answer


@pytest.fixture
def register(tmp_path, monkeypatch):
    """`gapr register` on a box of 60 x 60 x 300 mm; what the terminal, the page and the JSON say."""
    bone = box([60.0, 60.0, 300.0])
    np.save(tmp_path / "cloud.npy", bone.sample(40, np.random.default_rng(0))[0])
    monkeypatch.setitem(methods.OWN, "gapr", StandIn)

    def call(answer, capsys, plan=None, scale=1.0):
        np.savez(tmp_path / "bone.npz", points=scale * bone.points, faces=bone.faces)
        monkeypatch.setattr(StandIn, "answer", answer)
        line = ["register", "--source", f"{tmp_path}/cloud.npy", "--target", f"{tmp_path}/bone.npz"]
        line += ["--json", f"{tmp_path}/out.json", "--report", f"{tmp_path}/page.html"]
        if plan is not None:
            markups.save(tmp_path / "plan.mrk.json", markups.Markups(np.array(plan), ("entry",) * len(plan)))
            line += ["--targets", f"{tmp_path}/plan.mrk.json"]
        cli.main(line)
        page = (tmp_path / "page.html").read_text(encoding="utf-8")
        return capsys.readouterr().out, page, json.loads((tmp_path / "out.json").read_text())

    return call


@pytest.mark.parametrize("warning", [
    caveats.SENSOR_UNKNOWN, caveats.TRACKING_UNKNOWN, ResultWarning("turn_loose", "It may turn.", "Measure more."),
    ResultWarning("viewpoint_inferred", "A camera was inferred.", "Name it."),
    ResultWarning("uncalibrated", "A baseline has no calibrated confidence."),
])  # fmt: skip
def test_a_warning_is_in_the_terminal_on_the_page_and_in_the_json(register, capsys, warning):
    shown, page, answer = register(accepted(warnings=(warning,)), capsys)
    assert f"warning: {warning}\n" in shown
    assert warning.text.replace("'", "&#39;") in page and warning.advice in page
    assert answer["warnings"] == [{"code": warning.code, "text": warning.text, "advice": warning.advice}]


@pytest.mark.parametrize("answer", [accepted(), RegistrationResult(RegistrationStatus.AMBIGUOUS, reason="two fit")])
def test_a_bone_of_no_adult_is_in_the_terminal_on_the_page_and_in_the_json_also_of_a_refusal(register, capsys, answer):
    shown, page, found = register(answer, capsys, scale=0.1)
    (warning,) = found["warnings"]
    assert warning["code"] == "bone_size" and "31.2 mm across, read in mm, as small as a patella" in warning["text"]
    assert f"warning: {warning['text']} {warning['advice']}" in shown
    assert warning["text"] in page and "312 mm in cm" in warning["advice"]


def test_a_registrar_warns_of_the_size_of_a_bone_from_a_file(tmp_path, femur):
    small = replace(femur, points=femur.points / 10.0)
    np.savez(tmp_path / "bone.npz", points=small.points, faces=small.faces)
    registrar = Registrar(RegistrarConfig(num_threads=1))
    result = registrar.register(
        small.sample(300, np.random.default_rng(5))[0], registrar.prepare(tmp_path / "bone.npz")
    )
    assert "bone_size" in [warning.code for warning in result.warnings]


def test_a_finding_is_in_the_terminal_on_the_page_and_in_the_json(register, capsys):
    status = RegistrationStatus.AMBIGUOUS
    finding = Finding("mirror", Effect.REFUSE, 2.0, 1.0, status, "A mirror image fits.", "Measure the other side.")
    shown, page, answer = register(RegistrationResult(status, reason="why", findings=(finding,)), capsys)
    assert "A mirror image fits. Measure the other side." in shown
    assert "A mirror image fits." in page and "Measure the other side." in page
    assert answer["findings"][0]["check"] == "mirror" and answer["findings"][0]["effect"] == "REFUSE"


@pytest.mark.parametrize(("plan", "said", "place"), [
    ([[60.0, -70.0, 100.0]], "", "50 mm from the bone"),  # 30 in x, 40 in y
    ([[-130.0, 25.0, 100.0], [-128.0, 25.0, 90.0]], "", "100 mm from the bone"),
    ([[70.0, 0.0, 0.0]], "Check that the plan is of this bone", "40 mm from the bone"),
    ([[0.0, 0.0, 0.1], [0.0, 0.0, 0.05]], "Times 1000 it is near", "30 mm inside the bone"),
    ([[0.0, 0.0, 0.02], [0.0, 0.0, 0.0]], None, "30 mm inside the bone"),
    ([[0.0, 10.0, 100.0]], None, "20 mm inside the bone"),
    ([[30.0, 0.0, 0.0]], None, "on the bone"),
])  # fmt: skip
def test_a_planned_target_is_shown_with_its_distance_and_warned_of_where_it_is_far(register, capsys, plan, said, place):
    shown, page, answer = register(accepted(), capsys, plan)
    assert f"; {place}" in shown and place in page
    assert [w["code"] for w in answer["warnings"]] == [] if said is None else ["target_far"]
    if said:
        assert said in shown and said in page


@pytest.mark.parametrize(("factors", "said"), [
    ([-1.0, -1.0, 1.0], "With x and y negated it is near"), ([1e-3, 1e-3, 1e-3], "Times 1000 it is near"),
])  # fmt: skip
def test_a_plan_with_negated_axes_or_in_metres_names_the_mistake(register, capsys, monkeypatch, factors, said):
    bone = box([60.0, 60.0, 300.0])
    bone = replace(bone, points=bone.points + [100.0, 90.0, 500.0])
    result = replace(accepted(), bone=bone, source=bone.points)
    shown, page, answer = register(result, capsys, np.array([[130.0, 90.0, 500.0], [100.0, 60.0, 550.0]]) * factors)
    assert answer["warnings"][0]["advice"].startswith(said)
    assert said in shown and said in page and "2 of 2 planned targets are far from the bone" in shown
    assert all(target["distance_mm"] > 100.0 for target in answer["targets"])


def test_a_plan_in_the_frame_of_the_source_is_said_to_be_so():
    bone = box([60.0, 60.0, 300.0])
    result = replace(accepted(), bone=bone, source=bone.points + [0.0, 0.0, 900.0])
    (warning,) = result.with_targets([[30.0, 30.0, 1049.0]]).warnings
    assert "not of the source" in warning.advice


def test_the_distance_to_a_mesh_is_exact_and_negative_inside_even_if_its_faces_are_turned():
    rng, size = np.random.default_rng(0), np.array([60.0, 40.0, 100.0])
    points = rng.uniform(-80.0, 80.0, (300, 3))
    beyond = np.abs(points) - size / 2.0
    expected = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    bone = box(size)
    for faces in (bone.faces, bone.faces[:, ::-1]):
        np.testing.assert_allclose(planning.distances_mm(points, replace(bone, faces=faces)), expected, atol=1e-9)


def test_a_refusal_keeps_no_caveat_of_a_pose_and_no_error_at_a_target():
    result = replace(accepted(warnings=(caveats.SENSOR_UNKNOWN,)), bone=box([60.0, 60.0, 300.0]))
    finding = Finding("equal rival", Effect.REFUSE, 1.0, 1.0, RegistrationStatus.AMBIGUOUS, "two fit")
    refused = result.with_targets([[0.0, 0.0, 0.0]]).refused(finding)
    assert refused.warnings == () and refused.targets == () and refused.errors_at([[0.0, 0.0, 0.0]]) == ()
    assert result.with_targets(np.zeros((0, 3))).warnings == result.warnings  # an empty plan
