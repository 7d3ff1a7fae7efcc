"""A surface from a file: one reader for each format, and one sentence for an unreadable file."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

from gapr_core.errors import ConfigError, GaprError, InvalidPointCloudError
from gapr_core.formats import axes, plugins, signatures
from gapr_core.formats.meshes import damage
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface, check_faces

log = logging.getLogger(__name__)
Reader = Callable[[Path, ReadOptions], Surface]


@dataclass(frozen=True)
class Format:
    """A kind of file.

    Attributes:
        reader: `module:function` under `gapr_core.formats`; takes (path, options) and gives a `Surface`.
        in_mm: its numbers are mm, whatever unit is named; its axes are its own; only a tracker's may be named.
        in_lps: it says its axes by its kind, and comes out in LPS.
        uses: the choices (`CHOICES`) that its reader takes; another one is an error and not ignored.
        unit: of its numbers, where the user names none.
    """

    reader: str
    in_mm: bool = False
    in_lps: bool = False
    uses: tuple[str, ...] = ()
    unit = "mm"

    @property
    def is_tracked(self) -> bool:
        """Whether it may be a recording in the frame of a tracker, whose axes are those of no patient."""
        return "tip_mm" in self.uses

    def is_in_mm(self, options: ReadOptions) -> bool:
        """Tell whether the file is in mm under these options; a tracked tip always is."""
        return self.in_mm or (self.is_tracked and options.tip_mm is not None)

    def read(self, path: Path, options: ReadOptions) -> Surface:
        """Read the surface in the file's unit; in its own axes if it states any, otherwise turned as asked."""
        self._check(path, options)
        module, function = self.reader.split(":")
        reader: Reader = getattr(import_module(f"gapr_core.formats.{module}"), function)
        surface = reader(path, options)
        if self.in_mm:
            return axes.turned_as_named(surface, path, options.axes, self.in_lps)
        return axes.turned(surface, path, options.axes)

    def _check(self, path: Path, options: ReadOptions) -> None:
        """Refuse an option that this kind of file cannot follow: the file or the option is wrong."""
        nothing = ReadOptions(limits=options.limits)
        for name, (files, option) in CHOICES.items():
            if name not in self.uses and getattr(options, name) != getattr(nothing, name):
                raise ConfigError(f"{files} for {option}", path.name, f"give one, or leave {option} out")


CHOICES = {  # choice of `ReadOptions` -> the files that have it, and how a user names it
    "labels": ("a label map", "--label (--source-label of the source, model_label of the node)"),
    "tip_mm": ("a recording of a tracked tool", "--tip"),
    "tool": ("a recording of a tracked tool", "--tool"),
    "reference": ("a recording of tracked tools", "--reference"),
    "topic": ("a bag", "--topic"),
    "clouds": ("a bag", "--clouds"),
}
TRACKED = ("tip_mm", "tool", "reference")
LABEL_MAP = Format("volumes.label_map:read", in_mm=True, in_lps=True, uses=("labels",))
MARKUPS = Format("markups:read", in_mm=True, in_lps=True)
FORMATS = {
    ".ply": Format("meshes.ply:read"),
    ".pcd": Format("meshes.pcd:read"),
    ".stl": Format("meshes.stl:read"),
    ".obj": Format("meshes.obj:read"),
    ".vtk": Format("meshes.vtk:read"),
    ".vtp": Format("meshes.vtp:read"),
    ".npy": Format("meshes.arrays:read_npy", uses=("tip_mm",)),
    ".npz": Format("meshes.arrays:read_npz"),
    ".nii": LABEL_MAP,
    ".nii.gz": LABEL_MAP,
    ".nrrd": LABEL_MAP,
    ".mha": LABEL_MAP,
    ".dcm": LABEL_MAP,
    ".mrk.json": MARKUPS,
    ".fcsv": MARKUPS,
    ".csv": Format("points_text:read_csv", uses=TRACKED),
    ".txt": Format("points_text:read"),
    ".xyz": Format("points_text:read"),
    ".pts": Format("points_text:read_pts"),
    ".igs.mha": Format("sweeps:read_igs", in_mm=True, uses=TRACKED),
}
FOLDER = Format("sweeps:read_folder", in_mm=True, uses=TRACKED)
DETACHED = (".mhd", ".nhdr")  # headers that name another file, which is not opened for them
LONGEST_REASON = 160
BARE = (LookupError, TypeError, AttributeError, StopIteration, AssertionError)  # words of Python, not of the file


