"""Label maps: the right segment, in LPS, where the surface is."""

import gzip
import logging
import os
import re

import numpy as np
import pytest
from label_map_files import CENTRE, RADII, affine_of, dicom_seg, error_mm, image_of, voxels_of, write

from gapr_core import clouds
from gapr_core.data.solid import is_closed, volume_mm3
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.formats.options import ReadOptions
from gapr_core.formats.volumes import names, nifti
from gapr_core.formats.volumes.contour import surface_of
from gapr_core.formats.volumes.names import Segment

sitk = pytest.importorskip("SimpleITK", reason="reference: pip install SimpleITK")


@pytest.mark.parametrize(
    ("ending", "spacing", "turn", "flip"),
    [("nii", (1.0, 1.4, 2.5), (0.3, -0.5, 0.8), (1, 1, 1)), ("nii.gz", (1.5, 1.5, 2.0), None, (-1, 1, 1)),
     ("nrrd", (1.5, 1.5, 2.0), (0.0, 0.4, 0.0), (1, -1, -1)), ("mha", (1.5, 1.5, 1.5), None, (1, 1, 1))],
)  # fmt: skip
def test_a_label_comes_out_in_lps_mm_at_sub_voxel_accuracy(tmp_path, ending, spacing, turn, flip):
    affine, size = affine_of(spacing, turn, flip)
    path = write(tmp_path / f"seg.{ending}", voxels_of(affine, size), affine)
    surface = clouds.load(path, units="m")  # units are of files that do not say theirs
    assert np.sqrt((error_mm(surface.points) ** 2).mean()) < 0.15 * max(spacing)
    assert abs(error_mm(surface.points).mean()) < 0.03 * max(spacing)
    assert is_closed(surface.triangles)
    assert volume_mm3(surface) == pytest.approx(4.0 / 3.0 * np.pi * RADII.prod(), rel=0.02)


def test_the_smoothed_surface_does_not_shrink_where_a_gaussian_alone_does():
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    radius, affine = 6.0, np.eye(4)
    grid = np.stack(np.meshgrid(*[np.arange(-12.0, 13.0)] * 3, indexing="ij"), axis=-1)
    ball = (np.linalg.norm(grid - [0.2, 0.3, -0.1], axis=-1) < radius).astype(np.uint8)
    affine[:3, 3] = -12.0
    off = np.linalg.norm(surface_of(ball, affine).points - [-0.1, 0.3, 0.2], axis=1) - radius
    plain = marching_cubes(gaussian_filter(ball.astype(float), 1.0), 0.5)[0] - 12.0
    shrunk = np.linalg.norm(plain - [0.2, 0.3, -0.1], axis=1) - radius
    assert abs(off.mean()) < 0.04 and shrunk.mean() < -0.12  # s^2 / R = .17


def test_a_plate_of_one_voxel_is_kept():
    plate = np.zeros((20, 20, 20), dtype=np.uint8)
    plate[4:16, 4:16, 10] = 1
    thickness = np.ptp(surface_of(plate, np.eye(4)).points[:, 0])
    assert 0.5 < thickness < 1.5


def test_a_bone_that_the_image_cuts_is_open_there():
    affine, size = affine_of((1.5, 1.5, 1.5))
    surface = surface_of(voxels_of(affine, size)[: size[2] // 2].astype(np.uint8), affine)
    assert not is_closed(surface.triangles)
    assert np.sqrt((error_mm(surface.points) ** 2).mean()) < 0.3


def two_bones(tmp_path, ending, **metadata):
    affine, size = affine_of((1.5, 1.5, 1.5))
    one = voxels_of(affine, size, CENTRE + [0, 0, 25], [12, 12, 12]).astype(np.uint8)
    other = voxels_of(affine, size, CENTRE - [0, 0, 25], [10, 10, 10]).astype(np.uint8)
    return write(tmp_path / f"two.{ending}", 75 * one + 76 * other, affine, **metadata)


def options(*labels):
    return ReadOptions(labels=labels)


def mean_z(path, *labels):
    return clouds.load(path, options=options(*labels)).points[:, 2].mean() - CENTRE[2]


def totalsegmentator(path):
    """A NIfTI file with the extended header of `TotalSegmentator --ml`."""
    import nibabel

    image = nibabel.load(path)
    xml = ('<?xml version="1.0" encoding="UTF-8"?> <CaretExtension> <VolumeInformation Index="0"> <LabelTable>'
           '<Label Key="75" Red="1" Alpha="1"><![CDATA[femur_left]]></Label>\n'
           '<Label Key="76" Red="1" Alpha="1"><![CDATA[femur_right]]></Label>\n'
           '<Label Key="77" Red="1" Alpha="1"><![CDATA[hip_left]]></Label>\n'
           "</LabelTable></VolumeInformation></CaretExtension>\n   ")  # fmt: skip
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, xml.encode()))
    nibabel.save(image, path)
    return path


