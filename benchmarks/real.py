"""Real clouds, whole and cut: the answer, its errors against the pose that the data set states, and its own bound.

    python benchmarks/real.py [--real DIR] [--sensor depth_camera] [--model-mm 0.3]

DIR is as for `gapr demo --real` (docs/results/real.md). Of every cloud with a stated pose: all of it, windows of 40, 75
and 120 mm along it where it is longer, and 12 to 200 points drawn from all of it, as a digitiser would take them.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig, RegistrationResult, metrics
from gapr_core.config import SENSOR_KINDS, CovarianceConfig, SensorConfig
from gapr_core.data import real
from gapr_core.geometry import extent
from gapr_core.pages import markdown
from gapr_core.runtime.console import say

Array = NDArray[np.float64]
WINDOWS_MM, PLACES = (120.0, 75.0, 40.0), 5
FEW = (200, 100, 50, 30, 20, 12)
HEAD = ("cloud", "piece", "points", "status", "confidence", "shift off (mm)", "turn off (deg)",
        "error over the bone (mm)", "tre95_mm")  # fmt: skip


def main() -> int:
    """Register every piece, print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, default=real.default_folder(), help="folder with the data")
    parser.add_argument("--sensor", choices=SENSOR_KINDS, default="unknown", help="what is said of the sensor")
    parser.add_argument("--model-mm", type=float, default=CovarianceConfig.model_mm,
                        help="what is said of the models: `covariance.model_mm` (default: %(default)s)")  # fmt: skip
    args = parser.parse_args()
    config = RegistrarConfig(sensor=SensorConfig(kind=args.sensor), covariance=CovarianceConfig(model_mm=args.model_mm))
    registrar = Registrar.from_pretrained(config)
    lines = [markdown.head(HEAD)]
    for pair in real.pairs(args.real):
        truth = pair.T_target_source
        if truth is None:
            continue
        target = registrar.prepare(pair.target)
        for name, piece in tqdm(list(pieces(pair.source)), pair.name):
            result = registrar.register(piece, target)
            errors = errors_of(result, truth, piece, pair.target.points)
            bound = "-" if result.tre95_mm is None else f"{result.tre95_mm:.2f}"
            answer = (result.status.value, f"{result.confidence:.2f}")
            lines.append(markdown.row((pair.name, name, len(piece), *answer, *errors, bound)))
    for line in lines:
        say(line)
    return 0


def pieces(cloud: Array) -> Iterator[tuple[str, Array]]:
    """(what it is, its points) of every piece of a cloud (N, 3), mm."""
    yield "all", cloud
    along = cloud @ extent.principal(cloud).axes[0]
    for width_mm in (width_mm for width_mm in WINDOWS_MM if width_mm < np.ptp(along)):
        for place in np.linspace(along.min(), along.max() - width_mm, PLACES):
            inside = (along >= place) & (along <= place + width_mm)
            yield f"{width_mm:.0f} mm from {place - along.min():.0f} mm", cloud[inside]
    rng = np.random.default_rng(0)
    for count in (count for count in FEW if count < len(cloud)):
        yield f"{count} points", cloud[rng.choice(len(cloud), count, replace=False)]


def errors_of(result: RegistrationResult, truth: Array, piece: Array, bone: Array) -> list[str]:
    """Shift, turn and error over the bone of the best pose, accepted or not."""
    if not result.hypotheses:
        return ["-"] * 3
    best = result.hypotheses[0].T_target_source
    error = metrics.pose_error(best, truth, piece)
    return [f"{x:.2f}" for x in (error.rte_mm, error.rre_deg, metrics.whole_bone_rmse_mm(best, truth, bone))]


if __name__ == "__main__":
    raise SystemExit(main())
