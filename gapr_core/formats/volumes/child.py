"""The process that reads a label map with native libraries: `python -m gapr_core.formats.volumes.child REQUEST OUT`.

The answer goes to OUT as .npz: the voxels of the segments (cropped), where they lie, and notes. When ITK or a codec
dies of a damaged file, only this process ends.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapr_core.errors import GaprError, InvalidPointCloudError
from gapr_core.formats import reading, signatures
from gapr_core.formats.limits import MB, FileLimits
from gapr_core.formats.volumes import names, nifti, placement, whole
from gapr_core.formats.volumes.names import Segment

Array = NDArray[np.float64]
MARGIN = 6  # voxels around the segments: what smoothing reaches
LIBRARIES_BYTES = 4 << 30  # address space that they reserve


def main(request: str, out: str) -> int:
    """Read the request's labels; a refusal goes to stdout as JSON, with exit code 1."""
    asked = json.loads(request)
    limits = FileLimits(**asked["limits"])
    _limit(limits, asked["seconds"])
    path = Path(asked["path"])
    try:
        is_dicom = path.suffix.lower() == ".dcm"
        voxels, affine, named = _read_dicom(path, limits, asked["labels"]) if is_dicom else _read_itk(path, limits)
        present = {layer: {int(v) for v in np.unique(volume) if v} for layer, volume in enumerate(voxels)}
        chosen, notes = names.choose(asked["labels"], named, present)
        mask, start = _cropped(np.logical_or.reduce([voxels[s.layer] == s.value for s in chosen]))
    except GaprError as error:
        sys.stdout.write(json.dumps([error.expected, error.given, error.how_to_fix]))
        return 1
    except MemoryError:
        raise
    except Exception as error:  # whatever a damaged file leads to
        sys.stderr.write(reading.reason_of(error))
        return 1
    np.savez(out, mask=mask, affine=affine, start=start, notes=np.frombuffer(json.dumps(notes).encode(), np.uint8))
    return 0


def _limit(limits: FileLimits, seconds: int) -> None:
    """End this process, also without its parent, where it takes longer or more memory than a load is allowed."""
    try:
        import resource
    except ImportError:  # not on Windows
        return
    signal.alarm(seconds)
    own = [limit for limit in resource.getrlimit(resource.RLIMIT_AS) if limit != resource.RLIM_INFINITY]
    most = min([int(20 * limits.unpacked_mb * MB) + LIBRARIES_BYTES, *own])
    resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _read_itk(path: Path, limits: FileLimits) -> tuple[list[NDArray[Any]], Array, list[Segment]]:
    """Layers [k, j, i], the affine of (i, j, k) to LPS mm, and the segments that the header lists."""
    import SimpleITK

    is_nifti = path.name.lower().endswith((".nii", ".nii.gz"))
    os.environ["ITK_NIFTI_SFORM_PERMISSIVE"] = "1"  # else it refuses an sform that is rounded
    if is_nifti:
        nifti.check_length(path, limits)
    else:
        whole.header(path)
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(path))
    reader.ReadImageInformation()
    one = SimpleITK.Image([1] * reader.GetDimension(), reader.GetPixelID(), reader.GetNumberOfComponents())
    count = int(np.prod(reader.GetSize(), dtype=np.float64)) * one.GetNumberOfComponentsPerPixel()
    limits.check_unpacked(count * one.GetSizeOfPixelComponent())
    if not is_nifti:
        whole.check_voxels(path, count, one.GetSizeOfPixelComponent())
    try:
        image = reader.Execute()
    except RuntimeError as error:  # ITK says where in its source, or that a file that is here is not
        if "allocat" in str(error):
            raise MemoryError from error
        raise InvalidPointCloudError("voxels that ITK can read", "others", "save it again with 3D Slicer") from error
    if image.GetDimension() != 3:
        raise InvalidPointCloudError("a volume", f"{image.GetDimension()} dimensions", "export one time step")
    _check_axes(path, {key: image.GetMetaData(key) for key in image.GetMetaDataKeys()})
    placement.check(path)
    voxels = SimpleITK.GetArrayFromImage(image)
    layers = list(np.moveaxis(voxels, 3, 0)) if voxels.ndim == 4 else [voxels]
    metadata = {key: image.GetMetaData(key) for key in image.GetMetaDataKeys() if key.startswith("Segment")}
    _check_binary(metadata)
    named = names.of_seg_nrrd(metadata, len(layers))
    if is_nifti:
        named = [Segment(name, value) for value, name in nifti.label_names(path).items()]
    direction = np.reshape(image.GetDirection(), (3, 3))
    affine = _affine(direction * image.GetSpacing(), image.GetOrigin())
    if is_nifti and (sform := nifti.geometry(path).sform) is not None:
        affine[:3] = sform * np.array([[-1.0], [-1.0], [1.0]])  # of one that is rounded, ITK 5.4 takes the transpose
    return [_integers(layer) for layer in layers], affine, named