def test_names_come_out_of_totalsegmentators_header(tmp_path, caplog):
    path = totalsegmentator(two_bones(tmp_path, "nii.gz"))
    assert mean_z(path, "femur_left") == pytest.approx(25.0, abs=0.3)
    assert mean_z(path, "Femur Right") == pytest.approx(-25.0, abs=0.3)
    assert mean_z(path, "76") == pytest.approx(-25.0, abs=0.3) and "label 76 is femur_right" in caplog.text
    assert mean_z(path, "femur_left", "femur_right") == pytest.approx(4.5, abs=5.0)
    for labels, said in ((["femur"], "femur_left, femur_right"), (["hip_left"], "voxels of hip_left"),
                         ([], "2 of them .femur_left, femur_right.; name one")):  # fmt: skip
        with pytest.raises(InvalidPointCloudError, match=said):
            clouds.load(path, options=options(*labels))


def test_versions_of_totalsegmentator_are_named_where_the_file_has_no_names(tmp_path, caplog):
    mean_z(two_bones(tmp_path, "nii.gz"), "76")
    assert "rib_right_7 in TotalSegmentator v1, femur_right in TotalSegmentator v2 total" in caplog.text


@pytest.mark.parametrize("numbers", [(1,), (1, 2), (5,)])
def test_a_mask_without_names_is_not_taken_for_one_of_totalsegmentators(tmp_path, caplog, numbers):
    affine, size = affine_of((3.0, 3.0, 3.0))
    voxels = numbers[0] * voxels_of(affine, size).astype(np.uint8)
    voxels[0, 0, 0] = numbers[-1]
    clouds.load(write(tmp_path / "a.nii.gz", voxels, affine), options=options(str(numbers[0])))
    assert f"label {numbers[0]} has no name in the file" in caplog.text and "TotalSegmentator" not in caplog.text


@pytest.mark.parametrize(("label", "said"), [
    ("femur_right", "89 in TotalSegmentator v1, 76 in TotalSegmentator v2 total"),
    ("88", "voxels of 88; got two.nii.gz: none, but 75, 76"),
    ("²", "a segment ²; got two.nii.gz: a file without names, with 75, 76"),
])  # fmt: skip
def test_a_label_that_is_not_there_is_answered_with_those_that_are(tmp_path, label, said):
    with pytest.raises(InvalidPointCloudError, match=said):
        clouds.load(two_bones(tmp_path, "nii.gz"), options=options(label))


@pytest.mark.parametrize("key", ["Segmentation_MasterRepresentation", "Segmentation_SourceRepresentation"])
def test_a_fractional_segmentation_is_refused_with_the_way_out_in_slicer(tmp_path, key):
    path = two_bones(tmp_path, "seg.nrrd", **{key: "Binary labelmap"})
    assert len(clouds.load(path, options=options("75")).points) > 100
    path = two_bones(tmp_path, "seg.nrrd", **{key: "Fractional labelmap"})
    with pytest.raises(InvalidPointCloudError, match=f"a fractional labelmap, says {key}; make Binary labelmap the"):
        clouds.load(path, options=options("75"))


