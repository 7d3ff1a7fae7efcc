"""Where the time goes: the steps of a registration, and how others do on the same clouds.

    python benchmarks/time_profile.py [--anatomy DIR] [--split val] [--repeats 20] [--threads 2]

All cases take turns within every repetition, so that a machine's moods hit them alike; read the ratios. Wall and CPU
time are medians; memory is the largest that Python and NumPy allocated above what was there before (`tracemalloc`, in a
repetition of its own, which is not timed); threads are the most that the process had.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import open3d as o3d
import psutil
import small_gicp
from tqdm import tqdm

from gapr_core import Registrar, RegistrarConfig, Tracker
from gapr_core.baselines import make
from gapr_core.config import SourceConfig
from gapr_core.data.pair import Pair
from gapr_core.data.pool import specimens
from gapr_core.data.protocols import make_pair
from gapr_core.data.scenes import stream as scenes
from gapr_core.data.specimen import Specimen
from gapr_core.data.stream import Motion, simulate
from gapr_core.pages import markdown
from gapr_core.registration.problem import source as sources
from gapr_core.results import RegistrationResult
from gapr_core.runtime.console import say
from gapr_core.runtime.memory import allocated_mb

Case = Callable[[], object]
TRIANGLES = 200_000
STREAM = Motion(frames=8, points=4000, step_mm=2.0, step_deg=1.0)
SCENES = scenes.SceneMotion(frames=8, level="scene-C2")
GICP_VOXEL_MM = 2.0
TARGET, OPEN3D = "prepare a target of 200 000 triangles", "Open3D: read it, and its normals"
FULL = {protocol: f"register ({protocol})" for protocol in ("paper", "L1", "L2")}
KISS = {protocol: f"KISS-Matcher and refinement, of that pair ({protocol})" for protocol in FULL}
TRACK, GICP = "track a frame of 4000 points", "small_gicp: thin and align that frame"
DENSE = "track a frame of 300 000 points", "small_gicp: thin and align that dense frame"
TRACK_SCENE = "track a scene (C2)"
STAGED = FULL["paper"], TRACK  # whose stages are printed too


def main() -> int:
    """Time all cases in turn, print three tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anatomy", type=Path, help="folder with the bones; else a parametric one")
    parser.add_argument("--split", default="val")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    registrar = Registrar.from_pretrained(RegistrarConfig(num_threads=args.threads))
    bone = specimens("femur", args.split, 1, args.anatomy)[0]
    with TemporaryDirectory() as folder:
        report(cases_of(bone, registrar, args.threads, Path(folder)), args.repeats)
    return 0


def report(cases: dict[str, Case], repeats: int) -> None:
    """Let the cases take turns, print what each took, the ratios and the stages."""
    for case in cases.values():
        case()  # compile, and fill what is kept
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in cases}
    stages: dict[str, list[dict[str, float]]] = {}
    most_threads = dict.fromkeys(cases, 0)
    for _ in tqdm(range(repeats), unit="repetition"):
        for name, case in cases.items():
            start = time.perf_counter(), time.process_time()
            result = case()
            times[name].append((time.perf_counter() - start[0], time.process_time() - start[1]))
            if name in STAGED and isinstance(result, RegistrationResult):
                stages.setdefault(name, []).append(dict(result.stage_ms))
            most_threads[name] = max(most_threads[name], psutil.Process().num_threads())
    say(markdown.head(("case", "wall ms", "CPU ms", "allocated MB", "threads")))
    for name, case in cases.items():
        wall, cpu = 1e3 * np.median(times[name], axis=0)
        say(markdown.row((name, f"{wall:.1f}", f"{cpu:.1f}", f"{allocated_mb(case):.1f}", most_threads[name])))
    say("")
    say(ratios({name: np.array(taken)[:, 0] for name, taken in times.items()}))
    say("")
    say(parts(stages))