def read(path: Path, options: ReadOptions | None = None) -> Surface:
    """Read points and faces of a file, a folder of tracked slices, or a plug-in's kind.

    Raises:
        InvalidPointCloudError: an unknown format, a missing, damaged, cut or empty file, or one beyond the limits.
        ConfigError: a choice that this kind of file has not, such as a label of a mesh.
        MethodUnavailableError: a library that the format needs is not installed.
    """
    options = options or ReadOptions()
    path = path if path.name else path.resolve()  # a dot has no name
    kind = format_of(path)
    try:
        with np.errstate(all="ignore"):  # of numbers that are checked afterwards
            surface = kind.read(path, options)
    except InvalidPointCloudError as error:
        given = error.given if path.is_file() and path.name in error.given else f"{path.name}: {error.given}"
        raise InvalidPointCloudError(error.expected, given, error.how_to_fix) from error
    except GaprError:
        raise
    except PermissionError as error:
        how = "let this user read it"
        raise InvalidPointCloudError("a file that may be read", f"{path.name} ({error.strerror})", how) from error
    except MemoryError as error:
        how = "thin or crop it, raise the limit (ulimit -v), or use a machine with more memory"
        raise InvalidPointCloudError("a file that fits into memory", path.name, how) from error
    except Exception as error:  # whatever a damaged file leads to: the sentence is the same
        raise unreadable(path, reason_of(error)) from error
    if len(surface.points) == 0:
        raise unreadable(path, "no points in it")
    if surface.faces is not None and len(surface.faces):
        check_faces(surface, path.name)
        if kind is not LABEL_MAP and (doubt := damage.doubt_of(surface)):
            log.warning("%s may be damaged: %s. If it comes from elsewhere, fetch it again", path.name, doubt)
    options.limits.check_counts(len(surface.points), 0 if surface.faces is None else len(surface.faces))
    return surface


def format_of(path: Path) -> Format | plugins.Plugin:
    """Return the kind of a file, by its name.

    Raises:
        InvalidPointCloudError: nothing there, an unknown ending, a packed file, a recording named as a label map, or a
            header without its voxels.
    """
    if plugin := plugins.of(path):
        return plugin
    if path.is_dir():
        return FOLDER
    if not path.is_file():
        raise InvalidPointCloudError("a file that exists", str(path), "check the path")
    ending = ending_of(path)
    signatures.check_packed(path, ending)
    signatures.check_sequence(path, ending)
    if ending in DETACHED:
        expected = "a header and its voxels in one file"
        raise InvalidPointCloudError(expected, path.name, "save it as one file: .mha or .nrrd")
    if ending not in FORMATS:
        if hint := signatures.hint_of_markups(path):
            raise InvalidPointCloudError("markups as .mrk.json", path.name, hint)
        if signatures.is_dicom(path):
            raise signatures.dicom_images(f"{path.name}, a DICOM file")
        endings = " ".join([*FORMATS, *plugins.kinds()])
        raise InvalidPointCloudError(f"one of {endings} or a folder", path.name, "convert the file to one of these")
    return FORMATS[ending]


def says_axes(path: Path) -> bool:
    """Tell whether a file states LPS or RAS: label maps, markups, a comment, or columns."""
    kind = format_of(path)
    return kind.in_lps or (not kind.in_mm and path.is_file() and axes.stated(path) is not None)


def reason_of(error: Exception) -> str:
    """Explain an error of a reader."""
    if isinstance(error, BARE):
        return f"its content is not laid out as the format wants it ({type(error).__name__})"
    return str(error) or type(error).__name__


def unreadable(path: Path, why: str) -> InvalidPointCloudError:
    """Build the error for an unreadable file, in one line."""
    if path.is_dir():
        how = "name a file in it" if why.startswith("no slices") else "correct it: a slice by itself has no pose"
        return InvalidPointCloudError("a readable folder", f"{path.name} ({_short(why)})", how)
    ending = ending_of(path)
    if path.is_file() and path.stat().st_size == 0:
        why = "0 bytes, an empty file"
    if signatures.is_utf_16(path):
        return InvalidPointCloudError("UTF-8 text", f"{path.name}: UTF-16 text", "save it as UTF-8")
    other, how = signatures.ending_of(path), "export it again"
    if other and other != ending:
        how = f"it looks like {other}: rename it, if that is what it is"
    return InvalidPointCloudError(f"a readable {ending.lstrip('.').upper()} file", f"{path.name} ({_short(why)})", how)


def _short(why: str) -> str:
    reason = " ".join(why.split())
    return reason if len(reason) <= LONGEST_REASON else reason[:LONGEST_REASON] + "..."


def ending_of(path: Path) -> str:
    """Return the longest known ending of a name, so `.igs.mha` is no `.mha`."""
    name = path.name.lower()
    return max((end for end in FORMATS if name.endswith(end)), key=len, default=path.suffix.lower())