def test_two_long_bones_in_one_label_are_warned_of(tmp_path, caplog):
    """As both femora of a segmentation by thresholds."""
    affine, size = np.diag([3.0, 3.0, 3.0, 1.0]), np.array([60, 20, 120])
    at = [voxels_of(affine, size, np.array([x, 30.0, 180.0]), [15.0, 12.0, 160.0]) for x in (40.0, 140.0)]
    clouds.load(write(tmp_path / "one.nrrd", at[0], affine))
    assert "separate long parts" not in caplog.text
    clouds.load(write(tmp_path / "both.nrrd", at[0] | at[1], affine))
    assert "both.nrrd holds 2 separate long parts" in caplog.text and "a label of its own" in caplog.text


def test_the_tables_of_totalsegmentator_are_its_own():
    v1, v2, mr, limbs = names.TOTALSEGMENTATOR.values()
    assert [v1[n] for n in (18, 41, 58, 81, 82, 88, 89, 91)] == [
        "vertebrae_L5", "vertebrae_C1", "rib_left_1", "rib_right_12",
        "humerus_left", "femur_left", "femur_right", "hip_right",
    ]  # fmt: skip
    assert [v2[n] for n in (27, 50, 69, 75, 76, 78, 92, 115)] == [
        "vertebrae_L5", "vertebrae_C1", "humerus_left", "femur_left",
        "femur_right", "hip_right", "rib_left_1", "rib_right_12",
    ]  # fmt: skip
    assert (mr[36], mr[37], limbs[2], limbs[3]) == ("femur_left", "femur_right", "tibia", "fibula")


@pytest.mark.parametrize(("has_values", "labels", "said"), [
    (True, ["1"], "2 layers; choose it by its name"), (False, [], "2 of them .Femur, Tibia."),
])  # fmt: skip
def test_segments_of_slicer_have_names_values_and_layers(tmp_path, has_values, labels, said):
    """3D Slicer 4.10 writes no number and no layer: a segment lies in the layer of its number."""
    path = slicer(tmp_path, layers=2, has_values=has_values)
    assert mean_z(path, "Femur") == pytest.approx(20.0, abs=0.3)
    assert mean_z(path, "Tibia") == pytest.approx(-20.0, abs=0.3)
    with pytest.raises(InvalidPointCloudError, match=said):
        clouds.load(path, options=options(*labels))


def slicer(tmp_path, layers, has_values=False):
    """Femur and tibia as 3D Slicer writes them; without values as 4.10 does."""
    affine, size = affine_of((1.5, 1.5, 1.5))
    balls = [voxels_of(affine, size, CENTRE + [0, 0, z], [12, 12, 12]).astype(np.uint8) for z in (20, -20)]
    image = sitk.Compose([image_of(ball, affine) for ball in balls]) if layers == 2 else image_of(balls[0], affine)
    for i, name in enumerate(("Femur", "Tibia")):
        values = {"LabelValue": "1", "Layer": str(i)} if has_values else {"ID": f"Segment_{i + 1}"}
        for key, value in ({"Name": name} | values).items():
            image.SetMetaData(f"Segment{i}_{key}", value)
    sitk.WriteImage(image, str(tmp_path / "a.seg.nrrd"))
    return tmp_path / "a.seg.nrrd"


def test_names_that_share_their_voxels_are_no_choice(tmp_path):
    path = slicer(tmp_path, layers=1)
    with pytest.raises(InvalidPointCloudError, match="a number for each segment; got .*Femur, Tibia, all of number 1"):
        clouds.load(path, options=options("Tibia"))
    assert mean_z(path, "1") == pytest.approx(20.0, abs=0.3)


TWO = [Segment("2", 1), Segment("1", 2)]
OVERLAPPING = [Segment("2", 1, 0), Segment("1", 1, 1)]  # no voxel is of number 2


@pytest.mark.parametrize(("label", "segments", "present", "chosen"), [
    *[(label, TWO, {0: {1, 2}}, f"one segment {label}; got the name of the segment of number") for label in "12"],
    ("2", OVERLAPPING, {0: {1}, 1: {1}}, OVERLAPPING[0]), ("1", OVERLAPPING, {0: {1}, 1: {1}}, "one segment 1"),
    ("1", [Segment("1", 1), Segment("2", 2)], {0: {1, 2}}, Segment("1", 1)),
    ("3", [Segment("1", 1), Segment("Femur", 3)], {0: {1, 3}}, Segment("Femur", 3)),
    ("bone", [Segment("bone", 1), Segment("Bone", 2)], {0: {1, 2}}, "2 of the name bone"),
])  # fmt: skip
def test_one_segment_is_meant_or_none(label, segments, present, chosen):
    if isinstance(chosen, Segment):
        assert names.choose([label], segments, present)[0] == [chosen]
        return
    with pytest.raises(InvalidPointCloudError, match=chosen):
        names.choose([label], segments, present)


