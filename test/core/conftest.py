"""One bone of the project's own for the tests of the core."""

import os
from pathlib import Path

import numpy as np
import pytest

from gapr_core import Registrar, RegistrarConfig
from gapr_core.data.parametric import make_bone
from gapr_core.data.specimen import Specimen


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


@pytest.fixture
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


@pytest.fixture
def dask_address(dask_cluster):
    """Of a cluster whose only worker is a thread of this process."""
    return dask_cluster(processes=False).scheduler_address
