"""The page of one registration, and where to look next, as `gapr register` gives them."""

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from gapr_core.benchmark import methods
from gapr_core.cli import main
from gapr_core.formats import markups, transforms
from gapr_core.geometry import se3
from gapr_core.pages import views
from gapr_core.results import Guidance, Hypothesis, Patch, RegistrationResult, RegistrationStatus, Residuals
from gapr_core.surface import Surface

T = se3.exp([10.0, -20.0, 30.0, 0.3, -0.2, 0.5])
POINTS = np.random.default_rng(0).uniform(-40.0, 40.0, (20, 3))
DISTANCES = np.r_[np.linspace(-2.0, 3.0, 19), np.nan]
RESIDUALS = Residuals(POINTS, DISTANCES, np.r_[[True] * 15, [False] * 5])
RIVAL = Hypothesis(T @ se3.exp([0.0, 0.0, 7.0, 0.0, 0.0, 0.0]), 0.25)
NAMES = ("Qwistle", "4711", "1950")


def patch(z, tre95_mm, gain_mm):
    return Patch(np.array([1.0, 2.0, z]), np.array([0.0, 0.0, 1.0]), tre95_mm, 0.5, gain_mm)


def guidance(bone):
    """The second patch overlaps the first one."""
    return Guidance(bone, np.linspace(0, 6, len(bone)), 7.5, (patch(90, 1.25, 6.0), patch(95, 1.5, 5.0),
                                                              patch(10, 2.25, 4.0)))  # fmt: skip


def accepted(bone, **more):
    return RegistrationResult(
        RegistrationStatus.OK, T, 1e-4 * np.eye(6), 0.93, 1.21, 2.34, 0.75, (Hypothesis(T, 0.7), RIVAL),
        centre_mm=np.zeros(3), residuals=RESIDUALS, features={"margin": 2.5},
        contributions={"residual": -0.5, "margin": 1.75}, **more,
    )  # fmt: skip


def refused(bone, **more):
    return RegistrationResult(
        RegistrationStatus.AMBIGUOUS, confidence=0.41, hypotheses=(Hypothesis(T, 0.41), RIVAL), residuals=RESIDUALS,
        reason="another pose fits as well", contributions={"margin": -2.0}, **more,
    )  # fmt: skip


class StandIn:
    """Answers what it is given; for the page it does not matter who registers."""

    name = "gapr"
    answer = staticmethod(accepted)

    def __init__(self, config, weights):
        self.config = config

    def prepare(self, target, units="mm"):
        return target

    def register(self, source, target):
        found = guidance(target.points) if self.config.guide else None
        return self.answer(target.points, guidance=found)


@pytest.fixture
def register(tmp_path, monkeypatch, femur):
    """`gapr register` on a femur and some points, with a stand-in for the method."""
    monkeypatch.setitem(methods.OWN, "gapr", StandIn)
    np.savez(tmp_path / "Qwistle.npz", points=femur.points, faces=femur.faces)
    np.save(tmp_path / "Qwistle_Jane_1950.npy", POINTS)
    files = ["--source", str(tmp_path / "Qwistle_Jane_1950.npy"), "--target", str(tmp_path / "Qwistle.npz")]

    def call(*options, answer=accepted, files=files):
        monkeypatch.setattr(StandIn, "answer", staticmethod(answer))
        code = main(["register", *files, "--report", str(tmp_path / "page.html"), *options])
        page = tmp_path / "page.html"
        return code, page.read_text(encoding="utf-8") if page.exists() else ""

    return call


def text_of(page):
    """What a reader sees, without scripts, styles and tags."""
    bare = re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", bare))


def test_the_page_of_a_pose_begins_with_the_verdict_and_the_targets_and_folds_the_rest(register, tmp_path):
    markups.save(tmp_path / "plan.mrk.json", markups.Markups(np.array([[0.0, 0.0, 100.0]]), ("<b>entry",)))
    code, page = register("--targets", str(tmp_path / "plan.mrk.json"))
    text = text_of(page)
    expected = 1e-2 * np.sqrt(3.0 + 2.0 * 100.0**2)  # root of the trace of J C J^T, 100 mm from the pose's centre
    order = ["Pose accepted", "right within 4 mm and 5 degrees with a probability of 0.93", "below 2.3 mm in 95 of 100",
             f"1. &lt;b&gt;entry {expected:.1f} mm", "The points on the bone", "Why", "T_target_source, 4x4",
             "lead over the next hypothesis clearly for +1.75 2.500",
             "1 0.700 0.0 mm 0.0° 2 0.250 7.0 mm 0.0°"]  # fmt: skip
    assert code == 0 and [text.index(words) for words in order] == sorted(text.index(words) for words in order)
    folded = page[page.index("<details>") :]
    assert "Pose as numbers" in folded and "+1.75" in folded and "<b>entry" not in page
    assert "<script" not in page and not re.search(r"<(link|img|iframe)[^>]+(src|href)\s*=\s*.(?!data:)", page)
    assert len(page) < 3e6