@pytest.mark.parametrize("ending", ["MHA", "Nrrd", "nii.GZ", "NII.gz", "NII"])
def test_endings_may_be_in_capitals(tmp_path, ending):
    affine, size = affine_of((3.0, 3.0, 3.0))
    written = write(tmp_path / f"a.{ending.lower()}", voxels_of(affine, size), affine)
    capital = written.rename(tmp_path / f"my scan v1.2.{ending}")
    surface = clouds.load(capital)
    np.testing.assert_allclose(surface.points.mean(axis=0), CENTRE, atol=0.5)


def test_a_dicom_segmentation_is_read_by_the_name_of_its_segment(tmp_path):
    path = dicom_seg(tmp_path)
    assert mean_z(path, "femur") == pytest.approx(20.0, abs=0.3)
    assert mean_z(path, "tibia") == pytest.approx(-20.0, abs=0.3)
    surface = clouds.load(path, options=options("femur"))
    assert np.sqrt((error_mm(surface.points, CENTRE + [0, 0, 20], [12, 12, 12]) ** 2).mean()) < 0.3


@pytest.mark.parametrize("numbers", [(1, 2), (5, 77)])
def test_a_dicom_label_map_is_read_as_binary_segments_are(tmp_path, numbers):
    """Label Map Segmentation Storage: its list of segments begins with the background."""
    path = dicom_seg(tmp_path, kind="LABELMAP", numbers=numbers)
    assert mean_z(path, "femur") == pytest.approx(20.0, abs=0.3)
    assert mean_z(path, str(numbers[1])) == pytest.approx(-20.0, abs=0.3)


def test_a_segment_of_a_dicom_segmentation_has_its_number(tmp_path, caplog):
    """Two of one name are told apart by their numbers, as the error says."""
    path = dicom_seg(tmp_path, names=("bone", "bone"))
    with pytest.raises(InvalidPointCloudError, match="2 of the name bone; rename one, or give its number"):
        clouds.load(path, options=options("bone"))
    assert mean_z(path, "2") == pytest.approx(-20.0, abs=0.3) and "label 2 is bone" in caplog.text
    assert clouds.load(path, options=options("2", "2")).extent_mm < 60.0


def test_of_many_segments_those_that_are_asked_for_are_unpacked(tmp_path, monkeypatch):
    """All bones of a CT would be many gigabytes."""
    path = dicom_seg(tmp_path)
    columns, rows, _ = affine_of((1.5, 1.5, 2.0))[1]
    both_mm = 2.0 * (20.0 + 12.0)
    monkeypatch.setenv("GAPR_MAX_UNPACKED_MB", str(1.5 * 8.0 * columns * rows * both_mm / 2.0 / (1 << 20)))
    assert mean_z(path, "femur") == pytest.approx(20.0, abs=0.3)
    with pytest.raises(InvalidPointCloudError, match="GAPR_MAX_UNPACKED_MB"):
        clouds.load(path, options=options("femur", "tibia"))


def test_a_dicom_image_is_no_segmentation_and_one_is_asked_for(tmp_path):
    pydicom = pytest.importorskip("pydicom", reason="it writes the DICOM image to refuse: pip install pydicom")
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid

    image = pydicom.Dataset()
    image.file_meta = pydicom.dataset.FileMetaDataset()
    image.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    image.SOPClassUID, image.SOPInstanceUID, image.Modality = CTImageStorage, generate_uid(), "CT"
    pydicom.dcmwrite(tmp_path / "1.dcm", image, enforce_file_format=True)
    with pytest.raises(InvalidPointCloudError, match=r"1\.dcm: another kind of DICOM; .*segment the bone"):
        clouds.load(tmp_path / "1.dcm")


