"""Label maps of an ellipsoid, and DICOM segmentations."""

import numpy as np
import pytest

sitk = pytest.importorskip("SimpleITK", reason="it writes the label maps: pip install SimpleITK")

RADII = np.array([22.0, 15.0, 30.0])
CENTRE = np.array([12.0, -40.0, 7.0])


def affine_of(spacing, turn=None, flip=(1, 1, 1)):
    """Index to LPS mm of a grid around the ellipsoid."""
    from scipy.spatial.transform import Rotation

    rotation = np.eye(3) if turn is None else Rotation.from_rotvec(turn).as_matrix()
    affine = np.eye(4)
    affine[:3, :3] = rotation @ np.diag(flip) @ np.diag(spacing)
    size = np.ceil(2.0 * 45.0 / np.asarray(spacing)).astype(int)
    affine[:3, 3] = CENTRE - affine[:3, :3] @ ((size - 1) / 2.0) + 0.3
    return affine, size


def voxels_of(affine, size, centre=CENTRE, radii=RADII):
    """[k, j, i] of the voxels whose centre is inside the ellipsoid."""
    index = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1)
    inside = np.linalg.norm((index @ affine[:3, :3].T + affine[:3, 3] - centre) / radii, axis=-1) < 1.0
    return inside.transpose(2, 1, 0)


def image_of(voxels, affine):
    image = sitk.GetImageFromArray(voxels.astype(np.uint8))
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((affine[:3, :3] / spacing).ravel().tolist())
    image.SetOrigin(affine[:3, 3].tolist())
    return image


def write(path, voxels, affine, **metadata):
    image = image_of(voxels, affine)
    for key, value in metadata.items():
        image.SetMetaData(key, value)
    sitk.WriteImage(image, str(path))
    return path


def error_mm(points, centre=CENTRE, radii=RADII):
    """Signed distance to the ellipsoid to first order: f / |grad f|."""
    x = (points - centre) / radii
    f = np.linalg.norm(x, axis=1)
    return (f - 1.0) * f / np.linalg.norm(x / radii, axis=1)


def dicom_seg(tmp_path, spacing=(1.5, 1.5, 2.0), names=("femur", "tibia"), layers=None, kind="BINARY", numbers=(1, 2)):
    """Balls of radius 12, or `layers` (affine, [k, j, i] of each name), written by highdicom against a CT of slices."""
    highdicom = pytest.importorskip(
        "highdicom", reason="it writes the DICOM segmentation to read: pip install highdicom"
    )
    import pydicom
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid

    affine, size = affine_of(spacing)
    if layers is None:
        balls = [voxels_of(affine, size, CENTRE + [0, 0, z], [12, 12, 12]) for z in (20, -20)][: len(names)]
        layers = affine, balls
    affine, voxels = layers
    size, spacing = voxels[0].shape[::-1], np.linalg.norm(affine[:3, :3], axis=0).tolist()
    study, series, frame = generate_uid(), generate_uid(), generate_uid()
    slices = []
    for k in range(size[2]):
        s = pydicom.Dataset()
        s.file_meta = pydicom.dataset.FileMetaDataset()
        s.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        s.SOPClassUID, s.SOPInstanceUID = CTImageStorage, generate_uid()
        s.StudyInstanceUID, s.SeriesInstanceUID, s.FrameOfReferenceUID = study, series, frame
        s.PatientName, s.PatientID, s.PatientBirthDate, s.PatientSex = "Doe^Jane", "PAT-0815-4711", "19500101", "F"
        s.StudyID, s.StudyDate, s.StudyTime = "1", "20200101", "000000"
        s.AccessionNumber, s.ReferringPhysicianName = "", ""
        s.Modality, s.SeriesNumber, s.InstanceNumber = "CT", 1, k + 1
        s.Rows, s.Columns, s.PixelSpacing, s.SliceThickness = int(size[1]), int(size[0]), [*spacing[:2]], spacing[2]
        s.ImageOrientationPatient, s.ImagePositionPatient = (
            [1, 0, 0, 0, 1, 0],
            (affine[:3, 3] + [0, 0, spacing[2] * k]).tolist(),
        )
        s.BitsAllocated, s.BitsStored, s.HighBit, s.PixelRepresentation, s.SamplesPerPixel = 16, 16, 15, 0, 1
        s.PhotometricInterpretation = "MONOCHROME2"
        slices.append(s)
    from pydicom.sr.codedict import codes

    bone = (codes.SCT.Bone, codes.SCT.Bone, highdicom.seg.SegmentAlgorithmTypeValues.MANUAL)
    numbers = numbers[: len(voxels)]
    segments = [highdicom.seg.SegmentDescription(n, name, *bone) for n, name in zip(numbers, names, strict=True)]
    pixels = np.stack(voxels, axis=-1)
    pixels = pixels @ numbers if kind == "LABELMAP" else pixels
    seg = highdicom.seg.Segmentation(
        slices, pixels.astype(np.uint8), highdicom.seg.SegmentationTypeValues[kind], segments,
        generate_uid(), 2, generate_uid(), 1, "GAPR", "test", "1", "1",
    )  # fmt: skip
    seg.save_as(tmp_path / "seg.dcm")
    return tmp_path / "seg.dcm"