def test_the_page_shows_the_pose_to_be_copied_as_a_first_guess(register, tmp_path):
    _, page = register()
    (tmp_path / "copied.txt").write_text(re.search("<pre>(.*?)</pre>", page, re.DOTALL)[1] + "\n")
    np.testing.assert_allclose(transforms.read(tmp_path / "copied.txt"), T, atol=1e-8)


def test_the_page_of_a_refusal_shows_what_to_do_and_offers_no_pose(register):
    code, page = register(answer=refused)
    text = text_of(page)
    order = ["No pose", "Another pose fits as well.", "Next:", "Where to measure next",
             "1 lower third, top 1.2 mm 50 %", "Why",
             "Lead over the next hypothesis speaks strongly against it."]  # fmt: skip
    assert code == 2 and [text.index(words) for words in order] == sorted(text.index(words) for words in order)
    assert "accepted" not in text.partition("Why")[0].lower() and "T_target_source" not in text and "<pre>" not in page
    assert 'class="verdict refused"' in page and 'class="ok"' not in page and "of the points fit" not in text
    assert "Error to expect" not in text


def test_a_refusal_without_any_hypothesis_has_a_page_too(register):
    few = RegistrationResult(RegistrationStatus.TOO_FEW_POINTS, reason="3 points")
    code, page = register(answer=lambda bone, guidance: few)
    assert code == 2 and "3 points." in page and "Measure more points" in page and "<img" not in page


def test_a_pose_without_residuals_is_shown_with_the_source_in_grey():
    bone = Surface(np.vstack([POINTS, -POINTS]))
    on = views.of_result(RegistrationResult(RegistrationStatus.OK, T, bone=bone, source=POINTS))
    np.testing.assert_allclose(on.points, se3.apply(T, POINTS))
    assert np.isnan(on.distance_mm).all()


def test_the_page_says_within_which_distances_half_and_95_percent_of_the_points_lie(register):
    """Of 19 sizes in order the 10th, and what lies at 0.95 of the 18 steps between them: a tenth from 18th to 19th."""
    sizes = sorted(abs(float(d)) for d in DISTANCES[:19])
    most = sizes[17] + 0.1 * (sizes[18] - sizes[17])
    said = f"Half of 19 points lie within {sizes[9]:.2f} mm of the bone, 95 % within {most:.2f} mm; 1 have no surface"
    assert said in text_of(register()[1])


@pytest.mark.parametrize(("evidence", "said"), [(2.0, "100 times likelier"), (-1.0, "10 times less likely")])
def test_the_page_says_why_by_the_pose_and_by_the_bone(register, evidence, said):
    answer = lambda bone, guidance: replace(accepted(bone), pose_probability=0.99, bone_evidence=evidence)  # noqa: E731
    text = text_of(register(answer=answer)[1])
    assert "If this is the right bone, the pose is right with a probability of 0.99." in text and said in text
    assert "the pose is right with" not in text_of(register()[1])


def test_a_result_shows_itself_in_a_notebook_and_saves_itself(tmp_path, femur, monkeypatch):
    result = replace(accepted(None), bone=femur, source=POINTS)
    shown = result._repr_html_()
    assert "Pose accepted" in shown and "<style>" in shown and "<html" not in shown and "body {" not in shown
    assert len(result.plot().axes) >= 2
    for name in ("pose.tfm", "pose.txt", "all.json", "page.html"):
        (result.report if name.endswith("html") else result.save)(tmp_path / name)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "pose.txt"), T)
    assert json.loads((tmp_path / "all.json").read_text())["confidence"] == 0.93
    with pytest.raises(ValueError, match="no pose to save: AMBIGUOUS"):
        refused(None).save(tmp_path / "pose.tfm")
    monkeypatch.setitem(sys.modules, "gapr_core.pages.registration_report", None)
    assert result._repr_html_() == f"<pre>{result}</pre>"


