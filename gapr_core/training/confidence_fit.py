"""Fit a confidence model to records of answers: a few small networks, trained by weighted cross-entropy.

Wrong answers count twice, those about bones that are not the target's eight times: the fit errs on the side of doubt.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits, dropout, silu

from gapr_core.confidence import FEATURES, Calibration

Layer = tuple[nn.Parameter, nn.Parameter]  # weights (members, inputs, outputs) and biases (members, 1, outputs)

WRONG_BONE, WRONG_POSE = 8.0, 2.0  # how often a record counts where no pose is right, or the answer is not
HIDDEN = 32  # units of each of two hidden layers
BATCH, LEARNING_RATE, DECAY, DROPOUT = 256, 3e-3, 0.1, 0.1


def fit(records: list[dict[str, Any]], members: int = 4, epochs: int = 200) -> Calibration:
    """The model for the answers of one round.

    Args:
        records: with `features`, `right` and `protocol`, in whose name "wrong" says that no pose is right.
        members: networks, which differ in their first weights and drop-outs; their logits are averaged.
        epochs: passes over the records.
    """
    x = np.array([[record["features"][name] for name in FEATURES] for record in records])
    right = np.array([record["right"] for record in records], dtype=np.float32)
    counts = np.array([_count(record) for record in records], dtype=np.float32)
    model = replace(Calibration.undecided(), means=x.mean(axis=0), scales=np.maximum(x.std(axis=0), 1e-9))
    z = torch.from_numpy(model.standardised(x).astype(np.float32))
    layers = _train(z, torch.from_numpy(right), torch.from_numpy(counts / counts.mean()), members, epochs)
    arrays = tuple((W.detach().double().numpy(), b.detach().double().numpy()[:, 0]) for W, b in layers)
    return replace(model, layers=arrays, card={"pairs": len(records), "right": float(right.mean())})


def as_json(model: Calibration, card: dict[str, Any]) -> str:
    """The model as the file that `Calibration.load` reads."""
    layers = [[np.round(array, 5).tolist() for array in layer] for layer in model.layers]
    arrays = {key: np.round(getattr(model, key), 6).tolist() for key in ("means", "scales")}
    return json.dumps({"names": model.names, "card": card | model.card} | arrays | {"layers": layers}) + "\n"


def _count(record: dict[str, Any]) -> float:
    if record["right"]:
        return 1.0
    return WRONG_BONE if "wrong" in record["protocol"] else WRONG_POSE


def _train(z: torch.Tensor, right: torch.Tensor, counts: torch.Tensor, members: int, epochs: int) -> list[Layer]:
    """All members side by side on the same batches of standardised features z (N, F)."""
    torch.manual_seed(0)
    sizes = (z.shape[1], HIDDEN, HIDDEN, 1)
    layers = [_layer(members, *ends) for ends in zip(sizes[:-1], sizes[1:], strict=True)]
    parameters = [each for layer in layers for each in layer]
    optimiser = torch.optim.AdamW(parameters, lr=LEARNING_RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs)
    for _ in range(epochs):
        for batch in torch.randperm(len(z)).split(BATCH):
            truth = right[batch].expand(members, -1)
            each = binary_cross_entropy_with_logits(_logits(layers, z[batch]), truth, counts[batch], reduction="none")
            optimiser.zero_grad()
            each.mean(dim=1).sum().backward()  # type: ignore[no-untyped-call]
            optimiser.step()
        schedule.step()
    return layers


def _layer(members: int, inputs: int, outputs: int) -> Layer:
    """Initialised as in `torch.nn.Linear`."""
    most = inputs**-0.5
    weights = nn.Parameter(torch.empty(members, inputs, outputs).uniform_(-most, most))
    return weights, nn.Parameter(torch.empty(members, 1, outputs).uniform_(-most, most))


def _logits(layers: list[Layer], z: torch.Tensor) -> torch.Tensor:
    """(members, N) log odds of (N, F) standardised features, with drop-out."""
    *hidden, (weights, biases) = layers
    x = z.expand(len(weights), -1, -1)
    for W, b in hidden:
        x = dropout(silu(x @ W + b), DROPOUT)
    return (x @ weights + biases)[..., 0]
