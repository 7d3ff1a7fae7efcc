"""Start of a run: its weights, and their optimiser."""

from __future__ import annotations

import torch

from gapr_core.errors import ConfigError
from gapr_core.model import weights
from gapr_core.model.config import ModelConfig
from gapr_core.model.network import GAPRNet
from gapr_core.training.config import TrainConfig


def begin(config: TrainConfig, model: ModelConfig) -> GAPRNet:
    """Begin with the weights of `config.initial`, or random ones.

    Raises:
        ConfigError: the tensors of `config.initial` are not those of this network, other settings may differ.
        WeightsError: `config.initial` cannot be read.
    """
    network = GAPRNet(model)
    if not config.initial:
        return network
    given, own = weights.load(config.initial)[0].state_dict(), network.state_dict()
    if {name: tensor.shape for name, tensor in given.items()} != {name: tensor.shape for name, tensor in own.items()}:
        raise ConfigError(
            "initial weights of the network that is trained",
            f"another in {config.initial}",
            "train the network of that file (--model), or begin without it",
        )
    network.load_state_dict(given)
    return network.train()


def optimizer_of(network: GAPRNet, config: TrainConfig) -> torch.optim.AdamW:
    """AdamW in one pass over all parameters."""
    rates = {"lr": config.learning_rate, "weight_decay": config.weight_decay, "betas": (0.9, 0.98)}
    return torch.optim.AdamW(network.parameters(), fused=True, **rates)  # type: ignore[arg-type]