def test_letters_of_any_kind_may_be_in_a_name_and_bytes_that_are_none_are_said(tmp_path):
    affine, size = affine_of((1.5, 1.5, 1.5))
    named = write(tmp_path / "a.nii.gz", voxels_of(affine, size), affine).rename(tmp_path / "F\u00e9mur \u9aa8.nii.gz")
    assert np.abs(error_mm(clouds.load(named).points)).max() < 1.5
    latin = named.rename(tmp_path / os.fsdecode(b"f\xe9mur.nii.gz"))
    with pytest.raises(InvalidPointCloudError, match="a path in UTF-8; .*rename the file"):
        clouds.load(latin)


@pytest.mark.parametrize(("voxels", "said"), [
    (np.pad(np.ones((1, 1, 1)), 9), "too thin or too small for its voxels; segment it on a finer grid"),
    (np.ones((1, 9, 9)), "too thin or too small for its voxels; segment it on a finer grid"),
    (np.ones((9, 9, 9)), "fills the whole image; check the segmentation, and which label you chose"),
])  # fmt: skip
def test_a_segment_without_a_surface_is_no_damaged_file(tmp_path, voxels, said):
    path = write(tmp_path / "a.nrrd", voxels, np.eye(4))
    with pytest.raises(InvalidPointCloudError, match=f"a segment with a surface; got a.nrrd: one that (is )?{said}"):
        clouds.load(path)


def test_specks_are_left_out_and_said(tmp_path, caplog):
    affine, size = affine_of((1.5, 1.5, 1.5))
    voxels = voxels_of(affine, size)
    voxels[2, 2, 2] = True
    surface = clouds.load(write(tmp_path / "a.nrrd", voxels, affine))
    assert np.abs(error_mm(surface.points)).max() < 1.5 and "1 specks" in caplog.text


def test_images_and_empty_label_maps_are_refused(tmp_path):
    affine, size = affine_of((3.0, 3.0, 3.0))
    image = sitk.Cast(image_of(voxels_of(affine, size), affine), sitk.sitkInt16) - 1000
    sitk.WriteImage(image, str(tmp_path / "ct.nii.gz"))
    with pytest.raises(InvalidPointCloudError, match="a label map: numbers from 0"):
        clouds.load(tmp_path / "ct.nii.gz")
    with pytest.raises(InvalidPointCloudError, match="a segment; got empty.nrrd: zeros only"):
        clouds.load(write(tmp_path / "empty.nrrd", np.zeros((9, 9, 9)), affine))
    with pytest.raises(InvalidPointCloudError, match="voxels of 7; got empty.nrrd: none, but zeros only; check the"):
        clouds.load(tmp_path / "empty.nrrd", options=options("7"))


def nifti_of(path, kind="Nifti1Image", millimetres=True, says_where=True):
    """A ball as nibabel writes it."""
    import nibabel

    affine, size = affine_of((3.0, 3.0, 3.0))
    ras = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    ras[:3] *= 1.0 if millimetres else 0.001
    image = getattr(nibabel, kind)(voxels_of(affine, size).transpose(2, 1, 0).astype(np.uint8), ras)
    for code in (image.set_sform, image.set_qform):
        code(ras, int(says_where))
    nibabel.save(image, path)
    return path


def test_a_header_without_the_patients_axes_is_refused(tmp_path):
    with pytest.raises(InvalidPointCloudError, match="patient axes .* qform_code and sform_code of 0"):
        clouds.load(nifti_of(tmp_path / "a.nii.gz", says_where=False))
    with pytest.raises(InvalidPointCloudError, match="expected NIfTI-1; got a.nii: NIfTI-2"):
        clouds.load(nifti_of(tmp_path / "a.nii", "Nifti2Image"))
    voxels = voxels_of(*affine_of((3.0, 3.0, 3.0))).astype(np.uint8)
    head = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: {} {} {}\nencoding: raw\n{}\n"
    for space in ("", "space: scanner-xyz\nspace directions: (3,0,0) (0,3,0) (0,0,3)\nspace origin: (0,0,0)\n"):
        (tmp_path / "a.nrrd").write_bytes(head.format(*voxels.shape[::-1], space).encode() + voxels.tobytes())
        with pytest.raises(InvalidPointCloudError, match="patient axes in the header; got a.nrrd: space: (none|scann)"):
            clouds.load(tmp_path / "a.nrrd")


