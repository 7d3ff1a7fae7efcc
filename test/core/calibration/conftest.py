import pytest

from gapr_core.calibration import pairs
from gapr_core.data.pool import parametric_specimen

FOLDER = "folder"


@pytest.fixture(scope="session")
def bones():
    return {bone: [parametric_specimen(bone, number) for number in (0, 1, 2)] for bone in ("femur", "tibia")}


@pytest.fixture
def people(bones, monkeypatch):
    """The bones that pairs are drawn from, as those of `FOLDER`."""
    monkeypatch.setattr(pairs, "BONES", ("femur", "tibia"))
    monkeypatch.setattr(pairs, "_KEPT", {(FOLDER, "train"): bones})
    monkeypatch.setattr(pairs, "SHAPE_SHARE", 0.0)
    pairs.setting_of.cache_clear()
    return bones
