"""`gapr demo`: a bone, a simulated probe sweep in a bag, the node as its own process, poses, a table and a report."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

from gapr_core.errors import GaprError

if TYPE_CHECKING:
    from gapr_core.clouds import Surface
    from gapr_core.data.sweep import Sweep
    from gapr_ros.observer import Observer

FIRST_STAMP_S = 1_700_000_000.0
START_LIMIT_S, SILENCE_LIMIT_S = 180.0, 60.0  # the first start on a machine compiles


class DemoError(RuntimeError):
    """The demo could not be run to its end; the text says why."""


@dataclass(frozen=True)
class Scene:
    """What is registered: the bone, where its file is, and what the probe collects."""

    name: str
    bone: Surface
    path: Path
    sweep: Sweep
    period_s: float

    def stamp_ms(self, frame: int) -> int:
        """Time stamp of a frame's cloud, ms."""
        return round(1e3 * (FIRST_STAMP_S + frame * self.period_s))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `gapr demo`."""
    parser.description = __doc__
    parser.add_argument("--bone", default="femur", help="femur, pelvis, ...: a parametric bone (default: femur)")
    parser.add_argument("--seed", type=int, default=1, help="which person, which sweep, where the patient lies")
    parser.add_argument("--frames", type=int, default=24, help="clouds in the bag (default: 24)")
    parser.add_argument("--period", type=float, default=1.0, metavar="S", help="time between two clouds (default: 1 s)")
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap", help="of the bag")
    parser.add_argument("--out", type=Path, default=Path("demo_output"), help="folder (default: demo_output)")


def run(args: argparse.Namespace) -> int:
    """0 when poses came and all were right; 1 when one was wrong, none came, or something did not run."""
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else 110)
    try:
        return _run(args, console)
    except (DemoError, GaprError, OSError) as error:
        console.print(f"[red]error:[/red] {error}", highlight=False)
        return 1
    except KeyboardInterrupt:
        console.print("stopped")
        return 130


def _run(args: argparse.Namespace, console: Any) -> int:
    from gapr_ros import demo_report

    args.out.mkdir(parents=True, exist_ok=True)
    say = _numbered(console)
    say(f"Making a {args.bone} (person {args.seed}) and sweeping a probe along it")
    scene = make_scene(args.bone, args.seed, args.frames, args.period, args.out)
    say(f"Writing {args.frames} clouds to the bag {args.out / 'bag'}")
    write_bag(scene, args.out / "bag", args.storage)
    with observing(args.out / "log") as observer:
        say(f"Starting register_node (ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']}) and playing the bag over DDS")
        replay(scene, observer, args.out, console)
        rows = demo_report.judge(scene, observer.answers)
    console.print(demo_report.rich_table(rows))
    lost = sum(row.answer is None for row in rows) - observer.dropped
    if lost > 0:
        console.print(f"[yellow]{lost} clouds did not reach the node: is this machine very busy?[/yellow]")
    say("Writing the report")
    demo_report.write(scene, rows, args.out)
    console.print(demo_report.verdict(rows), f"Report: {args.out / 'report.html'}   Picture: {args.out / 'report.png'}")
    return 0 if demo_report.passed(rows) else 1


def _numbered(console: Any) -> Callable[[str], None]:
    numbers = iter(range(1, 100))
    return lambda text: console.print(f"[bold]{next(numbers)}. {text}[/bold]", highlight=False)


def make_scene(bone: str, seed: int, frames: int, period_s: float, folder: Path) -> Scene:
    """A parametric bone, written as STL (mm) as a segmented CT would be, and a sweep along it."""
    from gapr_core.data import parametric, sweep
    from gapr_core.data.specimen import Specimen

    surface = parametric.make_bone(bone, seed)
    path = folder / f"{bone}.stl"
    write_stl(surface, path)
    specimen = Specimen(surface, bone, str(seed), "parametric")
    return Scene(bone, surface, path, sweep.simulate(specimen, seed, sweep.Acquisition(frames=frames)), period_s)


def write_stl(surface: Surface, path: Path) -> None:
    """A mesh as binary STL."""
    import open3d as o3d

    mesh = surface.to_open3d()
    mesh.compute_triangle_normals()
    if not o3d.io.write_triangle_mesh(str(path), mesh):
        raise DemoError(f"{path} could not be written")


def write_bag(scene: Scene, path: Path, storage: str) -> None:
    """The sweep as a rosbag2 bag: one PointCloud2 a frame, metres, in the frame of the tracker."""
    from gapr_ros import wire
    from gapr_ros.bag_writing import BagWriter

    shutil.rmtree(path, ignore_errors=True)
    with BagWriter(path, storage) as bag:
        for frame, cloud in enumerate(scene.sweep.clouds):
            bag.write_cloud("/points", wire.to_metres(cloud), "tracker", scene.stamp_ms(frame) * 1_000_000)


@contextmanager
def observing(log_folder: Path) -> Iterator[Observer]:
    """An observer in a ROS graph of its own on this machine, which the children of this process share.

    ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE are respected where they are set.
    """
    import rclpy

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
    os.environ["ROS_LOG_DIR"] = str(log_folder.resolve())
    from gapr_ros.observer import Observer

    context = rclpy.Context()  # without handlers of its own: Ctrl-C stays a KeyboardInterrupt
    context.init(args=[])
    observer = Observer(context=context)
    try:
        yield observer
    finally:
        observer.destroy_node()
        context.try_shutdown()


def replay(scene: Scene, observer: Observer, folder: Path, console: Any) -> None:
    """Plays the bag to a node in a process of its own; returns when every cloud is answered or nothing more comes.

    Raises:
        DemoError: the node did not start, or ended too early.
    """
    from gapr_ros.children import child

    log = folder / "register_node.log"
    parameters = {"model_path": scene.path.resolve(), "model_unit": "mm", "timeout": 30.0, "diagnostics_period": 0.2}
    settings = [text for name, value in parameters.items() for text in ("-p", f"{name}:={value}")]
    with child("gapr_ros.register_node", ["--ros-args", *settings], log) as node:
        with _player(observer, folder / "bag") as play:
            with console.status("waiting for the node to read the bone (the first time it compiles, up to a minute)"):
                _wait_until_ready(observer, node, log)
            play()
            _collect(len(scene.sweep.clouds), observer, node, log, console)


@contextmanager
def _player(observer: Observer, bag_path: Path) -> Iterator[Callable[[], None]]:
    """Advertises the topics of the bag at once; call what it yields to play, in a thread of its own."""
    from gapr_ros.bag_replay import Replay, ReplayOptions, open_bag

    bag = open_bag(bag_path)
    player = Replay(observer, bag, ReplayOptions(progress=False), observer.note_sent)
    thread = Thread(target=player.run, daemon=True)
    try:
        yield thread.start
    finally:
        observer.context.try_shutdown()  # ends the player wherever it is
        if thread.ident is not None:
            thread.join()
        bag.reader.close()


def _wait_until_ready(observer: Observer, node: Any, log: Path) -> None:
    """Until the node is active and has found the player: what is sent earlier would be lost."""
    deadline = time.monotonic() + START_LIMIT_S
    while observer.node_state != "active" or not observer.player_found:
        _check_running(node, log)
        if observer.node_failure or time.monotonic() > deadline:
            why = observer.node_failure or f"{observer.node_state or 'silent'} after {START_LIMIT_S:.0f} s; see {log}"
            raise DemoError(f"register_node did not start: {why}")
        observer.listen(0.1)


def _collect(count: int, observer: Observer, node: Any, log: Path, console: Any) -> None:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("answers"),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=console) as progress:
        task, before, heard = progress.add_task("", total=count), -1, time.monotonic()
        while len(observer.answers) + observer.dropped < count and time.monotonic() < heard + SILENCE_LIMIT_S:
            _check_running(node, log)
            observer.listen(0.1)
            if len(observer.answers) + observer.sent != before:
                before, heard = len(observer.answers) + observer.sent, time.monotonic()
                progress.update(task, completed=len(observer.answers), description=_last_answer(observer))
    for _ in range(10):  # a pose may be a moment behind its diagnostics
        observer.listen(0.05)


def _last_answer(observer: Observer) -> str:
    if not observer.answers:
        return ""
    answer = observer.answers[max(observer.answers)]
    return f"refused: {answer.refusal}"[:60] if answer.refusal else f"pose, confidence {answer.confidence:.2f}"


def _check_running(process: Any, log: Path) -> None:
    from gapr_ros.children import last_lines

    if process.poll() not in (None, 0):
        raise DemoError(f"{log.stem} ended with {process.returncode}:\n{last_lines(log)}")