def nifti_with(path, turn=(0.0, 0.0, 0.0), **changes):
    """A ball as nibabel writes it with the same qform and sform, and then its header changed."""
    import nibabel

    affine, size = affine_of((3.0, 3.0, 3.0), turn)
    ras = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    image = nibabel.Nifti1Image(voxels_of(affine, size).transpose(2, 1, 0).astype(np.uint8), ras)
    image.set_qform(ras, 1)
    image.set_sform(ras, 1)
    data = bytearray(image.to_bytes())
    header = nibabel.Nifti1Header(bytes(data[:348]))
    for name, value in changes.items():
        header[name] = value
    data[:348] = header.binaryblock
    path.write_bytes(bytes(data))
    return path


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.0, 0.0, 1e-4), (0.4, -0.2, 0.7), (1e-5, np.pi, 0.0)])
def test_a_nifti_with_the_same_place_twice_is_read(tmp_path, turn):
    """Near half a turn the quaternion of the qform is rounded to .03 deg."""
    surface = clouds.load(nifti_with(tmp_path / "a.nii", turn))
    assert np.abs(error_mm(surface.points)).max() < 2.0
    shifted = clouds.load(nifti_with(tmp_path / "b.nii", turn, sform_code=0))
    np.testing.assert_allclose(surface.points, shifted.points, atol=0.05)


@pytest.mark.parametrize("changes", [
    {"qoffset_x": 0.0}, {"quatern_b": 1.0, "quatern_c": 0.0, "quatern_d": 0.0}, {"srow_z": [0.0, 0.1, 3.0, -36.0]},
])  # fmt: skip
@pytest.mark.parametrize("codes", [(1, 1), (1, 2), (2, 4)])
def test_a_nifti_with_two_places_is_refused(tmp_path, changes, codes):
    path = nifti_with(tmp_path / "a.nii", **changes, qform_code=codes[0], sform_code=codes[1])
    with pytest.raises(InvalidPointCloudError, match="qform and sform that agree; got a.nii: .* mm apart; .*set_qform"):
        clouds.load(path)


@pytest.mark.parametrize("pixdim_mm", [3.1, 3.01])
def test_a_nifti_with_two_sizes_of_a_voxel_is_refused(tmp_path, pixdim_mm):
    """A third of a per cent is a millimetre over 300 mm."""
    clouds.load(nifti_with(tmp_path / "b.nii", qform_code=0, pixdim=[1.0, 3.0, 3.0, 3.0005, 1.0, 1.0, 1.0, 1.0]))
    wrong = nifti_with(tmp_path / "a.nii", qform_code=0, pixdim=[1.0, 3.0, 3.0, pixdim_mm, 1.0, 1.0, 1.0, 1.0])
    with pytest.raises(InvalidPointCloudError, match="one size of the voxels; got a.nii: 3 3 3 in the sform and 3 3 3"):
        clouds.load(wrong)


def test_a_sheared_grid_is_read_as_it_is(tmp_path):
    """As of a CT with a tilted gantry."""
    sheared = {"srow_y": [0.0, 3.0, 0.8, -36.0], "pixdim": [1.0, 3.0, 3.0, np.hypot(3.0, 0.8), 1.0, 1.0, 1.0, 1.0]}
    nifti_with(tmp_path / "a.nii", qform_code=0, **sheared)
    voxels = voxels_of(*affine_of((3.0, 3.0, 3.0))).astype(np.uint8)
    where = "space directions: (3,0,0) (0,3,0) (0,0.8,3)\nspace origin: (0,0,0)\n"
    head = HEADS["nrrd"].format(" ".join(map(str, voxels.shape[::-1])), where)
    (tmp_path / "b.nrrd").write_bytes(head.encode() + voxels.tobytes())
    for name, slope in (("a.nii", -0.8), ("b.nrrd", 0.8)):
        points = clouds.load(tmp_path / name).points
        straight = points - np.outer(points[:, 2], [0.0, slope / 3.0, 0.0])
        np.testing.assert_allclose(np.ptp(straight, axis=0), 2.0 * RADII, atol=2.0)


