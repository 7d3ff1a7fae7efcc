"""`gapr make-pairs`: frozen lists of pairs as .npz files with a manifest, the same from the same seed."""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from tqdm import tqdm

from gapr_core.data import anatomy, pool
from gapr_core.data.pair_files import load_pair, pair_hash, save_pair
from gapr_core.data.protocols import PROTOCOLS, make_pair
from gapr_core.data.specimen import Specimen
from gapr_core.errors import ConfigError
from gapr_core.runtime import cluster, files
from gapr_core.runtime.arguments import a_path, at_least_one, names
from gapr_core.runtime.console import say

FORMAT = 1
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Recipe:
    """Everything that a list of pairs depends on; meshes stand in it by their hash.

    Raises:
        ConfigError: an unknown protocol, nothing to make, or a number out of range.
    """

    protocols: tuple[str, ...]
    bones: tuple[str, ...]
    count: int
    seed: int = 0
    split: str = "all"
    people: int = 20
    origin: str = "parametric"  # or "anatomy", "meshes"
    units: str = "mm"  # of meshes
    meshes: str = ""  # hash of the files; empty for parametric bones

    def __post_init__(self) -> None:
        unknown = [name for name in self.protocols if name not in PROTOCOLS]
        if unknown or not self.protocols:
            raise ConfigError(
                f"protocols among {', '.join(PROTOCOLS)}", ", ".join(unknown) or "none", "choose of these"
            )
        if self.count < 1 or self.people < 1 or self.seed < 0 or not self.bones:
            raise ConfigError("count and subjects of at least 1, a seed from 0, a bone", str(self), "correct it")

    def listed(self) -> dict[str, Any]:
        """As a manifest has it, read back from its file; without the meshes where there are none."""
        values = json.loads(json.dumps(asdict(self)))
        return {key: value for key, value in values.items() if self.meshes or key not in ("units", "meshes")}


def add_arguments(parser: ArgumentParser) -> None:
    """Add the options of `gapr make-pairs`."""
    parser.add_argument("--protocol", required=True, help=f"one or more, with commas: {', '.join(PROTOCOLS)}")
    parser.add_argument("--bones", help="with commas; default: femur,tibia,pelvis,thoracic, or what --meshes holds")
    parser.add_argument("--count", type=at_least_one, default=40, help="pairs for each bone and protocol (40)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=a_path, required=True, help="folder for NAME.npz and manifest.json")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--anatomy", type=a_path, help="folder of corresponded meshes with splits.json")
    where.add_argument("--meshes", type=a_path, help="folder of your own meshes, one per subject, or a folder per bone")
    parser.add_argument("--units", default="mm", choices=("mm", "cm", "m"), help="of --meshes")
    parser.add_argument(
        "--split", required=True, choices=(*anatomy.SPLITS, "all"),
        help="whose bones: test to judge what was trained here, all where nobody has trained on these subjects",
    )  # fmt: skip
    parser.add_argument("--people", type=at_least_one, default=20, help="parametric subjects for each bone (20)")
    parser.add_argument("--dask", metavar="ADDRESS", help=cluster.ARGUMENT)


def run(args: Namespace) -> int:
    """Make the pairs that the arguments name, or continue an earlier run, and report."""
    origin = "anatomy" if args.anatomy else "meshes" if args.meshes else "parametric"
    there = pool.bones_in(args.meshes, args.units) if args.meshes and not args.bones else anatomy.BONES
    named = names(args.bones) if args.bones else there
    if args.meshes and len(named) > 1 and anatomy.is_flat(args.meshes):
        how = "put the meshes of each bone into a folder of its name"
        raise ConfigError("one bone for meshes in one folder", ", ".join(named), how)
    made_of = anatomy.meshes_hash(args.meshes, named, args.split) if args.meshes else ""
    made_of = anatomy.corresponded_hash(args.anatomy) if args.anatomy else made_of
    recipe = Recipe(
        names(args.protocol), tuple(named), args.count, args.seed, args.split, args.people, origin,
        args.units if args.meshes else "mm", made_of,
    )  # fmt: skip
    begin(recipe, args.out)
    bones = {bone: _bones(args, bone) for bone in tqdm(recipe.bones, desc="bones", disable=None)}
    manifest = write_pairs(recipe, bones, args.out, args.dask)
    for bone, found in bones.items():
        cohorts = ", ".join(sorted({s.cohort for s in found}))
        say(f"{bone}: {len(found)} subjects of split {recipe.split} ({cohorts})")
    say(f"{len(manifest['pairs'])} pairs in {args.out}, hash {manifest['hash'][:16]}")
    return 0


