"""Three patches of a femur, one of which may lie on other tissue."""

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig
from gapr_core.config import SensorConfig
from gapr_core.data.parametric import make_bone
from gapr_core.registration import registrar as registrars
from gapr_core.registration.checks.separate_patches import NAME, patches

RADIUS_MM, APART_MM = 18.0, 60.0


@pytest.fixture(scope="module")
def bone():
    return make_bone("femur", 0)


@pytest.fixture(scope="module")
def registrar():
    return Registrar(RegistrarConfig(num_threads=1, sensor=SensorConfig(kind="ultrasound")))


@pytest.fixture(scope="module")
def target(registrar, bone):
    return registrar.prepare(bone)


def three_patches(bone, off_mm, seed=11):
    """What a probe shows in three places, noise 0.3 mm; the first lies outside of the bone."""
    points, normals = bone.sample(20_000, np.random.default_rng(1))
    rng, middles = np.random.default_rng(seed), []
    while len(middles) < 3:
        k = rng.integers(len(points))
        far = all(np.linalg.norm(points[k] - points[other]) > APART_MM for other in middles)
        if far and all(normals[k] @ normals[other] > -0.2 for other in middles):
            middles.append(k)
    shown = []
    for number, k in enumerate(middles):
        near = (np.linalg.norm(points - points[k], axis=1) < RADIUS_MM) & (normals @ normals[k] > 0.3)
        patch = points[np.flatnonzero(near)[:300]]
        shown.append(patch + rng.normal(0.0, 0.3, patch.shape) + (number == 0) * off_mm * normals[k])
    return np.concatenate(shown)


def test_a_patch_off_the_bone_is_found_and_widens_the_bound(registrar, target, bone, monkeypatch):
    """Only this limit holds: with it off, the same answer is sure."""
    sound, off = three_patches(bone, 0.0), three_patches(bone, 3.0)
    assert patches(sound).max() == patches(off).max() == 2
    good, found = (registrar.register(source, target) for source in (sound, off))
    assert good.ok and good.confidence > 0.9 and NAME not in good.contributions
    assert found.ok and found.confidence <= 0.89 and NAME in found.contributions
    monkeypatch.setattr(registrars, "allowing_for_a_patch", lambda assessment, config: assessment)
    blind = registrar.register(off, target)
    assert blind.confidence > 0.9 and found.tre95_mm > 2.0 * blind.tre95_mm