def test_a_sform_rounded_to_three_decimals_is_read_where_it_lies(tmp_path):
    """As some converters write it (TotalSegmentator, issue 461): ITK calls it not orthonormal."""
    whole = nifti_with(tmp_path / "a.nii", (0.1, 0.2, 0.3))
    rows = np.array([nibabel_header(whole)[f"srow_{axis}"] for axis in "xyz"]).round(3)
    rounded = dict(zip(("srow_x", "srow_y", "srow_z"), rows, strict=True))
    surface = clouds.load(nifti_with(tmp_path / "b.nii", (0.1, 0.2, 0.3), qform_code=0, **rounded))
    np.testing.assert_allclose(surface.points, clouds.load(whole).points, atol=0.1)


def nibabel_header(path):
    import nibabel

    return nibabel.load(path).header


WHERE = "space directions: (3,0,0) (0,3,0) (0,0,3)\n", "space origin: (-30,-80,-40)\n"
PLACES = {
    "a.nrrd": ("".join(WHERE), None), "b.nrrd": (WHERE[0], "no space origin"),
    "c.nrrd": (WHERE[1], "no space directions"),
    "d.nrrd": (WHERE[0] + "space origin: (nan,nan,nan)\n", "no space origin"),
    "e.nrrd": ("".join(WHERE) + 'space units: "cm" "cm" "cm"\n', "space units of mm; got e.nrrd: cm"),
    "f.nrrd": ("".join(WHERE) + 'space units: "mm" "millimeters" "mm"\n', None),
    "a.mha": ("TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 1 2 3\nElementSpacing = 3 3 3\n", None),
    "b.mha": ("Rotation = 1 0 0 0 1 0 0 0 1\nPosition = 1 2 3\nElementSize = 3 3 3\n", None),
    "c.mha": ("ElementSpacing = 3 3 3\n", "no TransformMatrix and no Offset"),
    "d.mha": ("TransformMatrix = 1 0 0 0 1 0 0 0 1\nElementSpacing = 3 3 3\n", "no Offset"),
    "e.mha": ("TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 1 2 3\n", "no ElementSpacing"),
    "f.mha": ("Rotation = 1 0 0 0 1 0 0 0 1\nPosition = 1 2 3\nElementSize = 3 3 3\nDistanceUnits = mm\n", None),
    "g.mha": ("Rotation = 1 0 0 0 1 0 0 0 1\nPosition = 1 2 3\nElementSize = 3 3 3\nDistanceUnits = cm\n",
              "DistanceUnits of mm; got g.mha: cm"),
}  # fmt: skip
HEADS = {
    "nrrd": "NRRD0004\ntype: uint8\ndimension: 3\nsizes: {0}\nencoding: raw\nspace: LPS\n{1}\n",
    "mha": "NDims = 3\nDimSize = {0}\nBinaryData = True\n{1}ElementType = MET_UCHAR\nElementDataFile = LOCAL\n",
}


@pytest.mark.parametrize("name", PLACES)
def test_a_header_says_its_origin_axes_and_spacing_in_mm(tmp_path, name):
    affine, size = affine_of((3.0, 3.0, 3.0))
    where, refusal = PLACES[name]
    head = HEADS[name.split(".")[1]].format(" ".join(map(str, size)), where)
    (tmp_path / name).write_bytes(head.encode() + voxels_of(affine, size).astype(np.uint8).tobytes())
    if refusal is None:
        assert clouds.load(tmp_path / name).extent_mm == pytest.approx(80.0, abs=5.0)
        return
    with pytest.raises(InvalidPointCloudError, match=refusal):
        clouds.load(tmp_path / name)


