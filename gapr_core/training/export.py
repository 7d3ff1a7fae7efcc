"""Turn the weights of a run into the file that ships: half precision, with a card in its header.

python -m gapr_core.training.export runs/best --licences config/licences.yaml --out NEW.safetensors

Of a file in place of a run, the same tensors and card are written with a checksum that covers them and the
configuration.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from gapr_core.model import weights
from gapr_core.runtime.console import exit_code, say
from gapr_core.runtime.settings import read_yaml

PARAMETRIC = "parametric bones of GAPR, Apache-2.0"
NOT_STATED = "of the real subjects not stated"


def main(arguments: list[str] | None = None) -> int:
    """Read a run's averaged weights, write them as they ship."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder that `gapr train` wrote, or a file of weights")
    parser.add_argument("--licences", type=Path, help="yaml: data that it was trained on, and its licence, a line each")
    parser.add_argument("--out", required=True, type=Path, help="*.safetensors")
    args = parser.parse_args(arguments)
    if args.run.is_file():
        if args.licences is not None:
            parser.error("a file of weights keeps its card: leave --licences out")
        digest = weights.sign(args.run, args.out)
    else:
        network, trained = weights.load(args.run / "weights.safetensors")
        digest = weights.save(network, args.out, card(trained, args.licences), torch.float16)
    say(f"{args.out}: {args.out.stat().st_size / 1e6:.1f} MB, sha256 of the tensors {digest}")
    return 0


def card(trained: dict[str, Any], licences: Path | None = None) -> dict[str, Any]:
    """Build the header's card of the weights: the run's own, its data, and the stated licences.

    Raises:
        ConfigError: `licences` is no yaml with a mapping.
    """
    real = max((entry["data"]["train_people"] for entry in trained.get("provenance", [])), default=0)
    data = f"{real} train subjects of splits.json, their shape models, and parametric bones" if real else PARAMETRIC
    stated = read_yaml(licences) if licences else {"licences": NOT_STATED} if real else {"all bones": PARAMETRIC}
    return {**trained, "data": data, "licences": stated, "precision": "float16"}


if __name__ == "__main__":
    raise SystemExit(exit_code(main, "python -m gapr_core.training.export"))
