"""The compiled steps of the network against the tensors that they replace: the same answers and gradients."""

from __future__ import annotations

import pytest
import torch

from gapr_core.model import attention, layers, pairs, point_matching, steps
from gapr_core.model.backbone import kpconv
from gapr_core.model.network import GAPRNet
from gapr_core.model.pairs import LocalPairs
from gapr_core.training.config import TrainConfig
from gapr_core.training.dataset import TrainingPairs
from gapr_core.training.losses import compute_losses

USERS = (attention, kpconv, layers, pairs, point_matching)


@pytest.fixture(scope="module")
def model(toy):
    return toy.small_config(superpoints=(10, 20), width=8, global_width=16, train_pairs=6)


@pytest.fixture(scope="module")
def batch(model, anatomy):
    settings = TrainConfig(bones=("femur",), mix={"L1": 1.0, "L2": 1.0}, pairs=8, micro_batch=4, pool=3)
    return TrainingPairs(settings, model, anatomy)[0]


@pytest.fixture
def with_tensors(monkeypatch):
    """A function that returns what another one returns without the compiled steps."""

    def call(work, *arguments):
        with monkeypatch.context() as patched:
            for module in USERS:
                patched.setattr(module.steps, "can_take", lambda *tensors: False)
            return work(*arguments)

    return call


def with_gradients(work, *arguments):
    leaves = [tensor.clone().requires_grad_() for tensor in arguments]
    out = work(*leaves)
    weight = torch.randn(out.shape, generator=torch.Generator().manual_seed(5)) * (out.detach() > -1e4)
    (out * weight).sum().backward()
    return out.detach(), [leaf.grad for leaf in leaves]


def same(found, wanted, tolerance=1e-5):
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=tolerance * float(b.abs().max()))


@pytest.mark.parametrize("lengths", [(40,), (17, 1, 22)])
@pytest.mark.parametrize("slope", [1.0, 0.1])
def test_the_compiled_norm_is_the_norm(with_tensors, lengths, slope):
    torch.manual_seed(0)
    x, norm = torch.randn(40, 24) * 3.0 + 1.0, layers.GroupNorm(24)
    weight, bias = torch.randn(24), torch.randn(24)

    def of(x, weight, bias):
        norm.__dict__["_parameters"].update(weight=weight, bias=bias)
        return norm(x, lengths, slope)

    found, wanted = with_gradients(of, x, weight, bias), with_tensors(with_gradients, of, x, weight, bias)
    same([found[0], *found[1]], [wanted[0], *wanted[1]])


def test_compiled_transport_is_transport_for_points_that_are_not_there_too(with_tensors):
    torch.manual_seed(0)
    scores, valid_p, valid_q = 4.0 * torch.randn(20, 9, 7), torch.rand(20, 9) < 0.6, torch.rand(20, 7) < 0.6
    valid_p[:, 4] = valid_q[:, 2] = True

    def of(scores, dustbin):
        return point_matching.log_optimal_transport(scores, dustbin, valid_p, valid_q, 15)

    found = with_gradients(of, scores, torch.tensor(2.0))
    wanted = with_tensors(with_gradients, of, scores, torch.tensor(2.0))
    exists = wanted[0] > -1e4
    same([found[0][exists], *found[1]], [wanted[0][exists], *wanted[1]])
    assert not bool((found[0][~exists] > -1e4).any())


def test_compiled_geometry_of_pairs_is_that_of_the_tensors(with_tensors, batch):
    cloud = batch.source
    for level, finer in zip(cloud.levels[1:], cloud.levels, strict=False):
        for fresh in (lambda a=level: LocalPairs(a, a, a.within), lambda a=level, b=finer: LocalPairs(a, b, a.below)):
            found, wanted = fresh().pgf, with_tensors(lambda made: made.pgf, fresh())
            kernel, among = kpconv.kernel_layout(), fresh()
            places = kpconv.influences(kpconv.surface_places(among), among.hood.valid, kernel, 0.8)
            same(
                [found, steps.surface_influences(among.centres, among.support, among.hood, kernel, 0.8)],
                [wanted, places],
                1e-4,
            )


def test_compiled_steps_learn_what_the_tensors_learn(with_tensors, model, batch):
    """Losses and gradients of a batch, whose clouds go through the backbone in one pass."""

    def learn():
        torch.manual_seed(0)
        network = GAPRNet(model)
        losses = compute_losses(network, batch, torch.Generator().manual_seed(0))[0]
        losses.total.backward()
        gradients = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
        return losses.total.detach(), torch.cat([gradient.flatten() for gradient in gradients])

    found, wanted = learn(), with_tensors(learn)
    torch.testing.assert_close(found[0], wanted[0], rtol=1e-5, atol=0.0)
    assert float((found[1] - wanted[1]).norm() / wanted[1].norm()) < 1e-4


def test_registration_takes_the_compiled_steps_and_finds_what_the_tensors_find(with_tensors, batch, model, monkeypatch):
    torch.manual_seed(0)
    network, taken = GAPRNet(model).eval(), set()

    def noted(name, step):
        return lambda *arguments: (taken.add(name), step(*arguments))[1]

    for name in ("norm", "embed", "surface_influences", "transport"):
        monkeypatch.setattr(steps, name, noted(name, getattr(steps, name)))

    def matched():
        with torch.inference_mode():
            return network(batch.source, batch.target).fine.log_z

    found, wanted = matched(), with_tensors(matched)
    exists = wanted > -1e4
    same([found[exists]], [wanted[exists]], 1e-4)
    assert taken == {"norm", "embed", "surface_influences", "transport"}
