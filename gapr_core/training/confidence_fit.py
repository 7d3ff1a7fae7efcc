"""Fit a confidence model to records of answers: a few small networks, trained by weighted cross-entropy.

Wrong answers count twice, those about bones that are not the target's six times: the fit errs on the side of doubt. Of
the protocol `wrong_person` there are so many that one and a half times is enough.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits, dropout, silu
from tqdm import tqdm

from gapr_core.confidence import FEATURES, Calibration
from gapr_core.metrics.confidence import SURE, auroc, false_accepts

Array = NDArray[np.float64]
Layer = tuple[nn.Parameter, nn.Parameter]  # weights (members, inputs, outputs) and biases (members, 1, outputs)

WRONG_BONE, WRONG_PERSON, WRONG_POSE = 6.0, 1.5, 2.0  # how often an answer counts that is not right
HIDDEN = 64  # units of each of two hidden layers
SEED = 0
SMALLEST_SCALE = 1e-3  # of a feature that is the same in all records
BATCH, LEARNING_RATE, DECAY, DROPOUT = 256, 3e-3, 0.1, 0.1


def fit(records: list[dict[str, Any]], members: int = 4, epochs: int = 200) -> Calibration:
    """The model for the answers of one round.

    Args:
        records: with `features`, `right` and `protocol`, in whose name "wrong" says that no pose is right.
        members: networks, which differ in their first weights and drop-outs; their logits are averaged.
        epochs: passes over the records.
    """
    x, right, counts = _figures(records), _right(records), _counts(records)
    model = replace(Calibration.undecided(), means=x.mean(axis=0), scales=np.maximum(x.std(axis=0), SMALLEST_SCALE))
    z, truth, weight = (torch.from_numpy(a.astype(np.float32)) for a in (model.standardised(x), right, counts))
    layers = _train(z, truth, weight / weight.mean(), members, epochs)
    arrays = tuple((W.detach().double().numpy(), b.detach().double().numpy()[:, 0]) for W, b in layers)
    card: dict[str, object] = {"pairs": len(records), "right": float(right.mean()), "members": members}
    card |= {"epochs": epochs, "hidden": HIDDEN, "decay": DECAY, "dropout": DROPOUT, "seed": SEED}
    return replace(model, layers=arrays, card=card)


def held_out(records: list[dict[str, Any]], folds: int = 6) -> Array:
    """(N,) log odds of each record by a model that has seen nobody of its fold: cross-validation over people.

    Args:
        records: as for `fit`, with `person`, or where that is "none", `name`.
        folds: models to fit.
    """
    people = [record["name"] if record["person"] == "none" else record["person"] for record in records]
    names, who = np.unique(people, return_inverse=True)
    fold = (np.random.default_rng(0).permutation(len(names)) % folds)[who]
    x, logits = _figures(records), np.zeros(len(records))
    for number in tqdm(range(folds), unit="fold", leave=False):
        model = fit([record for record, its in zip(records, fold, strict=True) if its != number])
        logits[fold == number] = model.logits(x[fold == number])
    return logits


def summary(records: list[dict[str, Any]], logits: Array) -> str:
    """How well log odds (N,) tell right from wrong, in one line."""
    right, counts, confidence = _right(records), _counts(records), expit(logits)
    loss = counts @ (np.logaddexp(0.0, logits) - right * logits) / counts.sum()
    accepted = confidence >= 0.5
    wrong = [false_accepts(accepted, right, confidence, least) for least in (0.0, SURE)]
    found = [100.0 * (confidence[right] >= least).mean() for least in (0.5, SURE)]
    return (
        f"{len(records)} pairs, {right.sum()} right: loss {loss:.4f}, false accepts {wrong[0]} ({wrong[1]} at {SURE}), "
        f"right ones accepted {found[0]:.1f} % ({found[1]:.1f} % at {SURE}), AUROC {auroc(confidence, right):.4f}"
    )


def as_json(model: Calibration, card: dict[str, Any]) -> str:
    """The model as the file that `Calibration.load` reads."""
    layers = [[np.round(array, 5).tolist() for array in layer] for layer in model.layers]
    arrays = {key: np.round(getattr(model, key), 6).tolist() for key in ("means", "scales")}
    return json.dumps({"names": model.names, "card": card | model.card} | arrays | {"layers": layers}) + "\n"


def _figures(records: list[dict[str, Any]]) -> Array:
    return np.array([[record["features"][name] for name in FEATURES] for record in records])


def _right(records: list[dict[str, Any]]) -> NDArray[np.bool_]:
    return np.array([record["right"] for record in records], dtype=bool)


def _counts(records: list[dict[str, Any]]) -> Array:
    """(N,) how often each record counts."""
    return np.array([1.0 if record["right"] else _count_of_wrong(record["protocol"]) for record in records])


def _count_of_wrong(protocol: str) -> float:
    if protocol.endswith("wrong_person"):
        return WRONG_PERSON
    return WRONG_BONE if "wrong" in protocol else WRONG_POSE


def _train(z: torch.Tensor, right: torch.Tensor, counts: torch.Tensor, members: int, epochs: int) -> list[Layer]:
    """All members side by side on the same batches of standardised features z (N, F)."""
    torch.manual_seed(SEED)
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


def _logits(layers: list[Layer], z: torch.Tensor, drop: float = DROPOUT) -> torch.Tensor:
    """(members, N) log odds of (N, F) standardised features, with drop-out of the hidden units."""
    *hidden, (weights, biases) = layers
    x = z.expand(len(weights), -1, -1)
    for W, b in hidden:
        x = dropout(silu(x @ W + b), drop)
    return (x @ weights + biases)[..., 0]