def _check_axes(path: Path, metadata: dict[str, str]) -> None:
    """Raise for a header that does not say how the voxels lie in the patient: the guess may be a mirror image."""
    if path.name.lower().endswith(".nrrd"):  # ITK turns RAS and LAS to LPS as it reads, and takes all else as it is
        space = metadata.get("NRRD_space", "none")
        known, given = space == "left-posterior-superior", f"space: {space}"
    else:
        codes = [metadata.get(key, "1") for key in ("qform_code", "sform_code")]
        known, given = codes != ["0", "0"], "qform_code and sform_code of 0"
    if not known:
        raise InvalidPointCloudError("patient axes in the header", given, "export it with its affine, LPS or RAS")


def _check_binary(metadata: dict[str, str]) -> None:
    """Raise for shares of voxels, which 3D Slicer writes under either of two keys: what they are shares of varies."""
    for key in ("Segmentation_MasterRepresentation", "Segmentation_SourceRepresentation"):
        if (kind := metadata.get(key, "")).lower().startswith("fractional"):
            how = "make Binary labelmap the source representation (module Segmentations), and save it again"
            raise InvalidPointCloudError("a binary label map", f"a {kind.lower()}, says {key}", how)


def _read_dicom(
    path: Path, limits: FileLimits, labels: list[str]
) -> tuple[list[NDArray[np.int64]], Array, list[Segment]]:
    """Read the segments of a DICOM segmentation, which may overlap; of many, the chosen ones.

    The background of a label map, number 0, is no segment.
    """
    import highdicom

    try:
        seg = highdicom.seg.segread(path)
    except ValueError as error:
        if "not a Segmentation" in str(error):
            raise signatures.dicom_images("another kind of DICOM") from error
        raise
    numbers = [number for number in seg.segment_numbers if number > 0]
    words = [str(seg.get_segment_description(number).SegmentLabel) for number in numbers]
    named = [Segment(word, number, n) for n, (word, number) in enumerate(zip(words, numbers, strict=True))]
    chosen = names.choose(labels, named, {s.layer: {s.value} for s in named})[0] if labels else named
    named = [Segment(s.name, s.value, layer) for layer, s in enumerate(dict.fromkeys(chosen))]
    _check_pixels(seg)
    geometry = seg.get_volume_geometry()
    if geometry is None:
        raise InvalidPointCloudError("slices of one volume, at one distance", "others", "resample the segmentation")
    limits.check_unpacked(int(np.prod(geometry.spatial_shape)) * len(named) * 8)
    numbers = [s.value for s in named]
    volume = seg.get_volume(segment_numbers=numbers, combine_segments=False, rescale_fractional=False)
    voxels = np.asarray(volume.array)
    threshold = 0.5 * int(seg.MaximumFractionalValue) if str(seg.SegmentationType) == "FRACTIONAL" else 0
    layers = [(voxels[..., s.layer] > threshold) * np.int64(s.value) for s in named]
    affine = np.array(volume.affine)  # of the axes in the order of the array: the first goes through the slices
    affine[:3, 3] -= MARGIN * affine[:3, 0]
    layers = [np.pad(layer, [(MARGIN, MARGIN), (0, 0), (0, 0)]) for layer in layers]  # empty slices are not written
    return [layer.transpose(2, 1, 0) for layer in layers], affine, named


def _check_pixels(seg: Any) -> None:
    """Raise `ValueError` for another number of frames or bytes than the header announces: DICOM has no checksum."""
    if (count := len(seg.PerFrameFunctionalGroupsSequence)) != int(seg.NumberOfFrames):
        raise ValueError(f"places of {count} frames where its header announces {seg.NumberOfFrames}")
    if not seg.file_meta.TransferSyntaxUID.is_encapsulated:
        bits = int(seg.NumberOfFrames) * int(seg.Rows) * int(seg.Columns) * int(seg.BitsAllocated)
        whole.check_length(len(seg.PixelData), -(-bits // 16) * 2)  # an even number


def _integers(voxels: NDArray[Any]) -> NDArray[Any]:
    """Voxels that are whole numbers from 0, in as few bytes as the file has them in."""
    whole = voxels.astype(np.int64) if voxels.dtype.kind == "f" else voxels
    if whole is not voxels and (whole != voxels).any():
        raise InvalidPointCloudError("a label map: whole numbers", "fractions", "give the segmentation, not the image")
    if whole.min() < 0:
        given = f"values from {whole.min()} to {whole.max()}"
        raise InvalidPointCloudError("a label map: numbers from 0", given, "give the segmentation, not the image")
    return whole


def _affine(columns: Array, origin: Any) -> Array:
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = columns, origin
    return affine


def _cropped(mask: NDArray[np.bool_]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Crop the mask [k, j, i] to its voxels; return the (i, j, k) of its start as well."""
    spans = []
    for axis in range(3):
        used = np.flatnonzero(mask.any(axis=tuple(a for a in range(3) if a != axis)))
        spans.append((max(int(used[0]) - MARGIN, 0), int(used[-1]) + 1 + MARGIN))
    block = tuple(slice(*span) for span in spans)
    return mask[block].astype(np.uint8), np.array([span[0] for span in reversed(spans)])


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:3]))
