"""What it is worth to know where the camera was: given, found in the pixels of the cloud, inferred, or not known.

    python benchmarks/viewpoint.py --pairs DIR [DIR ...] [--every 3] [--ways inferred]

DIR holds scenes with a viewpoint, as `gapr make-pairs --protocol scene-C1,scene-C2,scene-C3` writes them. Their points
are put into the pixels of an image and stay what they are. Rows and columns are rounded, so that lines of sight are up
to half a pixel off, which those of a real image are not. Inferred: nothing but the points is given. Not known: neither
is the place inferred, and all of the cloud is taken for bone.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig, metrics
from gapr_core.data.pair import Pair
from gapr_core.data.pair_files import load_pair, pair_paths
from gapr_core.data.scenes.camera import FIELD_OF_VIEW_DEG, PIXELS
from gapr_core.geometry import pinhole, quadrics
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

Array = NDArray[np.float64]
WAYS = ("given", "in the pixels", "inferred", "not known")


def main() -> int:
    """Register every scene in four ways, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", required=True, type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=1, help="only every so many-th pair")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS, help="only these (all)")
    args = parser.parse_args()
    paths = [path for folder in args.pairs for path in pair_paths(folder)[:: args.every]]
    config = RegistrarConfig(num_threads=1)
    registrar = Registrar.from_pretrained(config)
    blind = Registrar.from_pretrained(replace(config, clutter=replace(config.clutter, infer_viewpoint=False)))
    answers: dict[str, list[tuple[list[str], float]]] = {}
    for path in tqdm(paths, unit="scene"):
        pair = load_pair(path)
        answers.setdefault(pair.protocol, []).append(ask(registrar, blind, pair, args.ways))
    say(markdown.table(["protocol", "scenes", *columns(args.ways)], list(rows(answers))))
    return 0


def ask(registrar: Registrar, blind: Registrar, pair: Pair, wanted: Sequence[str]) -> tuple[list[str], float]:
    """Right, wrong or refused in each of the ways, and how far the camera that was found is off, mm (NaN: none)."""
    target, found = registrar.prepare(pair.target), pinhole.camera_of(image(pair))
    outcomes = []
    ways = (registrar, pair.viewpoint), (registrar, found), (registrar, None), (blind, None)
    for method, viewpoint in (way for name, way in zip(WAYS, ways, strict=True) if name in wanted):
        result = method.register(pair.source, target, viewpoint=viewpoint)
        if result.T_target_source is None:
            outcomes.append("refused")
            continue
        outcomes.append("right" if pair.has_truth and is_right(result.T_target_source, pair) else "wrong")
    assert pair.viewpoint is not None
    return outcomes, float("nan") if found is None else float(np.linalg.norm(found - pair.viewpoint))


def is_right(T: Array, pair: Pair) -> bool:
    """Whether a pose (4, 4) is within 4 mm and 5 deg of the truth."""
    return metrics.pose_error(T, pair.T_target_source, pair.source).is_right


def image(pair: Pair) -> Array:
    """(H, W, 3) the points of a scene in the pixels of a camera that looks at their middle; the last of each stays."""
    assert pair.viewpoint is not None
    sight = pair.source - pair.viewpoint
    ahead = sight.mean(axis=0) / np.linalg.norm(sight.mean(axis=0))
    seen = sight @ np.vstack([quadrics.tangent_basis(ahead[None])[0], ahead[None]]).T
    focal = PIXELS / 2.0 / np.tan(np.radians(FIELD_OF_VIEW_DEG / 2.0))
    column, row = np.rint(focal * seen[:, :2] / seen[:, 2:]).astype(int).T
    column, row = column - column.min(), row - row.min()
    grid = np.full((row.max() + 1, column.max() + 1, 3), np.nan)
    grid[row, column] = pair.source
    return grid


def columns(wanted: Sequence[str]) -> list[str]:
    """Heads of what is counted."""
    right = [f"{way}: right, wrong" for way in WAYS if way in wanted]
    return [*right, "camera found", "off, median, largest (mm)"]


def rows(answers: dict[str, list[tuple[list[str], float]]]) -> Iterator[list[str]]:
    """One protocol after the other."""
    for protocol, given in answers.items():
        counted = [
            f"{sum(said[way] == 'right' for said, _ in given)}, {sum(said[way] == 'wrong' for said, _ in given)}"
            for way in range(len(given[0][0]))
        ]
        off = np.array([distance for _, distance in given])
        off = off[np.isfinite(off)]
        how_far = f"{np.median(off):.1f}, {off.max():.1f}" if len(off) else ""
        yield [protocol, str(len(given)), *counted, str(len(off)), how_far]


if __name__ == "__main__":
    raise SystemExit(main())
