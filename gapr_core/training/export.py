"""Turn the weights of a run into the file that ships: half precision, with a card in its header.

python -m gapr_core.training.export runs/best --licences config/licences.yaml --out NEW.safetensors
python -m gapr_core.training.export runs/bone_head --under OLD.safetensors --out gapr_core/weights/gapr_net.safetensors
python -m gapr_core.training.export runs/probes --mean-with OLD.safetensors --out gapr_core/weights/gapr_net.safetensors
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from gapr_core.errors import WeightsError
from gapr_core.model import weights
from gapr_core.model.network import GAPRNet
from gapr_core.runtime.console import exit_code, say
from gapr_core.runtime.settings import read_yaml

PARAMETRIC = "parametric bones of GAPR, Apache-2.0"
NOT_STATED = "of the real subjects not stated"


def main(arguments: list[str] | None = None) -> int:
    """Read a run's averaged weights, write them as they ship."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder that `gapr train` wrote")
    parser.add_argument("--under", type=Path, help="weights that a bone head was trained on: they must be unchanged")
    parser.add_argument(
        "--mean-with", type=Path, nargs="+", default=[], help="weights of the same network: all average"
    )
    parser.add_argument("--licences", type=Path, help="yaml: data that it was trained on, and its licence, a line each")
    parser.add_argument("--out", required=True, type=Path, help="*.safetensors")
    args = parser.parse_args(arguments)
    network, trained = weights.load(args.run / "weights.safetensors")
    under = {} if args.under is None else {"network": card_under(network, args.under)}
    others = [weights.load(path) for path in args.mean_with]
    network = mean_of([network, *(other for other, _ in others)])
    averaged = {"mean_with": [its_card for _, its_card in others]} if others else {}
    digest = weights.save(network, args.out, card(trained, args.licences) | under | averaged, torch.float16)
    say(f"{args.out}: {args.out.stat().st_size / 1e6:.1f} MB, sha256 of the tensors {digest}")
    return 0


def card(trained: dict[str, Any], licences: Path | None = None) -> dict[str, Any]:
    """What the header says about the weights: the run's own card, its data, and the licences that are stated.

    Raises:
        ConfigError: `licences` is no yaml with a mapping.
    """
    real = max((entry["data"]["train_people"] for entry in trained.get("provenance", [])), default=0)
    data = f"{real} train subjects of splits.json, their shape models, and parametric bones" if real else PARAMETRIC
    stated = read_yaml(licences) if licences else {"licences": NOT_STATED} if real else {"all bones": PARAMETRIC}
    return {**trained, "data": data, "licences": stated, "precision": "float16"}


def card_under(network: GAPRNet, path: Path) -> dict[str, Any]:
    """The card of the weights that a head was trained on.

    Raises:
        WeightsError: the network has other tensors in their place.
    """
    given, its_card = weights.load(path)
    own = network.state_dict()
    changed = [name for name, t in given.state_dict().items() if name not in own or not torch.equal(t, own[name])]
    if changed:
        raise WeightsError(f"the tensors of {path}, and a head", f"another {changed[0]}", "train the head alone")
    return its_card


def mean_of(networks: list[GAPRNet]) -> GAPRNet:
    """The network whose tensors are the means of those of all (Wortsman et al. 2022, a uniform soup).

    It means something where one was trained on from another: their weights then lie in one basin of the loss.

    Raises:
        WeightsError: networks of different configurations.
    """
    first, states = networks[0], [network.state_dict() for network in networks]
    for network in networks[1:]:
        if network.config != first.config:
            what, given = "networks of one configuration", f"{first.config.name} and {network.config.name}"
            raise WeightsError(what, given, "average the stages of one training")
    mean = GAPRNet(first.config)
    mean.load_state_dict({name: torch.stack([state[name] for state in states]).mean(dim=0) for name in states[0]})
    return mean.eval()


if __name__ == "__main__":
    raise SystemExit(exit_code(main, "python -m gapr_core.training.export"))
