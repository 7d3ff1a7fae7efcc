"""Voxels that are damaged, cut or elsewhere never become a bone."""

import os
import re
import zlib

import numpy as np
import pytest
from label_map_files import affine_of, dicom_seg, image_of, voxels_of

from gapr_core import clouds
from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats.volumes import whole

sitk = pytest.importorskip("SimpleITK", reason="reference: pip install SimpleITK")

PIXELS = [sitk.sitkUInt8, sitk.sitkInt16, sitk.sitkUInt32, sitk.sitkInt64, sitk.sitkFloat64, sitk.sitkVectorUInt8]
DETACHED = "a header and its voxels in one file"


def saved(path, packed=True, pixel=sitk.sitkUInt8):
    image = image_of(voxels_of(*affine_of((3.0, 3.0, 3.0))), affine_of((3.0, 3.0, 3.0))[0])
    sitk.WriteImage(sitk.Cast(image, pixel), str(path), packed)
    return path


def start_of(path):
    """Where the voxels begin, packed or not."""
    return 20 if path.name.endswith(".gz") else 352 if path.suffix == ".nii" else whole.header(path)[1]


def cut(data, start):
    return data[: start + (len(data) - start) // 2]


def flipped(data, start):
    at = start + (len(data) - start) // 2
    return data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :]


def without_checksum(data, start):
    return data[:-2]


def with_more(data, start):
    return data + b"more"


def of_another_size(data, start):
    return data.replace(b"30 30 30", b"30 30 15")


def without_size(data, start):
    return data.replace(b"DimSize = 30 30 30\n", b"").replace(b"sizes: 30 30 30\n", b"")


def packed_by_bzip2(data, start):
    return data.replace(b"encoding: gzip", b"encoding: bzip2")


def without_packed_size(data, start):
    return re.sub(rb"CompressedDataSize = \d+\n", b"", data)


def of_another_packed_size(data, start):
    return re.sub(rb"(CompressedDataSize = )\d+", rb"\g<1>10", data)


CASES = [
    *[(name, how, None) for name in ("a.mha", "a.nrrd", "a.nii.gz") for how in (cut, flipped, without_checksum)],
    *[(name, how, None) for name in ("a.mha", "a.nrrd") for how in (of_another_size, without_size)],
    ("a.mha", without_packed_size, "no CompressedDataSize"), ("a.mha", of_another_packed_size, "announces 10"),
    ("a.mha", with_more, "data behind the end"), ("a.nrrd", with_more, "data behind the end"),
    ("a.nii.gz", with_more, None), ("a.nrrd", packed_by_bzip2, "encoding of raw, gzip, hex or text; got a.nrrd: bzip2"),
    *[(name, how, "bytes of voxels where") for name in ("raw.mha", "raw.nrrd", "raw.nii") for how in (cut, with_more)],
]  # fmt: skip


@pytest.mark.parametrize(("name", "how", "said"), CASES)
def test_voxels_that_are_not_those_of_the_header_are_refused(tmp_path, name, how, said):
    path = saved(tmp_path / name, packed=not name.startswith("raw"))
    damaged = how(path.read_bytes(), start_of(path))
    assert damaged != path.read_bytes()
    path.write_bytes(damaged)
    with pytest.raises(InvalidPointCloudError, match=said or path.name):
        clouds.load(path)


@pytest.mark.parametrize("name", ["a.mha", "a.nrrd"])
def test_no_damaged_byte_of_a_packed_stream_passes(tmp_path, name):
    path, rng = saved(tmp_path / name), np.random.default_rng(0)
    data, start = path.read_bytes(), start_of(path)
    bits, refused = whole.GZIP if name == "a.nrrd" else whole.ZLIB, 0
    whole.check_voxels(path, 30**3, 1)
    for at in rng.integers(start, len(data), 100):
        damaged = data[:at] + bytes([data[at] ^ 1 << rng.integers(8)]) + data[at + 1 :]
        path.write_bytes(damaged)
        try:
            whole.check_voxels(path, 30**3, 1)
        except ValueError:
            refused += 1
        else:
            assert zlib.decompress(damaged[start:], bits) == zlib.decompress(data[start:], bits)
    assert refused > 80


@pytest.mark.parametrize("pixel", PIXELS)
@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("name", ["a.mha", "a.nrrd"])
def test_whole_voxels_of_every_type_pass(tmp_path, name, packed, pixel):
    image = sitk.ReadImage(str(path := saved(tmp_path / name, packed, pixel)))
    count, size = image.GetNumberOfComponentsPerPixel(), image.GetSizeOfPixelComponent()
    whole.check_voxels(path, 30**3 * count, size)
    with pytest.raises(ValueError, match="bytes of voxels where"):
        whole.check_voxels(path, 30**3 * count - 1, size)


@pytest.mark.parametrize(("name", "local", "elsewhere"), [
    ("a.mha", b"ElementDataFile = LOCAL", b"ElementDataFile = %s"),
    ("a.mha", b"ElementDataFile = LOCAL", b"ElementDataFile : %s\nElementDataFile = LOCAL"),
    ("a.nrrd", b"encoding: raw", b"encoding: raw\ndata file: %s"),
    ("a.nrrd", b"encoding: raw", b"encoding: raw\nDataFile: %s"),
])  # fmt: skip
@pytest.mark.parametrize("where", ["absolute", "relative", "fifo"])
def test_voxels_of_another_file_are_never_opened(tmp_path, name, local, elsewhere, where):
    other = tmp_path / "other.raw"
    if where == "fifo":
        os.mkfifo(other)
    else:
        other.write_bytes(bytes(30**3))
    path = saved(tmp_path / name, packed=False)
    named = elsewhere % (f"../{tmp_path.name}/other.raw" if where == "relative" else str(other)).encode()
    path.write_bytes(path.read_bytes().replace(local, named))
    with pytest.raises(InvalidPointCloudError, match=DETACHED):
        clouds.load(path)


def test_a_nifti_header_of_an_image_in_another_file_is_refused(tmp_path):
    path = saved(tmp_path / "a.nii", packed=False)
    path.write_bytes(path.read_bytes().replace(b"n+1\0", b"ni1\0", 1))
    with pytest.raises(InvalidPointCloudError, match=DETACHED):
        clouds.load(path)


def test_a_dicom_segmentation_has_the_frames_and_bytes_of_its_header(tmp_path):
    pydicom = pytest.importorskip("pydicom", reason="it writes the DICOM image: pip install pydicom")
    path = dicom_seg(tmp_path)
    for name, change in (("frames", {"NumberOfFrames": 3}), ("bytes", {"PixelData": b"\0\0"})):
        seg = pydicom.dcmread(path)
        for key, value in change.items():
            setattr(seg, key, value)
        seg.save_as(tmp_path / f"{name}.dcm")
        with pytest.raises(InvalidPointCloudError, match="where its header announces"):
            clouds.load(tmp_path / f"{name}.dcm")
