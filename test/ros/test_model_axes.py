"""The node turns a model as `model_axes` says, and only so."""

from types import SimpleNamespace

import numpy as np
import pytest

from gapr_ros.node.model import load_model

POINTS = np.array([[0.0, 0.0, 0.0], [90.0, 0.0, 0.0], [0.0, 80.0, 0.0], [0.0, 0.0, 120.0]])
FACES = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]


class Keep:
    """Prepares nothing."""

    def prepare(self, surface, units):
        return surface


@pytest.mark.parametrize(("axes", "sign"), [("as_is", 1.0), ("lps_to_ras", -1.0)])
def test_a_file_that_says_its_axes_is_turned_once_at_most(tmp_path, axes, sign):
    path = tmp_path / "bone.ply"
    head = ["ply", "format ascii 1.0", "comment SPACE=RAS", f"element vertex {len(POINTS)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(FACES)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(str, p)) for p in POINTS] + [" ".join(map(str, [3, *f])) for f in FACES]
    path.write_text("\n".join([*head, *rows]) + "\n")
    parameters = SimpleNamespace(model_path=str(path), model_unit="mm", model_axes=axes, model_scale=1.0)
    model = load_model(Keep(), parameters)
    assert np.allclose(model.target.points, POINTS * [sign, sign, 1.0])
