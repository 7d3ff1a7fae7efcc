"""Threads of linear algebra during a registration."""

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from gapr_core import Registrar
from gapr_core.data.parametric import make_bone
from gapr_core.registration.proposals.base import Proposals


def blas_threads():
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


class Witness:
    """Proposes nothing, and remembers how many threads linear algebra had."""

    name = "search"

    def prepare(self, target):
        pass

    def propose(self, source, target, rng):
        self.seen = blas_threads()
        return Proposals(np.empty((0, 4, 4)), np.empty(0))


@pytest.fixture(scope="module")
def cloud():
    return make_bone("tibia", 0).sample(3000, np.random.default_rng(0))[0]


def test_linear_algebra_has_one_thread_while_a_cloud_is_registered_and_as_many_as_before_afterwards(cloud):
    witness = Witness()
    registrar = Registrar(proposers=[witness])
    target = registrar.prepare(cloud)
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        registrar.register(cloud[:1500], target)
        assert witness.seen == {1}
        assert blas_threads() == before == {2}
