"""A process of its own, whatever lies in the folder of its caller."""

import pytest

from gapr_core import clouds
from gapr_core.formats import transforms
from gapr_core.runtime import child


@pytest.fixture
def in_a_folder_of_traps(tmp_path, monkeypatch):
    """A working folder with files that are named like modules of Python, which end whoever imports them."""
    for name in ("random", "json", "tempfile"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('mine was run')")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("python_path", ["", ":"])
def test_a_module_of_the_working_folder_is_not_run(in_a_folder_of_traps, monkeypatch, python_path):
    monkeypatch.setenv("PYTHONPATH", python_path)
    done = child.run("gapr_core.formats.itk_child", "none.tfm")
    assert "mine was run" not in done.stderr + done.stdout


def test_what_a_child_prints_and_how_it_ends_is_known(tmp_path):
    done = child.run("gapr_core.cli", "--version")
    assert (done.returncode, done.stdout[:5], done.stderr) == (0, "gapr ", "")
    assert child.run("gapr_core.none").returncode == 1


def test_transforms_and_label_maps_are_read_beside_such_files(in_a_folder_of_traps):
    sitk = pytest.importorskip("SimpleITK", reason="it writes the label map: pip install SimpleITK")
    (in_a_folder_of_traps / "a.tfm").write_text(transforms.TFM.format("1 0 0 0 1 0 0 0 1 10 0 0"))
    assert transforms.read(in_a_folder_of_traps / "a.tfm")[0, 3] == -10.0
    image = sitk.Image(30, 30, 30, sitk.sitkUInt8)
    image[5:25, 5:25, 5:25] = 1
    image.SetSpacing([4.0, 4.0, 4.0])
    sitk.WriteImage(image, "a.nrrd")
    assert len(clouds.load("a.nrrd").points) > 100
