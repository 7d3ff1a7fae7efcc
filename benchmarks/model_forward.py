"""Time of one forward pass on one CPU thread, against the same network with naive hot operators.

python benchmarks/model_forward.py [--pairs 5] [--json out.json]

Sizes are those of the default configuration: about 1700 points and 90 superpoints on the target. The times are the
least of several repetitions (CPU time of the process, so that other work on the machine counts less).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

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
        patch.object(RelativeEncoder, "forward", naive_relative), patch.object(KPConv, "forward", naive_kpconv),
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


def least_ms(call: Callable[[], Any], repeats: int = 10) -> float:
    """CPU time of the fastest of some calls, ms."""
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        call()
        times.append(time.process_time() - begun)
    return 1e3 * min(times)


def measure(config: ModelConfig, count: int) -> dict[str, Any]:
    """Mean times over the pairs, and the largest items of the profile."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network, pairs = GAPRNet(config).eval(), clouds(config, count)
    rows = []
    with torch.inference_mode():
        for source, target in pairs:
            kept = network.backbone(target)
            row = {"both_ms": least_ms(lambda s=source, t=target: network(s, t)),
                   "target_kept_ms": least_ms(lambda s=source, t=target, k=kept: network(s, t, k))}
            answer = network(source, target).coarse
            with naive_operators():
                row["naive_ms"] = least_ms(lambda s=source, t=target: network(s, t), 3)
                torch.testing.assert_close(network(source, target).coarse, answer, atol=1e-2, rtol=1e-2)
            rows.append(row)
        with torch.profiler.profile() as profile:
            network(*pairs[0])
    items = sorted(profile.key_averages(), key=lambda e: -e.self_cpu_time_total)[:5]
    total = sum(e.self_cpu_time_total for e in profile.key_averages())
    means = {name: round(sum(r[name] for r in rows) / len(rows), 1) for name in rows[0]}
    source, target = pairs[0]
    return {
        "points": [source.fine.lengths[0], target.fine.lengths[0]],
        "superpoints": [source.coarse.lengths[0], target.coarse.lengths[0]],
        "parameters": sum(p.numel() for p in network.parameters()), **means,
        "naive_over_ours": round(means["naive_ms"] / means["both_ms"], 2),
        "largest_items": {e.key: f"{100 * e.self_cpu_time_total / total:.0f} %" for e in items},
    }


def main() -> int:
    """Print the figures, and write them where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="yaml of config/model; default: the defaults")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    figures = measure(ModelConfig.from_yaml(args.model) if args.model else ModelConfig(), args.pairs)
    text = json.dumps(figures, indent=1)
    print(text)
    if args.json:
        args.json.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
