"""What `torch.export`, ONNX and `torch.compile` make of the backbone and of the aggregation, for clouds of fixed sizes.

nice python benchmarks/model_export.py [--out DIR] [--compile]

Writes DIR/backbone.pt2 and DIR/aggregation.pt2, and what ONNX can hold as .onnx, where the packages onnx and onnxscript
are installed; with onnxruntime, that is run, too. `--compile` compiles the exported programs, which takes minutes. A
line for each attempt: seconds, largest difference from the network, CPU time of a call and the network's, or the
error.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gapr_core.data.pool import parametric_specimen
from gapr_core.data.protocols import make_pair
from gapr_core.model import weights
from gapr_core.model.export import Flat
from gapr_core.model.network import GAPRNet
from gapr_core.model.pyramid import build_cloud, target_frame


def parts(network: GAPRNet) -> dict[str, Flat]:
    """The parts with their arguments: a femur, and a partial view of it."""
    pair = make_pair("paper", parametric_specimen("femur", 0), 0)
    frame = target_frame(pair.target, network.config)
    source, target = (build_cloud(points, frame, network.config) for points in (pair.source, pair.target))
    features = [network.backbone(cloud).coarse for cloud in (source, target)]
    return {
        "backbone": Flat(network.backbone, target),
        "aggregation": Flat(network.aggregation, source, target, *features),
    }


@contextmanager
def attempt(name: str) -> Iterator[None]:
    """Reports an error in one line, and goes on."""
    try:
        yield
    except Exception as error:  # whatever the compilers raise is what we are after
        text = str(error)
        start = max(text.find("No ONNX function"), 0)  # what it is about stands in the midst of some advice
        print(f"{name}: {type(error).__name__}: {text[start:].partition(chr(10))[0][:120]}")


def report(name: str, seconds: float, part: Flat, call: Callable[..., Sequence[Any]], repeats: int = 20) -> None:
    """Compares a form of a part with the part itself."""
    expected, found = part(*part.example), [torch.as_tensor(x) for x in call(*part.example)]
    apart = max(float((a.float() - b.float()).abs().max()) for a, b in zip(found, expected, strict=True))
    times = [(cpu_ms(part, part.example), cpu_ms(call, part.example)) for _ in range(repeats)]
    ours, theirs = (min(column) for column in zip(*times, strict=True))
    print(f"{name}: made in {seconds:.0f} s, differs by {apart:.1e} at most, {theirs:.1f} ms, network {ours:.1f} ms")


def cpu_ms(call: Callable[..., Any], arguments: Sequence[Tensor]) -> float:
    """CPU time of one call, ms."""
    begun = time.process_time()
    call(*arguments)
    return 1e3 * (time.process_time() - begun)


def onnx_form(program: torch.export.ExportedProgram, path: Path) -> Callable[..., Sequence[Any]]:
    """Writes a program as ONNX; a function that runs it.

    Unoptimised: onnxscript's optimiser takes additions of less than 1e-8 for additions of nothing, and without those
    the PGF of a point with itself is not a number.
    """
    import onnxruntime

    found = torch.onnx.export(program, dynamo=True, optimize=False, verbose=False)
    assert found is not None
    found.save(path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 3
    session = onnxruntime.InferenceSession(path, options)
    names = [entry.name for entry in session.get_inputs()]
    return lambda *tensors: session.run(None, dict(zip(names, (t.numpy() for t in tensors), strict=True)))


@torch.no_grad()
def run(network: GAPRNet, out: Path, compiled: bool) -> None:
    """All attempts on all parts."""
    for name, part in parts(network).items():
        with attempt(f"torch.export, {name}"):
            begun = time.monotonic()
            program = torch.export.export(part, tuple(part.example), strict=False)
            seconds = time.monotonic() - begun
            torch.export.save(program, out / f"{name}.pt2")
            program = torch.export.load(out / f"{name}.pt2")
            report(f"torch.export, {name}", seconds, part, program.module())
        with attempt(f"ONNX, {name}"):
            begun = time.monotonic()
            call = onnx_form(program, out / f"{name}.onnx")
            report(f"ONNX, {name}", time.monotonic() - begun, part, call)
        if compiled:
            with attempt(f"torch.compile, {name}"):
                call, begun = torch.compile(program.module(), dynamic=False), time.monotonic()
                call(*part.example)
                report(f"torch.compile, {name}", time.monotonic() - begun, part, call)


def main() -> int:
    """Print a line for each attempt."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", type=Path, help="a trained network; default: an untrained one")
    parser.add_argument("--out", type=Path, default=Path("runs/exported"))
    parser.add_argument("--compile", action="store_true")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network = weights.load(args.weights)[0] if args.weights else GAPRNet().eval()
    print(f"torch {torch.__version__}, one thread")
    run(network, args.out, args.compile)
    return 0


if __name__ == "__main__":
    sys.exit(main())