@pytest.mark.parametrize("space", ["left-posterior-superior", "right-anterior-superior", "LAS"])
def test_a_nrrd_comes_out_in_lps_whatever_its_space(tmp_path, space):
    affine, size = affine_of((3.0, 3.0, 3.0), turn=(0.2, 0.4, 0.1))
    to_space = {"l": np.eye(3), "r": np.diag([-1.0, -1.0, 1.0]), "L": np.diag([1.0, -1.0, 1.0])}[space[0]]
    rows = [f"({','.join(map(repr, row.tolist()))})" for row in np.vstack([(to_space @ affine[:3]).T])]
    head = f"NRRD0004\ntype: uint8\ndimension: 3\nspace: {space}\nsizes: {' '.join(map(str, size))}\nencoding: raw\n"
    head += f"space directions: {' '.join(rows[:3])}\nspace origin: {rows[3]}\n\n"
    (tmp_path / "a.nrrd").write_bytes(head.encode() + voxels_of(affine, size).astype(np.uint8).tobytes())
    assert np.abs(error_mm(clouds.load(tmp_path / "a.nrrd").points)).max() < 2.0


def test_a_wrong_unit_in_the_header_is_said_as_such(tmp_path):
    with pytest.raises(InvalidPointCloudError, match="it looks like m: correct the unit in its header") as caught:
        clouds.load(nifti_of(tmp_path / "a.nii.gz", millimetres=False), units="m")
    assert "units=" not in str(caught.value)


@pytest.mark.parametrize("labels", ["12", 12, np.int64(12), ["12"], (12,), [np.uint8(12)]])
def test_a_label_by_itself_and_a_number_are_labels(labels):
    assert ReadOptions(labels=labels) == ReadOptions(labels=("12",))


@pytest.mark.parametrize(("made", "said"), [
    *[(lambda labels=labels: ReadOptions(labels=labels), "expected labels that are names or whole numbers")
      for labels in (None, 1.5, [None], ["a", 2.0], [["a"]])],
    (lambda: clouds.load(np.eye(3) * 100.0, options={"axes": "ras"}),
     r"options as ReadOptions; got dict; pass ReadOptions\("),
])  # fmt: skip
def test_options_of_another_kind_are_refused(made, said):
    with pytest.raises(ConfigError, match=said):
        made()


@pytest.mark.parametrize("ending", [".nii.gz", ".nrrd", ".mha"])
def test_a_label_map_counts_as_many_bytes_as_it_unpacks_to(tmp_path, monkeypatch, ending):
    affine, size = affine_of((1.5, 1.5, 1.5))
    voxels = voxels_of(affine, size).astype(np.uint8)
    path = write(tmp_path / f"a{ending}", voxels, affine)
    monkeypatch.setenv("GAPR_MAX_UNPACKED_MB", str(1.1 * voxels.nbytes / (1 << 20)))
    assert len(clouds.load(path).points)
    monkeypatch.setenv("GAPR_MAX_UNPACKED_MB", str(0.9 * voxels.nbytes / (1 << 20)))
    with pytest.raises(InvalidPointCloudError, match="GAPR_MAX_UNPACKED_MB"):
        clouds.load(path)


def test_a_reader_that_dies_takes_nobody_along(tmp_path, monkeypatch):
    from gapr_core.runtime import child

    affine, size = affine_of((3.0, 3.0, 3.0))
    path = write(tmp_path / "a.nrrd", voxels_of(affine, size), affine)
    monkeypatch.setattr(child.sys, "executable", "/bin/false")
    with pytest.raises(InvalidPointCloudError, match="its reader ended with 1"):
        clouds.load(path)


def test_names_of_patients_stay_in_their_file(tmp_path, caplog):
    caplog.set_level(logging.DEBUG)
    path = dicom_seg(tmp_path)
    with pytest.raises(InvalidPointCloudError) as caught:
        clouds.load(path, options=options("skull"))
    clouds.load(path, options=options("femur"))
    said = f"{caught.value} {caplog.text}"
    assert "Doe" not in said and not re.search(r"\b0815\b", said)  # a random UID may have these digits in a row


def test_a_header_with_a_document_type_has_no_names(tmp_path):
    (tmp_path / "a.nii.gz").write_bytes(gzip.compress(b"<CaretExtension><!DOCTYPE a></CaretExtension>"))
    assert nifti.label_names(tmp_path / "a.nii.gz") == {}