def cases_of(bone: Specimen, registrar: Registrar, threads: int, folder: Path) -> dict[str, Case]:
    """What is timed, by name; `folder` is for a mesh."""
    pairs, scene = {protocol: make_pair(protocol, bone, 5) for protocol in FULL}, make_pair("scene-C2", bone, 5)
    clean, target, of_scene = pairs["paper"], registrar.prepare(pairs["paper"].target), registrar.prepare(scene.target)
    twice = Registrar.from_pretrained(RegistrarConfig(num_threads=threads, sure=2.0))
    kiss = make("kiss_matcher+point_to_plane")
    targets = {protocol: (registrar.prepare(pair.target), kiss.prepare(pair.target, "mm"))
               for protocol, pair in pairs.items()}  # fmt: skip
    file, frames = fine_mesh(bone, folder), simulate(bone, 3, STREAM)
    full = {FULL[name]: partial(registrar.register, pair.source, targets[name][0]) for name, pair in pairs.items()}
    of_kiss = {KISS[name]: partial(kiss.register, pair.source, targets[name][1]) for name, pair in pairs.items()}
    return {
        TARGET: lambda: registrar.prepare(file),
        OPEN3D: lambda: o3d.io.read_triangle_mesh(str(file)).compute_vertex_normals(),
        "prepare a source (5000 points)": lambda: sources.prepare(clean.source, SourceConfig()),
        **{name: case for both in zip(full.items(), of_kiss.items(), strict=True) for name, case in both},
        "register, both rounds (paper)": lambda: twice.register(clean.source, target),
        "register a scene (C2)": lambda: registrar.register(scene.source, of_scene, viewpoint=scene.viewpoint),
        TRACK_SCENE: tracked(list(scenes.simulate(bone, 3, SCENES)), registrar),
        TRACK: tracked(frames, registrar),
        GICP: aligned(frames, threads),
        DENSE[0]: tracked(dense(frames), registrar),
        DENSE[1]: aligned(dense(frames), threads),
    }


def tracked(frames: Sequence[Pair], registrar: Registrar) -> Case:
    """Each call registers the next frame of a stream, to and fro, from the track."""
    tracker, target, turn = Tracker(registrar, recheck=10**9), registrar.prepare(frames[0].target), to_and_fro(frames)

    def call() -> object:
        frame = next(turn)[1]
        return tracker.register(frame.source, target, viewpoint=frame.viewpoint)

    return call


def aligned(frames: Sequence[Pair], threads: int) -> Case:
    """The same with small_gicp: thin, then align from the true pose of the frame before."""
    target, tree = small_gicp.preprocess_points(frames[0].target, GICP_VOXEL_MM, num_threads=threads)
    turn = to_and_fro(frames)

    def call() -> object:
        before, frame = next(turn)
        source, _ = small_gicp.preprocess_points(frame.source, GICP_VOXEL_MM, num_threads=threads)
        return small_gicp.align(target, source, tree, before.T_target_source, max_correspondence_distance=10.0,
                                num_threads=threads)  # fmt: skip

    return call


def dense(frames: Sequence[Pair]) -> list[Pair]:
    """The frames as a depth camera of 640 x 480 pixels gives them: each point 75 times, with 0.5 mm of noise."""
    rng = np.random.default_rng(0)
    sources = [frame.source.repeat(75, axis=0) for frame in frames]
    return [replace(frame, source=source + rng.normal(scale=0.5, size=source.shape))
            for frame, source in zip(frames, sources, strict=True)]  # fmt: skip


def to_and_fro(frames: Sequence[Pair]) -> Iterator[tuple[Pair, Pair]]:
    """(frame before, frame) without end; the bone never jumps."""
    return pairwise(cycle([*frames, *frames[-2:0:-1]]))


def fine_mesh(bone: Specimen, folder: Path) -> Path:
    """The bone as a PLY file of 200 000 triangles."""
    points, faces = o3d.utility.Vector3dVector(bone.surface.points), o3d.utility.Vector3iVector(bone.surface.faces)
    mesh = o3d.geometry.TriangleMesh(points, faces)
    while len(mesh.triangles) < TRIANGLES:
        mesh = mesh.subdivide_midpoint()
    path = folder / "bone.ply"
    o3d.io.write_triangle_mesh(str(path), mesh.simplify_quadric_decimation(TRIANGLES))
    return path


def parts(stages: dict[str, list[dict[str, float]]]) -> str:
    """Median wall time of each stage; a smooth bias is corrected in `refine`."""
    names = list(dict.fromkeys(stage for taken in stages.values() for each in taken for stage in each))
    rows = [markdown.row((case, *(f"{np.median([each.get(stage, 0.0) for each in taken]):.1f}" for stage in names)))
            for case, taken in stages.items()]  # fmt: skip
    return "\n".join([markdown.head(("stages, wall ms", *names)), *rows])


def ratios(wall: dict[str, np.ndarray]) -> str:
    """Our times over those of others, repetition by repetition."""
    pairs = ((TRACK, GICP), DENSE, *((FULL[name], KISS[name]) for name in FULL), (TARGET, OPEN3D))
    rows = [markdown.row((ours, other, f"{np.median(wall[ours] / wall[other]):.2f}")) for ours, other in pairs]
    return "\n".join([markdown.head(("ours", "over", "median ratio of wall times")), *rows])


if __name__ == "__main__":
    raise SystemExit(main())
