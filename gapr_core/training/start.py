"""What a run starts with: weights, the parameters that it changes, and their optimiser."""

from __future__ import annotations

import torch
from torch import nn

from gapr_core.errors import ConfigError
from gapr_core.model import weights
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.training.config import TrainConfig


def begin(config: TrainConfig, model: ModelConfig) -> GAPRNet:
    """A network to train: with the weights of `config.initial`, or random ones.

    Where the bone head alone is trained, `config.initial` need not have one. A network without a head begins with
    all but the head of `config.initial`.

    Raises:
        ConfigError: the tensors of `config.initial` are not those of this network, other settings may differ; or the
            bone head is to be trained alone, and there is none, or no network for it.
        WeightsError: `config.initial` cannot be read.
    """
    network = GAPRNet(model)
    if config.trained != "all":
        check_head(config, model)
    if not config.initial:
        return network
    given = weights.load(config.initial)[0].state_dict()
    own = network.state_dict()
    if config.trained != "all":
        given = tensors_of(own, config.trained) | given
    elif model.bone_head == "none":
        given = {name: given[name] for name in given.keys() - tensors_of(given, "bone_head").keys()}
    if {name: tensor.shape for name, tensor in given.items()} != {name: tensor.shape for name, tensor in own.items()}:
        raise ConfigError(
            "initial weights of the network that is trained",
            f"another in {config.initial}",
            "train the network of that file (--model), or begin without it",
        )
    network.load_state_dict(given)
    return network.train()


def tensors_of(state: dict[str, torch.Tensor], name: str) -> dict[str, torch.Tensor]:
    """The tensors of one part of a network, such as `bone_head`."""
    return {tensor: state[tensor] for tensor in state if tensor.startswith(f"{name}.")}


def check_head(config: TrainConfig, model: ModelConfig) -> None:
    """Raise `ConfigError` where there is no bone head to train alone, or no network that it could rest on."""
    if model.bone_head == "none":
        raise ConfigError("a network with a bone head", "bone_head: none", "train all, or choose bone_head: mlp")
    if not config.initial:
        raise ConfigError("weights of the network under the bone head", "no `initial`", "name them with --initial")


def learning(network: GAPRNet, trained: str) -> list[nn.Parameter]:
    """The parameters that a run changes, all or those of one part; the others get no gradient."""
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(trained == "all" or name.startswith(f"{trained}."))
    return [parameter for parameter in network.parameters() if parameter.requires_grad]


def optimizer_of(learns: list[nn.Parameter], config: TrainConfig) -> torch.optim.AdamW:
    """AdamW in one pass over all parameters."""
    rates = {"lr": config.learning_rate, "weight_decay": config.weight_decay, "betas": (0.9, 0.98)}
    return torch.optim.AdamW(learns, fused=True, **rates)  # type: ignore[arg-type]
