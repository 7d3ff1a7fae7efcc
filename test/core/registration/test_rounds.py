"""Who is asked, and how often: the network first, the search only if the answer is not sure."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from gapr_core import Accumulator, Registrar, RegistrarConfig, RegistrationStatus
from gapr_core.benchmark import methods
from gapr_core.data.protocols import make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError, InvalidPointCloudError, MethodUnavailableError
from gapr_core.geometry import se3
from gapr_core.registration.proposals.network import NetworkProposer
from gapr_core.registration.proposals.search import NormalAlignedSearch

ONE_THREAD = RegistrarConfig(num_threads=1)


class Fixed:
    """Proposes what it is given, and counts how often it is asked."""

    def __init__(self, name, poses):
        self.name, self.poses, self.asked, self.prepared = name, poses, 0, 0

    def prepare(self, target):
        self.prepared += 1

    def propose(self, source, target, rng):
        self.asked += 1
        return self.poses


@pytest.fixture(scope="module")
def pair(femur):
    return make_pair("L1", Specimen(femur, "femur", "parametric-3", "parametric"), seed=5)


SURE_BONE = replace(ONE_THREAD, other_bone_prior=0.0)


@pytest.mark.parametrize(("probability", "settings", "rounds"), [
    (0.96, {}, 1), (0.94, {}, 2), (0.92, {"sure": 0.9}, 1), (0.96, {"sure": 0.97}, 2), (0.96, {"sure": 1.1}, 2),
    (0.8, {"sure": 0.7}, 1), (0.8, {"sure": 0.7, "min_confidence": 0.85}, 2),
    (0.96, {"other_bone_prior": 0.95}, 2),
])  # fmt: skip
def test_the_next_proposer_is_asked_for_what_is_not_sure(pair, believing, probability, settings, rounds):
    first, second = (Fixed(name, pair.T_target_source[None]) for name in ("network", "search"))
    registrar = Registrar(replace(SURE_BONE, **settings), [first, second], believing(probability))
    result = registrar.register(pair.source, registrar.prepare(pair.target))
    assert (result.rounds, result.proposer) == (rounds, ("network", "search")[rounds - 1])
    assert (first.prepared, second.prepared, second.asked) == (1, 1, rounds - 1)


def test_a_doubtful_answer_is_kept_among_those_of_the_next_proposer(pair, believing):
    near = se3.exp([6.0, -5.0, 4.0, 0.05, 0.05, -0.05]) @ pair.T_target_source
    first, second = Fixed("network", near[None]), Fixed("search", np.eye(4)[None])
    registrar = Registrar(ONE_THREAD, [first, second], believing(0.7))
    result = registrar.register(pair.source, registrar.prepare(pair.target))
    assert (second.asked, result.rounds) == (1, 2)
    assert se3.pose_error(result.best, pair.T_target_source, pair.source)[0] < 1.0


def test_without_any_hypothesis_the_answer_is_a_refusal(pair):
    registrar = Registrar(ONE_THREAD, [Fixed("network", np.empty((0, 4, 4)))])
    result = registrar.register(pair.source, registrar.prepare(pair.target))
    assert result.status is RegistrationStatus.LOW_CONFIDENCE and result.T_target_source is None


def test_the_shipped_network_and_the_search_are_asked_in_this_order():
    registrar = Registrar.from_pretrained(ONE_THREAD)
    assert [p.name for p in registrar.proposers] == ["network", "search"]
    assert isinstance(registrar.proposers[0], NetworkProposer)
    assert isinstance(Registrar().proposers[0], NormalAlignedSearch) and len(Registrar().proposers) == 1


def test_a_confidence_that_is_no_number_is_a_refusal(pair, believing):
    registrar = Registrar(ONE_THREAD, [Fixed("network", pair.T_target_source[None])], believing(np.nan))
    result = registrar.register(pair.source, registrar.prepare(pair.target))
    assert not result.ok and result.T_target_source is None


def test_the_network_alone_finds_a_one_sided_view(pair):
    registrar = Registrar(ONE_THREAD, [NetworkProposer.from_weights()])
    result = registrar.register(pair.source, registrar.prepare(pair.target))
    assert se3.pose_error(result.best, pair.T_target_source, pair.source)[0] < 1.0


def test_at_least_one_proposer_is_needed():
    with pytest.raises(ConfigError, match="at least one proposer"):
        Registrar(proposers=[])


def test_a_gpu_that_is_not_there_and_a_missing_torch_are_named(monkeypatch):
    import torch

    if not torch.cuda.is_available():
        with pytest.raises(ConfigError, match="no GPU"):
            Registrar.from_pretrained(device="cuda")
    monkeypatch.setitem(sys.modules, "gapr_core.registration.proposals.network", None)
    with pytest.raises(MethodUnavailableError, match="pip install"):
        Registrar.from_pretrained()


@pytest.mark.parametrize(("name", "proposers"), [
    ("gapr", ["network", "search"]), ("gapr_search", ["search"]), ("gapr_network", ["network"]),
])  # fmt: skip
def test_the_benchmark_knows_the_whole_and_its_parts(name, proposers):
    assert [p.name for p in methods.make(name).proposers] == proposers


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_a_clean_piece_of_the_target_itself_is_found_and_accepted(registrar, femur_cloud, share):
    """What a newcomer tries first: cut a piece off, move it, and ask for it back."""
    target = registrar.prepare(femur_cloud)
    motion = se3.exp([40.0, -70.0, 20.0, 1.0, -2.0, 0.5])
    piece = femur_cloud[femur_cloud[:, 2] > np.quantile(femur_cloud[:, 2], 1.0 - share)]
    result = registrar.register(se3.apply(motion, piece), target)
    assert result.ok, str(result)
    assert np.abs(se3.apply(result.T_target_source, se3.apply(motion, piece)) - piece).max() < 0.1


def test_a_path_in_place_of_the_settings_names_where_weights_go():
    with pytest.raises(ConfigError, match=r"expected a RegistrarConfig; got 'net.safetensors'; .*from_weights"):
        Registrar.from_pretrained("net.safetensors")


@pytest.mark.parametrize("name", ["gapr", "gapr_search", "gapr_network", "gapr_tracker"])
def test_an_answer_and_a_refusal_name_their_method(pair, name):
    method = methods.make(name, ONE_THREAD)
    target = method.prepare(pair.target)
    results = method.register(pair.source, target), method.register(np.full((5, 3), np.nan), target)
    assert [result.method for result in results] == [name] * 2
    together = Accumulator(method, most=2).register(pair.source, target)
    assert together.method == "gapr_accumulator"


def test_a_given_pose_may_be_a_tensor_with_a_gradient(pair, believing):
    torch = pytest.importorskip("torch", reason="tensors: pip install torch")
    T, fixed = pair.T_target_source, Fixed("fixed", pair.T_target_source[None])
    registrar = Registrar(ONE_THREAD, [fixed], believing(0.99))
    target = registrar.prepare(pair.target)
    assert registrar.register(pair.source, target, initial=torch.tensor(T, requires_grad=True)).ok
    with pytest.raises(InvalidPointCloudError, match="a finite .* initial pose"):
        registrar.register(pair.source, target, initial=[[1.0, 2.0], [3.0]])


@pytest.mark.parametrize(("proposed", "rounds"), [("far", 2), ("near", 1)])
def test_a_given_pose_to_which_no_proposer_came_does_not_end_the_rounds(pair, believing, proposed, rounds):
    """It is weighed against the poses of one proposer, which missed it, and may have missed the right one."""
    truth = pair.T_target_source
    near = se3.exp([4.0, -3.0, 2.0, 0.02, 0.02, -0.02], pair.target.mean(axis=0)) @ truth
    far = se3.exp([0.0, 0.0, 90.0, 0.0, 0.0, 1.5], pair.target.mean(axis=0)) @ truth
    first, second = Fixed("network", (near if proposed == "near" else far)[None]), Fixed("search", near[None])
    registrar = Registrar(ONE_THREAD, [first, second], believing(0.99))
    target = registrar.prepare(pair.target)
    result = registrar.register(pair.source, target, initial=truth)
    assert (result.rounds, second.asked) == (rounds, rounds - 1)
