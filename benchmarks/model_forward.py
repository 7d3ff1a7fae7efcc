"""Time of one forward pass on one CPU thread, with a fixed matrix product and naive forms of the hot operators.

nice python benchmarks/model_forward.py [--pairs 3] [--repeats 40] [--superpoints 90 110] [--model YAML] [--json FILE]

CPU time of the process. On a shared machine it depends on what the others do, by its caches and its clock: all forms
are therefore measured in turn within every repetition, each after one untimed call of its own. Minimum and median over
the repetitions of each pair, then the mean over the pairs; ratios are medians over all of them.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.model import point_matching
from gapr_core.model.backbone.kpconv import KPConv
from gapr_core.model.config import ModelConfig
from gapr_core.model.encoding.relative import RelativeEncoder
from gapr_core.model.network import GAPRNet
from gapr_core.model.pairs import LocalPairs
from gapr_core.model.pyramid import build_cloud, target_frame
from gapr_core.model.types import Cloud

REFERENCE = "reference: ten products of 512 x 512 matrices"


class NaiveEncoding:
    """Eq. (2) as it is written: r_ij and r_ij W^R for every pair, then a product with every query."""

    def __init__(self, r: Tensor, r_key: Tensor, r_value: Tensor | None) -> None:
        self.r_key, self.r_value = r_key, r_value

    def query(self, q: Tensor) -> Tensor:
        return q

    def key(self, k: Tensor) -> Tensor:
        return k

    def bias(self, logits: Tensor, blocks: Tensor) -> Tensor:
        return logits + torch.einsum("bnhc,bnmc->bnhm", blocks, self.r_key)

    def values(self, blocks: Tensor, weights: Tensor) -> Tensor:
        return blocks if self.r_value is None else blocks + torch.einsum("bnhm,bnmc->bnhc", weights, self.r_value)


def naive_relative(self: RelativeEncoder, hidden: Tensor) -> Any:
    """In place of `RelativeEncoder.forward`."""
    r = self.second(hidden)
    return NaiveEncoding(r, self.to_key(r), self.to_value(hidden) if self.to_value else None)


def naive_kpconv(self: KPConv, x: Tensor, pairs: LocalPairs) -> Tensor:
    """One kernel point after the other."""
    places, near = self.places(pairs), x[pairs.index]
    count = pairs.hood.valid.sum(1, keepdim=True)
    out = x.new_zeros(len(near), self.weight.shape[1])
    for point, weight in zip(self.kernel, self.weight.view(len(self.kernel), x.shape[1], -1), strict=True):
        distance = torch.linalg.vector_norm(places - point, dim=-1)
        influence = (1.0 - distance / self.sigma).clamp(min=0) * pairs.hood.valid
        out = out + ((near @ weight) * influence[..., None]).sum(1) / count
    return out


def naive_scale(log_z: Tensor, mu: Tensor, nu: Tensor, rounds: int) -> Tensor:
    """Every round of the optimal transport in log space."""
    u, v = torch.zeros_like(mu), torch.zeros_like(nu)
    for _ in range(rounds):
        u = mu.clamp(min=1e-30).log() - (log_z + v[:, None]).logsumexp(2)
        v = nu.clamp(min=1e-30).log() - (log_z + u[:, :, None]).logsumexp(1)
    return log_z + u[..., None] + v[:, None]


@contextmanager
def naive_operators() -> Iterator[None]:
    """The network with the textbook form of its hot operators."""
    with (
        patch.object(RelativeEncoder, "forward", naive_relative),
        patch.object(KPConv, "forward", naive_kpconv),
        patch.object(point_matching, "_scale", naive_scale),
    ):
        yield


def clouds(config: ModelConfig, count: int) -> list[tuple[Cloud, Cloud]]:
    """Pairs of the paper's protocol from parametric femurs."""
    found = []
    for number in range(count):
        pair = make_pair("paper", parametric_specimen("femur", number), number)
        frame = target_frame(pair.target, config)
        found.append((build_cloud(pair.source, frame, config), build_cloud(pair.target, frame, config)))
    return found


def cpu_ms(call: Callable[[], Any]) -> float:
    """CPU time of a call, ms, after an untimed one."""
    call()
    begun = time.process_time()
    call()
    return 1e3 * (time.process_time() - begun)