def write_pairs(
    recipe: Recipe, bones: dict[str, list[Specimen]], out: str | Path, dask: str | None = None
) -> dict[str, Any]:
    """Write every pair of the recipe that is not there yet, and the manifest.

    Args:
        recipe: which pairs.
        bones: specimens of each bone of the recipe.
        out: folder; made if missing.
        dask: address of a Dask cluster that draws them instead of this process.

    Returns:
        The manifest: the recipe, every pair with its sha256, and one `hash` over all.

    Raises:
        ConfigError: the folder holds pairs of another recipe, or no specimen is left for a bone.
    """
    out = Path(out)
    begin(recipe, out)
    plan = list(_plan(recipe, bones))
    shared = bones, out.resolve()  # goes to each worker once; a job names its specimen
    here = (_pair_entry(job, shared) for job in plan)
    entries = cluster.results(dask, _pair_entry, plan, shared) if dask else here
    found = {e["name"]: e for e in tqdm(entries, desc="pairs", unit="pair", total=len(plan), disable=None)}
    pairs = [found[job.name] for job in plan]
    digest = sha256("".join(f"{p['name']} {p['sha256']}\n" for p in pairs).encode()).hexdigest()
    return _write_manifest(out, recipe, pairs, digest)


def begin(recipe: Recipe, out: Path) -> None:
    """Make the folder with a manifest without pairs, or check that it was begun with this recipe.

    A manifest of another recipe that came to no pair, as after a misspelt name, gives way.

    Raises:
        ConfigError: it holds pairs of another recipe or of changed meshes, a damaged manifest, or cannot be written.
    """
    there = read_manifest(out) if (out / MANIFEST).exists() else None
    if there is None or not (there["pairs"] or any(out.glob("*.npz"))):
        _write_manifest(out, recipe, [], "")
    elif not _is_of(there["recipe"], recipe):
        wanted = "an empty folder or one with pairs of this recipe, of the same meshes and unit"
        raise ConfigError(wanted, f"other pairs in {out}", "choose another --out")


def _is_of(listed: dict[str, Any], recipe: Recipe) -> bool:
    """Check whether a manifest lists this recipe; older ones do not name their anatomy."""
    unsaid = {"meshes": recipe.meshes, "units": recipe.units} if recipe.origin == "anatomy" and recipe.meshes else {}
    return unsaid | listed == recipe.listed()


def read_manifest(folder: str | Path) -> dict[str, Any]:
    """Read the manifest of a folder of pairs.

    Raises:
        ConfigError: there is none, or it is damaged.
    """
    path, expected = Path(folder) / MANIFEST, "a manifest that gapr make-pairs has written"
    manifest = files.read_json(path, expected)
    if not isinstance(manifest, dict) or not {"recipe", "hash", "pairs"} <= manifest.keys():
        raise ConfigError(expected, f"{path} (no recipe or no pairs in it)", "make the pairs again in another folder")
    return manifest


@dataclass(frozen=True)
class _Job:
    """One pair to draw: of specimen `number` of the bone's; `turn` counts the pairs of a bone and protocol."""

    name: str
    protocol: str
    bone: str
    number: int
    seed: int
    turn: int


def _bones(args: Namespace, bone: str) -> list[Specimen]:
    return pool.specimens(bone, args.split, args.people, args.anatomy, args.meshes, args.units)


def _plan(recipe: Recipe, bones: dict[str, list[Specimen]]) -> Iterator[_Job]:
    """Everybody in turn; subjects of several cohorts stand in the list one after the other, so that all come."""
    for protocol in recipe.protocols:
        for bone in recipe.bones:
            if not bones[bone]:
                raise ConfigError(f"somebody's {bone} in split {recipe.split}", "nobody's", "choose another split")
            for index in range(recipe.count):
                name, number = f"{protocol}_{bone}_{index:04d}", index % len(bones[bone])
                yield _Job(name, protocol, bone, number, 1_000_000 * recipe.seed + index, index)


def _pair_entry(job: _Job, shared: tuple[dict[str, list[Specimen]], Path]) -> dict[str, Any]:
    bones, out = shared
    path = out / f"{job.name}.npz"
    if not path.is_file():
        others = [specimen for found in bones.values() for specimen in found]
        save_pair(path, make_pair(job.protocol, bones[job.bone][job.number], job.seed, others, job.turn))
    pair = load_pair(path)
    entry = {"name": job.name, "bone": pair.bone, "person": pair.person, "protocol": pair.protocol}
    return {**entry, "cohort": pair.metadata.get("cohort", ""), "sha256": pair_hash(pair)}


def _write_manifest(out: Path, recipe: Recipe, pairs: list[dict[str, Any]], digest: str) -> dict[str, Any]:
    manifest = {"format": FORMAT, "recipe": recipe.listed(), "hash": digest, "pairs": pairs}
    files.write_json(out / MANIFEST, manifest)
    return manifest
