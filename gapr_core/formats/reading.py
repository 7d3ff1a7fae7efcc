"""A surface from a file: one reader for each format, and one sentence for what cannot be read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from gapr_core.errors import ConfigError, GaprError, InvalidPointCloudError
from gapr_core.formats import axes, plugins, signatures
from gapr_core.formats.limits import FileLimits
from gapr_core.formats.options import ReadOptions
from gapr_core.surface import Surface


@dataclass(frozen=True)
class Format:
    """A kind of file.

    Attributes:
        reader: `module:function` under `gapr_core.formats`; takes (path, limits) or, of patient data, (path, options).
        in_patient: whether the file says its own axes and is in mm: it comes out in LPS mm, and units do not apply.
        with_options: whether the reader of another file takes all options.
        unit: of its numbers, where the user names none.
        uses: the choices (`CHOICES`) that its reader takes; another one is an error and not ignored.
    """

    reader: str
    in_patient: bool = False
    with_options: bool = False
    unit: str = "mm"
    uses: tuple[str, ...] = ()

    @property
    def is_tracked(self) -> bool:
        """Whether it may be a recording in the frame of a tracker, whose axes are those of no patient."""
        return "tip_mm" in self.uses

    def read(self, path: Path, options: ReadOptions) -> Surface:
        """The surface, in LPS mm for patient data, otherwise in the file's unit with its axes turned as asked."""
        self._check(path, options)
        module, function = self.reader.split(":")
        reader: Callable[[Path, FileLimits | ReadOptions], Surface]
        reader = getattr(import_module(f"gapr_core.formats.{module}"), function)
        if self.in_patient:
            return axes.of_patient(reader(path, options), path, options.axes)
        return axes.turned(reader(path, options if self.with_options else options.limits), path, options.axes)

    def _check(self, path: Path, options: ReadOptions) -> None:
        """A choice that this kind of file cannot follow means that it is the wrong file, or the wrong choice."""
        nothing = ReadOptions(limits=options.limits)
        for name, (files, option) in CHOICES.items():
            if name not in self.uses and getattr(options, name) != getattr(nothing, name):
                raise ConfigError(f"{files} for {option}", path.name, f"give one, or leave {option} out")


CHOICES = {  # choice of `ReadOptions` -> the files that have it, and how a user names it
    "labels": ("a label map", "--label (model_label of the node)"),
    "tip_mm": ("a recording of a tracked tool", "--tip"),
    "tool": ("a recording of a tracked tool", "--tool"),
    "reference": ("a recording of tracked tools", "--reference"),
    "topic": ("a bag", "--topic"),
    "clouds": ("a bag", "--clouds"),
}
TRACKED = ("tip_mm", "tool", "reference")
LABEL_MAP = Format("volumes.label_map:read", in_patient=True, uses=("labels",))
FORMATS = {
    ".ply": Format("meshes.ply:read"),
    ".pcd": Format("meshes.pcd:read"),
    ".stl": Format("meshes.stl:read"),
    ".obj": Format("meshes.obj:read"),
    ".vtk": Format("meshes.vtk:read"),
    ".vtp": Format("meshes.vtp:read"),
    ".npy": Format("meshes.arrays:read_npy"),
    ".npz": Format("meshes.arrays:read_npz"),
    ".nii": LABEL_MAP,
    ".nii.gz": LABEL_MAP,
    ".nrrd": LABEL_MAP,
    ".mha": LABEL_MAP,
    ".dcm": LABEL_MAP,
    ".mrk.json": Format("markups:read", in_patient=True),
    ".fcsv": Format("markups:read", in_patient=True),
    ".csv": Format("points_text:read_csv", with_options=True, uses=TRACKED),
    ".txt": Format("points_text:read"),
    ".xyz": Format("points_text:read"),
    ".igs.mha": Format("sweeps:read_igs", in_patient=True, uses=TRACKED),
}
FOLDER = Format("sweeps:read_folder", in_patient=True, uses=TRACKED)
DETACHED = (".mhd", ".nhdr")  # headers that name another file, which is not opened for them
LONGEST_REASON = 160
BARE = (LookupError, TypeError, AttributeError, StopIteration, AssertionError)  # words of Python, not of the file


def read(path: Path, options: ReadOptions | None = None) -> Surface:
    """The points and faces of a file, a folder of tracked slices, or what an installed plug-in reads.

    Raises:
        InvalidPointCloudError: an unknown format, a missing, damaged, cut or empty file, or one beyond the limits.
        ConfigError: a choice that this kind of file has not, such as a label of a mesh.
        MethodUnavailableError: a library that the format needs is not installed.
    """
    options = options or ReadOptions()
    kind = format_of(path)
    try:
        surface = kind.read(path, options)
    except InvalidPointCloudError as error:
        raise InvalidPointCloudError(error.expected, f"{path.name}: {error.given}", error.how_to_fix) from error
    except GaprError:
        raise
    except PermissionError as error:
        how = "let this user read it"
        raise InvalidPointCloudError("a file that may be read", f"{path.name} ({error.strerror})", how) from error
    except MemoryError as error:
        how = "thin it, or use a machine with more memory"
        raise InvalidPointCloudError("a file that fits into memory", path.name, how) from error
    except Exception as error:  # whatever a damaged file leads to: the sentence is the same
        raise unreadable(path, reason_of(error)) from error
    if len(surface.points) == 0:
        raise unreadable(path, "no points in it")
    options.limits.check_counts(len(surface.points), 0 if surface.faces is None else len(surface.faces))
    return surface


def format_of(path: Path) -> Format | plugins.Plugin:
    """The kind of a file, by its name.

    Raises:
        InvalidPointCloudError: nothing there, an unknown ending, a packed file, or a header without its voxels.
    """
    if plugin := plugins.of(path):
        return plugin
    if path.is_dir():
        return FOLDER
    if not path.is_file():
        raise InvalidPointCloudError("a file that exists", str(path), "check the path")
    ending = _ending(path)
    signatures.check_packed(path, ending)
    if ending in DETACHED:
        expected = "a header and its voxels in one file"
        raise InvalidPointCloudError(expected, path.name, "save it as one file: .mha or .nrrd")
    if ending not in FORMATS:
        endings = " ".join([*FORMATS, *plugins.kinds()])
        raise InvalidPointCloudError(f"one of {endings} or a folder", path.name, "convert the file to one of these")
    return FORMATS[ending]


def says_axes(path: Path) -> bool:
    """Whether a file says that it is in LPS or RAS: a label map, markups, or by a comment or names of columns."""
    kind = format_of(path)
    if kind.in_patient:
        return not kind.is_tracked
    return path.is_file() and axes.stated(path) is not None


def reason_of(error: Exception) -> str:
    """What an error of a reader says of the file."""
    if isinstance(error, BARE):
        return f"its content is not laid out as the format wants it ({type(error).__name__})"
    return str(error) or type(error).__name__


def unreadable(path: Path, why: str) -> InvalidPointCloudError:
    """The error for a file that cannot be read, in one line."""
    if path.is_dir():
        return InvalidPointCloudError("a readable folder", f"{path.name} ({_short(why)})", "name a file in it")
    ending = _ending(path)
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


def _ending(path: Path) -> str:
    """The longest known ending of a name, so that `.igs.mha` is no `.mha`."""
    name = path.name.lower()
    return max((end for end in FORMATS if name.endswith(end)), key=len, default=path.suffix.lower())