def forms(network: GAPRNet, source: Cloud, target: Cloud) -> dict[str, Callable[[], Any]]:
    """What is timed, by the name of its row."""
    matrix, kept = torch.ones(512, 512), network.backbone(target)

    def naive() -> None:
        with naive_operators():
            network(source, target)

    return {
        REFERENCE: lambda: [matrix @ matrix for _ in range(10)],
        "forward": lambda: network(source, target),
        "forward, the target's features kept": lambda: network(source, target, kept),
        "forward, the whole target as the source": lambda: network(target, target),
        "naive operators": naive,
    }


def times(network: GAPRNet, pairs: list[tuple[Cloud, Cloud]], repeats: int) -> dict[str, Any]:
    """CPU times, ms, of every form: (repetitions, pairs)."""
    calls = [forms(network, *pair) for pair in pairs]
    rows = [[{name: cpu_ms(call) for name, call in own.items()} for own in calls] for _ in range(repeats)]
    return {name: np.array([[ms[name] for ms in row] for row in rows]) for name in calls[0]}


def check_naive(network: GAPRNet, source: Cloud, target: Cloud) -> None:
    """The naive operators must say the same."""
    answer = network(source, target).coarse
    with naive_operators():
        torch.testing.assert_close(network(source, target).coarse, answer, atol=1e-2, rtol=1e-2)


def largest_items(network: GAPRNet, pairs: list[tuple[Cloud, Cloud]], count: int = 5) -> dict[str, str]:
    """Share of the CPU time of the operators that take most of it."""
    with torch.profiler.profile() as profile:
        for _ in range(5):
            for pair in pairs:
                network(*pair)
    items = sorted(profile.key_averages(), key=lambda e: -e.self_cpu_time_total)
    total = sum(e.self_cpu_time_total for e in items)
    return {e.key: f"{100 * e.self_cpu_time_total / total:.0f} %" for e in items[:count]}


@torch.inference_mode()
def measure(config: ModelConfig, count: int, repeats: int) -> dict[str, Any]:
    """Sizes, times and ratios, and the largest items of the profile."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network, pairs = GAPRNet(config).eval(), clouds(config, count)
    check_naive(network, *pairs[0])
    ms = times(network, pairs, repeats)
    sides = dict(zip(("source", "target"), zip(*pairs, strict=True), strict=True))
    return {
        "torch": torch.__version__,
        "repeats": repeats,
        "pairs": count,
        "parameters": sum(p.numel() for p in network.parameters()),
        "points": {side: mean(c.fine.lengths[0] for c in found) for side, found in sides.items()},
        "superpoints": {side: mean(c.coarse.lengths[0] for c in found) for side, found in sides.items()},
        "times": {
            name: {
                "min_ms": float(own.min(axis=0).mean()),
                "median_ms": float(np.median(own, axis=0).mean()),
                "over_reference": float(np.median(own / ms[REFERENCE])),
                "over_forward": float(np.median(own / ms["forward"])),
            }
            for name, own in ms.items()
        },
        "largest_items": largest_items(network, pairs),
    }


def table(numbers: dict[str, Any]) -> str:
    """The numbers as Markdown."""
    points, superpoints = numbers["points"], numbers["superpoints"]
    lines = [
        f"{numbers['parameters'] / 1e6:.2f} M parameters, torch {numbers['torch']}, one thread; mean over "
        f"{numbers['pairs']} pairs, {numbers['repeats']} repetitions; source of {points['source']:.0f} points and "
        f"{superpoints['source']:.0f} superpoints, target of {points['target']:.0f} and {superpoints['target']:.0f}",
        "",
        "| CPU time | minimum, ms | median, ms | over the reference | over the forward pass |",
        "|---|---|---|---|---|",
    ]
    for name, row in numbers["times"].items():
        lines.append(
            f"| {name} | {row['min_ms']:.1f} | {row['median_ms']:.1f} | {row['over_reference']:.2f} "
            f"| {row['over_forward']:.2f} |"
        )
    return "\n".join(
        [
            *lines,
            "",
            "Largest items: " + ", ".join(f"{name} {share}" for name, share in numbers["largest_items"].items()),
        ]
    )


def main() -> int:
    """Print the numbers, and write them where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="yaml of config/model; default: the defaults")
    parser.add_argument("--superpoints", type=int, nargs=2, default=(90, 110), help="of the target, from and to")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=40)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    config = ModelConfig.from_yaml(args.model) if args.model else ModelConfig()
    numbers = measure(replace(config, superpoints=tuple(args.superpoints)), args.pairs, args.repeats)
    print(table(numbers))
    if args.json:
        args.json.write_text(json.dumps(numbers, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