def test_nothing_of_a_header_and_no_file_name_reaches_the_page(register, tmp_path, femur):
    sitk = pytest.importorskip("SimpleITK", reason="it writes the header to read: pip install SimpleITK")
    voxels = np.zeros((40, 40, 40), dtype=np.uint8)
    voxels[8:32, 12:28, 10:30] = 1
    image = sitk.GetImageFromArray(voxels)
    image.SetSpacing([2.0, 2.0, 2.0])
    for key, value in {"PatientName": "Qwistle^Jane", "PatientID": "4711", "StudyDate": "19500101"}.items():
        image.SetMetaData(key, value)
    sitk.WriteImage(image, str(tmp_path / "Qwistle.nrrd"))
    assert b"Qwistle^Jane" in (tmp_path / "Qwistle.nrrd").read_bytes()
    (tmp_path / "Qwistle.mrk.json").write_text(json.dumps({"markups": [{
        "type": "Fiducial", "coordinateSystem": "LPS", "description": "Qwistle^Jane 4711 19500101",
        "controlPoints": [{"label": "entry", "position": [1.0, 2.0, 3.0], "description": "Qwistle 1950"}],
    }]}))  # fmt: skip
    (tmp_path / "Qwistle.csv").write_text(
        "# Qwistle^Jane 4711 1950\n" + "\n".join(",".join(map(str, p)) for p in POINTS) + "\n"
    )
    files = ["--source", str(tmp_path / "Qwistle.csv"), "--target", str(tmp_path / "Qwistle.nrrd"), "--label", "1"]
    for answer in (accepted, refused):
        _, page = register("--targets", str(tmp_path / "Qwistle.mrk.json"), "--guide", answer=answer, files=files)
        words = text_of(page)
        assert "Why" in words and ("entry" in words) == (answer is accepted)
        assert "Qwistle" not in page
        assert not [name for name in NAMES if name in words], words


def test_guide_prints_ranked_patches_that_do_not_overlap(register, tmp_path, capsys):
    code, _ = register("--guide", "--json", str(tmp_path / "out.json"), answer=refused)
    lines = capsys.readouterr().out.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("where to look next"))
    assert code == 2 and "7.50 mm" in lines[at]
    assert lines[at + 1].startswith("1. (1.0, 2.0, 90.0) mm") and "expected tre95 1.25 mm" in lines[at + 1]
    assert lines[at + 2].startswith("2. (1.0, 2.0, 10.0) mm") and "expected tre95 2.25 mm" in lines[at + 2]
    assert len(lines) == at + 3
    found = json.loads((tmp_path / "out.json").read_text())["guidance"]
    assert found["now_mm"] == 7.5 and [p["tre95_mm"] for p in found["patches"]] == [1.25, 2.25]


def test_guide_says_when_it_knows_no_place(register, capsys):
    register("--guide", answer=lambda bone, guidance: refused(bone))
    assert "not known, the source shows the whole bone" in capsys.readouterr().out


def test_guide_with_a_method_that_cannot_is_refused_in_one_line(register, capsys):
    code, page = register("--guide", "--method", "icp")
    error = capsys.readouterr().err
    assert code == 1 and page == "" and error.count("\n") == 1 and "--guide" in error and "gapr_search" in error


def test_a_report_that_cannot_be_written_is_refused_before_the_work(register, capsys, tmp_path, monkeypatch):
    def fail(*_):
        raise AssertionError("it registered")

    assert register("--report", str(tmp_path / "page.pdf"), answer=fail)[0] == 1
    assert ".html" in capsys.readouterr().err
    monkeypatch.delitem(sys.modules, "gapr_core.pages.registration_report")
    monkeypatch.delattr("gapr_core.pages.registration_report")
    monkeypatch.setitem(sys.modules, "jinja2", None)
    monkeypatch.delitem(sys.modules, "gapr_core.pages.report")
    assert register(answer=fail)[0] == 1
    assert "pip install 'gapr_ros[reports]'" in capsys.readouterr().err


def test_guidance_of_a_cloud_without_faces_is_drawn_too(tmp_path):
    bone = Surface(np.random.default_rng(1).uniform(0.0, 80.0, (50, 3)))
    replace(refused(None, guidance=guidance(bone.points)), bone=bone).report(tmp_path / "a.html")
    assert "Where to measure next" in (tmp_path / "a.html").read_text(encoding="utf-8")
