"""What the network's hypotheses are worth against those of the search, on the same pairs in one run.

    python benchmarks/proposals.py --pairs DIR [--limit N] [--out proposals.json]

DIR is what `gapr make-pairs` writes. For each protocol: recall of the network's first pose as it is and refined, how
far down the list the first hypothesis near the truth stands, the time until it is there and until it is refined, and
the share of whole registrations that ask for the search.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig, metrics
from gapr_core.data.pair import Pair
from gapr_core.data.pair_files import load_pair, pair_paths
from gapr_core.geometry import se3
from gapr_core.pages import markdown
from gapr_core.registration.fit.refinement import refine_fully
from gapr_core.registration.fit.verification import verify
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem.source import PreparedSource
from gapr_core.registration.problem.target import PreparedTarget
from gapr_core.registration.proposals.search import Proposer
from gapr_core.runtime.console import say

CONFIG = RegistrarConfig(num_threads=1)
NEAR_MM, NEAR_DEG = 20.0, 15.0  # from here refinement finds the truth
Row = dict[str, Any]


def main() -> int:
    """Measure all pairs with a truth, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", required=True, type=Path)
    parser.add_argument("--limit", type=int, help="pairs per protocol, spread over the bones")
    parser.add_argument("--out", type=Path, help="JSON with one record per pair")
    args = parser.parse_args()
    import torch

    torch.set_num_threads(1)
    registrar = Registrar.from_pretrained(CONFIG)
    methods = {
        "network": registrar.proposers[0],
        "search": registrar.proposers[1],
    }
    rows = [measure(pair, registrar, methods) for pair in tqdm(chosen(args.pairs, args.limit), unit="pair")]
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1) + "\n")
    say(table(rows))
    return 0


def chosen(folder: Path, limit: int | None) -> list[Pair]:
    """Pairs with a truth; with a limit every n-th of each protocol."""
    pairs = [pair for pair in map(load_pair, pair_paths(folder)) if pair.has_truth]
    groups: dict[str, list[Pair]] = {}
    for pair in pairs:
        groups.setdefault(pair.protocol, []).append(pair)
    return [p for group in groups.values() for p in group[:: max(1, len(group) // (limit or len(group)))]]


def measure(pair: Pair, registrar: Registrar, methods: dict[str, Proposer]) -> Row:
    """One pair: every proposer's list judged."""
    target = registrar.prepare(pair.target)
    source = sources.prepare(pair.source)
    assert isinstance(source, PreparedSource)
    row: Row = {"pair": pair.name, "protocol": pair.protocol, "bone": pair.bone}
    row["searched"] = int(getattr(registrar.assess(pair.source, target), "rounds", 0) > 1)
    for name, proposer in methods.items():
        row |= {f"{name}_{key}": value for key, value in one_list(proposer, source, target, pair).items()}
    return row


def one_list(proposer: Proposer, source: PreparedSource, target: PreparedTarget, pair: Pair) -> Row:
    """Rank of the first near pose, recall of the first pose raw and refined, of the whole list, and the times."""
    start = time.perf_counter()
    poses = proposer.propose(source, target, np.random.default_rng(0))
    proposed = time.perf_counter()
    if not len(poses):
        return {
            "near": None,
            "raw_paper": 0,
            "raw": 0,
            "refined_paper": 0,
            "right": 0,
            "propose_s": proposed - start,
            "total_s": proposed - start,
        }
    best = verify(poses, source, target, CONFIG.verification, 1).poses[0]
    best = refine_fully(best, source.points, target, CONFIG.refinement, source.neighbours).T
    done = time.perf_counter()
    first = refine_fully(
        verify(poses[:1], source, target, CONFIG.verification, 1).poses[0],
        source.points,
        target,
        CONFIG.refinement,
        source.neighbours,
    ).T
    near = next((i + 1 for i, T in enumerate(poses) if error(T, pair).within(NEAR_MM, NEAR_DEG)), None)
    return {
        "near": near,
        "raw_paper": int(paper(poses[0], pair)),
        "raw": int(error(poses[0], pair).is_right),
        "refined_paper": int(paper(first, pair)),
        "right": int(error(best, pair).is_right),
        "propose_s": proposed - start,
        "total_s": done - start,
    }


def error(T: Any, pair: Pair) -> se3.PoseError:
    """Error of a pose against the truth."""
    return se3.pose_error(T, pair.T_target_source, pair.source)


def paper(T: Any, pair: Pair) -> bool:
    """The paper's limit: RMSE below 0.02 half extents of the target."""
    return metrics.within_paper_limit(metrics.rmse_mm(T, pair.T_target_source, pair.source), pair.target)


def table(rows: list[Row]) -> str:
    """Markdown, one line per protocol."""
    head = (
        "protocol",
        "pairs",
        "network's first pose: RR paper raw %",
        "refined %",
        "4 mm/5 deg",
        "near pose among its 32 %",
        "network alone 4 mm/5 deg %",
        "search alone %",
        "ask for the search %",
        "rank of the first near pose",
        "network s to propose (to a refined pose)",
        "search s",
        "median of ratios",
    )
    lines = [markdown.head(head)]
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    for protocol in protocols:
        lines.append(line(protocol, [row for row in rows if row["protocol"] == protocol]))
    return "\n".join(lines)


def line(protocol: str, rows: list[Row]) -> str:
    """One protocol: shares in per cent, medians of ranks and times."""
    shown = ("network_raw_paper", "network_refined_paper", "network_raw")
    shares = (*shown, "network_right", "search_right", "searched")
    share = {key: 100.0 * float(np.mean([r[key] for r in rows])) for key in shares}
    among = 100.0 * float(np.mean([r["network_near"] is not None for r in rows]))
    ranks = [float(np.median([r[f"{m}_near"] or np.inf for r in rows])) for m in ("network", "search")]
    t = {
        key: float(np.median([r[key] for r in rows]))
        for key in ("network_propose_s", "network_total_s", "search_propose_s", "search_total_s")
    }
    ratios = [float(np.median([r[f"search_{k}"] / r[f"network_{k}"] for r in rows])) for k in ("propose_s", "total_s")]
    cells = [
        protocol,
        str(len(rows)),
        *(f"{share[k]:.1f}" for k in shown),
        f"{among:.1f}",
        f"{share['network_right']:.1f}",
        f"{share['search_right']:.1f}",
        f"{share['searched']:.0f}",
        f"{ranks[0]:.0f}; search {ranks[1]:.0f}",
        f"{t['network_propose_s']:.3f} ({t['network_total_s']:.3f})",
        f"{t['search_propose_s']:.3f} ({t['search_total_s']:.3f})",
        f"{ratios[0]:.1f} ({ratios[1]:.1f})",
    ]
    return markdown.row(cells)


if __name__ == "__main__":
    raise SystemExit(main())
