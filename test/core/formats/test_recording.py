"""The recording for rerun: what is logged, with a stand-in for the library; and a file, where it is installed."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core.errors import ConfigError, MethodUnavailableError
from gapr_core.formats import recording
from gapr_core.geometry import se3
from gapr_core.results import Hypothesis, RegistrationResult, RegistrationStatus, Residuals, TargetError
from gapr_core.surface import Surface

T = se3.from_rotation_translation(Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix(), [10.0, -70.0, 200.0])
POINTS = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 0.0, 30.0]])
BONE = Surface(se3.apply(T, POINTS), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
RESIDUALS = Residuals(POINTS, np.array([-3.0, 0.0, 3.0, np.nan]), np.array([True, True, True, False]))
RANKED = (Hypothesis(T, 0.9), Hypothesis(se3.exp([5.0, 0, 0, 0, 0, 0]) @ T, 0.1))
ACCEPTED = RegistrationResult(
    RegistrationStatus.OK, T, np.eye(6), 0.9, 0.5, 1.0, 0.75, hypotheses=RANKED, residuals=RESIDUALS
)
REFUSED = RegistrationResult(RegistrationStatus.AMBIGUOUS, confidence=0.5, hypotheses=RANKED, residuals=RESIDUALS)


class Stream:
    """Stands in for rerun: keeps what is logged as (entity, component, values, place on the timeline)."""

    def __init__(self, name):
        self.logged, self.at, Stream.last = [], None, self

    def set_time(self, timeline, sequence):
        self.at = sequence

    def log(self, entity, component, static=False):
        self.logged.append((entity, *component, None if static else self.at))

    def save(self, path):
        path.write_bytes(b"RRF2")

    def disconnect(self):
        pass

    def of(self, entity, kind):
        return [(values, at) for name, said, values, at in self.logged if (name, said) == (entity, kind)]


@pytest.fixture
def stand_in(monkeypatch):
    kinds = ("Transform3D", "Points3D", "Mesh3D", "TextDocument", "Scalars")
    made = {kind: lambda *args, kind=kind, **named: (kind, {"given": args} | named) for kind in kinds}
    views = SimpleNamespace(LBU=("ViewCoordinates", {}))
    monkeypatch.setitem(sys.modules, "rerun", SimpleNamespace(RecordingStream=Stream, ViewCoordinates=views, **made))


def written(path, result, targets=()):
    recording.write(path, replace(result, bone=BONE, source=POINTS, targets=targets))
    return Stream.last


def test_the_source_lies_on_the_bone_and_its_rivals_follow_on_the_timeline(tmp_path, stand_in):
    stream = written(tmp_path / "a.rrd", ACCEPTED)
    (best, first), (rival, second) = stream.of("source", "Transform3D")
    assert (first, second) == (1, 2) and [at for _, at in stream.of("probability", "Scalars")] == [1, 2]
    np.testing.assert_allclose(POINTS @ best["mat3x3"].T + best["translation"], BONE.points)
    np.testing.assert_allclose(rival["translation"], T[:3, 3] + [5.0, 0.0, 0.0])
    (mesh, _), = stream.of("target", "Mesh3D")  # fmt: skip
    assert np.array_equal(mesh["vertex_positions"], BONE.points)
    assert np.array_equal(mesh["triangle_indices"], BONE.faces)


def test_points_are_blue_inside_and_red_outside_and_grey_under_a_rival(tmp_path, stand_in):
    (best, _), (rival, _) = written(tmp_path / "a.rrd", ACCEPTED).of("source", "Points3D")
    assert best["colors"].tolist() == [[0, 0, 255], [255, 255, 255], [255, 0, 0], [150, 150, 150]]
    assert rival["colors"].tolist() == [150, 150, 150]


def test_planned_targets_are_named_with_their_errors(tmp_path, stand_in):
    (planned, _), = written(tmp_path / "a.rrd", ACCEPTED, (TargetError("hip", (1.0, 2.0, 3.0), 0.5, 0.9),)).of(
        "planned", "Points3D"
    )  # fmt: skip
    assert planned["labels"] == ["hip: 0.50 mm (95 %: 0.90 mm)"] and planned["given"] == ([(1.0, 2.0, 3.0)],)


def test_a_refusal_is_shown_and_said_to_be_one(tmp_path, stand_in):
    stream = written(tmp_path / "a.rrd", REFUSED)
    (answer, _), = stream.of("answer", "TextDocument")  # fmt: skip
    assert "Refused" in answer["given"][0] and len(stream.of("source", "Transform3D")) == 2
    nothing = RegistrationResult(RegistrationStatus.TOO_FEW_POINTS)
    assert written(tmp_path / "b.rrd", nothing).of("source", "Points3D") == []


def test_an_ending_and_a_missing_library_are_said_before_the_work(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="a recording as .rrd; got a.html"):
        recording.check(tmp_path / "a.html")
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MethodUnavailableError, match=r"no rerun; pip install 'gapr_ros\[rerun\]'"):
        recording.check(tmp_path / "a.rrd")


def test_a_recording_is_a_file_of_rerun(tmp_path):
    pytest.importorskip("rerun", reason="the viewer whose files are written: pip install rerun-sdk")
    hip = TargetError("hip", (1.0, 2.0, 3.0), 0.5, 0.9)
    recording.write(tmp_path / "a.rrd", replace(ACCEPTED, bone=BONE, source=POINTS, targets=(hip,)))
    assert (tmp_path / "a.rrd").read_bytes()[:3] == b"RRF" and (tmp_path / "a.rrd").stat().st_size > 2000
