"""What a file says of its patient reaches no output: every file of a run is searched for it."""

import json

import numpy as np
import pytest
from label_map_files import dicom_seg

from gapr_core.cli import main
from gapr_core.data.masks import mask_of
from gapr_core.formats import markups
from gapr_core.geometry import se3

sitk = pytest.importorskip("SimpleITK", reason="it writes the label map: pip install SimpleITK")

NAME, ID, BORN = "Mustermann", "PAT-0815-4711", "19610304"
HEADER = {"PatientName": f"{NAME}^Erika", "DICOM_0010_0020": ID, "PatientBirthDate": BORN, "comment": f"{NAME} {ID}"}
T = se3.exp([30.0, -20.0, 50.0, 0.5, -0.4, 1.0])
WRITTEN = ("out.json", "page.html", "pose.tfm", "residuals.json", "slicer/scene.mrml", "slicer/targets.mrk.json")


@pytest.fixture
def folder(tmp_path, femur):
    """A label map, points of a pointer and a plan, with the patient in the header or comments of each."""
    mask, affine = mask_of(femur, 2.0)
    image = sitk.GetImageFromArray(mask)
    image.SetSpacing([2.0, 2.0, 2.0])
    image.SetOrigin(affine[:3, 3].tolist())
    for key, value in (HEADER | {"Segment0_Name": "Femur", "Segment0_LabelValue": "1"}).items():
        image.SetMetaData(key, value)
    sitk.WriteImage(image, str(tmp_path / "seg.seg.nrrd"))
    points = femur.sample(800, np.random.default_rng(1))[0]
    points = se3.apply(se3.inverse(T), points[points[:, 2] < np.percentile(points[:, 2], 55)])
    rows = "".join(f"{NAME}{i},{x},{y},{z},{NAME}_{i},{BORN}\n" for i, (x, y, z) in enumerate(points))
    head = f"# {NAME} {ID}\n# CoordinateSystem = LPS\n# columns = id,x,y,z,label,desc\n"
    (tmp_path / "probe.fcsv").write_text(head + rows)
    markups.save(tmp_path / "plan.mrk.json", markups.Markups(femur.points[:1], ("entry",)))
    plan = json.loads((tmp_path / "plan.mrk.json").read_text())
    plan["markups"][0] |= {"name": NAME, "description": ID, "lastUsedControlPointNumber": 1}
    plan["markups"][0]["controlPoints"][0] |= {"description": f"{NAME} {BORN}", "associatedNodeID": ID}
    (tmp_path / "plan.mrk.json").write_text(json.dumps(plan))
    return tmp_path


def run(folder, target, *more):
    (folder / "out").mkdir()
    files = {"--out": "pose.tfm", "--residuals": "residuals.json", "--slicer": "slicer", "--report": "page.html",
             "--json": "out.json"}  # fmt: skip
    command = ["register", "--source", str(folder / "probe.fcsv"), "--target", str(target), "--method", "gapr_search"]
    for option, name in files.items():
        command += [option, str(folder / "out" / name)]
    return main([*command, "--targets", str(folder / "plan.mrk.json"), *more])


def said(folder, capsys):
    """Everything that the run has written and printed."""
    files = {str(p.relative_to(folder / "out")): p.read_bytes() for p in (folder / "out").rglob("*") if p.is_file()}
    printed = capsys.readouterr()
    return files | {"printed": (printed.out + printed.err).encode()}


def assert_nobody_is_in(outputs, *words):
    for name, content in outputs.items():
        found = [word for word in words if word.lower().encode() in content.lower()]
        assert not found, (name, found)


def test_names_in_headers_of_nrrd_and_markups_reach_no_output(folder, capsys, caplog):
    caplog.set_level("DEBUG")
    assert run(folder, folder / "seg.seg.nrrd", "--label", "Femur", "--guide") == 0
    outputs = said(folder, capsys) | {"log": caplog.text.encode()}
    assert set(WRITTEN) <= outputs.keys()
    assert NAME.encode() in (folder / "seg.seg.nrrd").read_bytes()  # the search would find it
    assert_nobody_is_in(outputs, NAME, ID, BORN, "1961-03-04", str(folder))


@pytest.mark.slow
def test_names_in_a_dicom_segmentation_reach_no_output(folder, femur, capsys, caplog):
    caplog.set_level("DEBUG")
    mask, affine = mask_of(femur, 3.0)
    path = dicom_seg(folder, names=("femur",), layers=(affine, [mask]))
    content = path.read_bytes()
    assert b"Doe^Jane" in content and b"19500101" in content and ID.encode() in content
    assert run(folder, path, "--label", "femur") == 0
    outputs = said(folder, capsys) | {"log": caplog.text.encode()}
    assert set(WRITTEN) <= outputs.keys()
    assert_nobody_is_in(outputs, "Doe^Jane", ID, "19500101", "20200101", NAME)
