"""One bone of the project's own for the tests of the core."""

import os
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import logit

from gapr_core import Registrar, RegistrarConfig
from gapr_core.config import ClutterConfig, SearchConfig, VerificationConfig
from gapr_core.data.parametric import make_bone
from gapr_core.data.specimen import Specimen
from gapr_core.registration.confidence.additive import Additive
from gapr_core.registration.confidence.classifier import Classifier
from gapr_core.registration.confidence.features import FEATURES_OF
from gapr_core.results import RegistrationResult, RegistrationStatus


class OnOwnClock:
    """A method that moves the clock: by 2 s to prepare, by 7 s to register, at the first call by 60."""

    name = "gapr"

    def __init__(self):
        self.now, self.calls = 100.0, 0

    def prepare(self, target, units="mm"):
        self.now += 2.0
        return target

    def register(self, source, target):
        self.calls += 1
        self.now += 60.0 if self.calls == 1 else 7.0
        return RegistrationResult(RegistrationStatus.OK, np.eye(4), confidence=0.9)


@pytest.fixture
def on_own_clock(monkeypatch):
    """Makes a method by whose clock a module times what it does."""

    def made(module):
        method = OnOwnClock()
        clock = SimpleNamespace(perf_counter=lambda: method.now, monotonic=time.monotonic)
        monkeypatch.setattr(module, "time", clock)
        return method

    return made


@pytest.fixture(scope="session")
def believing():
    """Makes a classifier by which every pose has one probability, and is surely of this bone."""

    def made(probability):
        of_all = dict.fromkeys(FEATURES_OF, Additive(float(logit(probability)), ()))
        return Classifier(of_all, dict.fromkeys(FEATURES_OF, Additive(99.0, ())))

    return made


@pytest.fixture(scope="session")
def femur():
    return make_bone("femur", 3)


@pytest.fixture(scope="session")
def specimen(femur):
    return Specimen(femur, "femur", "parametric-3", "parametric")


@pytest.fixture(scope="session")
def registrar():
    return Registrar.from_pretrained(RegistrarConfig(num_threads=1))


@pytest.fixture(scope="session")
def quick():
    """A registrar that tries little, eight times as fast: where the test is about what happens around it."""
    search, few = SearchConfig(references=2, spins=12, keep=100), VerificationConfig(middle_poses=20)
    clutter = ClutterConfig(infer_viewpoint=False)
    return Registrar(RegistrarConfig(num_threads=1, search=search, verification=few, clutter=clutter))


@pytest.fixture(scope="session")
def femur_cloud(femur):
    return femur.sample(8192, np.random.default_rng(0))[0]


@pytest.fixture(scope="session")
def target(registrar, femur_cloud):
    return registrar.prepare(femur_cloud)


@pytest.fixture(scope="session")
def anatomy_folder() -> Path:
    named = os.environ.get("GAPR_ANATOMY")
    folder = Path(named) if named else Path(__file__).resolve().parents[3] / "shared" / "anatomy"
    if not folder.is_dir():
        pytest.skip(f"the real bones do not ship and {folder} is absent: set GAPR_ANATOMY")
    return folder


@pytest.fixture(scope="module")
def dask_cluster():
    """Makes a Dask cluster; with `processes=False` its only worker is a thread of this process."""
    distributed = pytest.importorskip("distributed", reason="--dask is optional: pip install '.[cluster]'")
    made = []

    def make(**options):
        made.append(
            distributed.LocalCluster(**{"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None} | options)
        )
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture(scope="module")
def dask_address(dask_cluster):
    """Of a cluster whose only worker is a thread of this process."""
    return dask_cluster(processes=False).scheduler_address
