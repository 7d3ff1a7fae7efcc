"""The node turns a model once at most, as `model_axes` says, and takes the bone that `model_label` names."""

import numpy as np
import pytest

from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_ros.node.model import load_model
from gapr_ros.parameters import NodeParameters

POINTS = np.array([[0.0, 0.0, 0.0], [90.0, 0.0, 0.0], [0.0, 80.0, 0.0], [0.0, 0.0, 120.0]])
FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]


class Keep:
    """Prepares nothing."""

    def prepare(self, surface, units):
        return surface


def bone(path, said):
    head = ["ply", "format ascii 1.0", f"comment {said}", f"element vertex {len(POINTS)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(FACES)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(str, p)) for p in POINTS] + [" ".join(map(str, [3, *f])) for f in FACES]
    path.write_text("\n".join([*head, *rows]) + "\n")
    return str(path)


def loaded(path, **how):
    return load_model(Keep(), NodeParameters(model_path=str(path), model_unit="mm", **how)).target.points


@pytest.mark.parametrize(("said", "axes", "sign"), [
    ("SPACE=RAS", "as_is", 1.0), ("SPACE=RAS", "auto", -1.0), ("SPACE=RAS", "ras", -1.0), ("SPACE=RAS", "lps", 1.0),
    ("SPACE=LPS", "auto", 1.0), ("SPACE=LPS", "lps_to_ras", -1.0), ("bone", "auto", 1.0), ("bone", "ras", -1.0),
    ("bone", "lps_to_ras", -1.0),
])  # fmt: skip
def test_a_model_is_turned_once_at_most_whatever_its_file_says(tmp_path, said, axes, sign):
    points = loaded(bone(tmp_path / "bone.ply", said), model_axes=axes)
    assert np.allclose(points, POINTS * [sign, sign, 1.0])


def test_a_file_in_ras_that_is_read_as_it_is_names_the_parameter_whose_default_that_is(tmp_path, caplog):
    loaded(bone(tmp_path / "bone.ply", "SPACE=RAS"))
    assert (
        "says SPACE=RAS and is read as it is (--axes, --source-axes or model_axes): auto turns it to LPS" in caplog.text
    )


def test_the_bone_of_a_label_map_is_named_by_its_label(tmp_path):
    sitk = pytest.importorskip("SimpleITK", reason="it writes the label map: pip install SimpleITK")
    voxels = np.zeros((40, 30, 30), dtype=np.uint8)
    voxels[5:15, 8:20, 8:20], voxels[25:35, 8:20, 8:20] = 75, 76
    sitk.WriteImage(sitk.GetImageFromArray(voxels), str(tmp_path / "seg.nrrd"))
    for label, middle in (("75", 9.5), ("76", 29.5), ("75, 76", 19.5)):
        z = loaded(tmp_path / "seg.nrrd", model_label=label)[:, 2]
        assert (z.min() + z.max()) / 2.0 == pytest.approx(middle, abs=0.1)
    with pytest.raises(InvalidPointCloudError, match="2 of them .75, 76.; name one"):
        loaded(tmp_path / "seg.nrrd")


def test_a_segment_with_a_comma_in_its_name_is_named_in_quotes(tmp_path):
    """A comma parts the names of several segments; 3D Slicer allows it in one."""
    sitk = pytest.importorskip("SimpleITK", reason="it writes the label map: pip install SimpleITK")
    voxels = np.zeros((40, 30, 30), dtype=np.uint8)
    voxels[5:15, 8:20, 8:20], voxels[25:35, 8:20, 8:20] = 1, 2
    image = sitk.GetImageFromArray(voxels)
    for number, name in enumerate(("Femur, left", "Tibia")):
        image.SetMetaData(f"Segment{number}_Name", name)
        image.SetMetaData(f"Segment{number}_LabelValue", str(number + 1))
    sitk.WriteImage(image, str(tmp_path / "seg.nrrd"))
    for label, middle in (('"Femur, left"', 9.5), ('Tibia, "Femur, left"', 19.5), ("tibia,", 29.5)):
        z = loaded(tmp_path / "seg.nrrd", model_label=label)[:, 2]
        assert (z.min() + z.max()) / 2.0 == pytest.approx(middle, abs=0.1)
    with pytest.raises(InvalidPointCloudError, match='a segment Femur; got seg.nrrd: "Femur, left"; choose'):
        loaded(tmp_path / "seg.nrrd", model_label="Femur, left")


@pytest.mark.parametrize("path", ["file:///data/bone.stl", "package://bones/bone.stl"])
def test_a_model_path_with_a_scheme_is_said_to_be_none(path):
    with pytest.raises(ConfigError, match=f"model_path: a path; got {path}; write it without scheme"):
        loaded(path)
