"""From a CT mask to files that other tools read the right way round."""

import itertools
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapr_core import clouds
from gapr_core.cli import main
from gapr_core.data.masks import mask_of
from gapr_core.errors import ConfigError, InvalidPointCloudError
from gapr_core.formats import markups, planning, scene, transforms
from gapr_core.geometry import se3
from gapr_core.results import RegistrationResult, RegistrationStatus, Residuals, TargetError
from gapr_core.runtime import child

sitk = pytest.importorskip("SimpleITK", reason="reference: pip install SimpleITK")

T = se3.from_rotation_translation(Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix(), [10.0, -70.0, 200.0])
POINTS = np.random.default_rng(0).uniform(-100.0, 100.0, (20, 3))


@pytest.mark.parametrize("ending", ["tfm", "h5"])
def test_a_written_transform_maps_target_points_to_the_source_in_itk(tmp_path, ending):
    transforms.write(tmp_path / f"pose.{ending}", T)
    read = sitk.ReadTransform(str(tmp_path / f"pose.{ending}"))
    for point, moved in zip(POINTS, se3.apply(T, POINTS), strict=True):
        np.testing.assert_allclose(read.TransformPoint(moved.tolist()), point, atol=1e-9)
        np.testing.assert_allclose(read.GetInverse().TransformPoint(point.tolist()), moved, atol=1e-9)


def test_a_matrix_as_text_is_the_pose_itself(tmp_path):
    transforms.write(tmp_path / "pose.txt", T)
    assert np.array_equal(np.loadtxt(tmp_path / "pose.txt"), T)
    with pytest.raises(ConfigError, match=".tfm .h5 .txt"):
        transforms.write(tmp_path / "pose.mat", T)


@pytest.mark.parametrize("name", ["pose.TFM", "pose.H5", "pose.Tfm"])
def test_an_ending_in_capitals_that_itk_does_not_read_is_refused_before_the_work(tmp_path, capsys, name):
    np.save(tmp_path / "a.npy", POINTS)
    files = ["--source", str(tmp_path / "a.npy"), "--target", str(tmp_path / "a.npy"), "--method", "gapr_search"]
    assert main(["register", *files, "--out", str(tmp_path / name)]) == 1
    assert f"got {name}; write the ending in small letters" in capsys.readouterr().err


def test_transforms_about_a_centre_and_composed_ones_are_read_as_a_start(tmp_path):
    """As elastix and 3D Slicer write them."""
    euler = sitk.Euler3DTransform((30.0, -40.0, 50.0), 0.3, -0.2, 0.9, (5.0, 6.0, -7.0))
    both = sitk.CompositeTransform([euler, sitk.TranslationTransform(3, (1.0, 2.0, 3.0))])
    for transform, name in ((euler, "a.tfm"), (both, "b.tfm"), (both, "c.h5")):
        sitk.WriteTransform(transform, str(tmp_path / name))
        moved = [transform.TransformPoint(point.tolist()) for point in POINTS]
        np.testing.assert_allclose(se3.apply(transforms.read(tmp_path / name), moved), POINTS, atol=1e-6)


def test_a_start_that_is_cut_is_refused(tmp_path):
    """ITK takes the parameters that are there, and accepted an Euler transform of three."""
    euler = sitk.Euler3DTransform((30.0, -40.0, 50.0), 0.3, -0.2, 0.9, (5.0, 6.0, -7.0))
    both = sitk.CompositeTransform([euler, sitk.TranslationTransform(3, (1.0, 2.0, 3.0))])
    for transform, cuts in ((euler, ("6 -7", " 5 6", "FixedP", "-40 50")), (both, ("#Transform 1", "2 3\n", "FixedP"))):
        sitk.WriteTransform(transform, str(tmp_path / "whole.tfm"))
        text = (tmp_path / "whole.tfm").read_text()
        for cut in cuts:
            (tmp_path / "cut.tfm").write_text(text[: text.rindex(cut)])
            with pytest.raises(ConfigError, match="an ITK transform; got cut.tfm, which ITK cannot read"):
                transforms.read(tmp_path / "cut.tfm")


def test_a_start_that_is_no_rigid_motion_is_refused_by_its_name(tmp_path):
    sitk.WriteTransform(sitk.ScaleTransform(3, (1.1, 1.0, 1.0)), str(tmp_path / "scaled.tfm"))
    sitk.WriteTransform(sitk.BSplineTransform(3), str(tmp_path / "bent.tfm"))
    sitk.WriteTransform(sitk.Euler2DTransform(), str(tmp_path / "flat.tfm"))
    (tmp_path / "damaged.tfm").write_text("#Insight Transform File V1.0\nTransform: Aff")
    (tmp_path / "itk.txt").write_text("#Insight Transform File V1.0\nTransform: AffineTransform_double_3_3\n")
    np.savetxt(tmp_path / "three.txt", T[:3])
    np.savetxt(tmp_path / "nan.txt", T * np.nan)
    for name, said in {
        "scaled.tfm": "scaled.tfm whose rotation part has determinant", "bent.tfm": "linear transform in 3-D",
        "flat.tfm": "linear transform in 3-D", "damaged.tfm": "which ITK cannot read", "itk.txt": "rename an ITK",
        "three.txt": "with 3 by 4", "nan.txt": "not finite", "none.tfm": "a file that exists", "a.mat": ".tfm .h5 .txt",
    }.items():  # fmt: skip
        with pytest.raises(ConfigError, match=said):
            transforms.read(tmp_path / name)


def test_a_start_as_text_may_begin_with_a_byte_order_mark_and_is_refused_for_its_commas(tmp_path):
    np.savetxt(tmp_path / "pose.txt", T, header="source to target")
    content = (tmp_path / "pose.txt").read_text()
    (tmp_path / "mark.txt").write_text("\ufeff" + content, encoding="utf-8")
    np.testing.assert_allclose(transforms.read(tmp_path / "mark.txt"), T, atol=1e-9)
    for name, commas in (("between.txt", content.replace(" ", ", ")), ("decimal.txt", content.replace(".", ","))):
        (tmp_path / name).write_text(commas)
        with pytest.raises(ConfigError, match=f"four lines of four numbers; got {name} with commas; put spaces betwee"):
            transforms.read(tmp_path / name)


def test_a_damaged_start_is_refused_in_one_line(tmp_path):
    """HDF5 writes lines of its own, which Python does not see."""
    transforms.write(tmp_path / "pose.h5", T)
    data = (tmp_path / "pose.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(data[: len(data) // 2])
    np.save(tmp_path / "a.npy", POINTS)
    files = ["--source", "a.npy", "--target", "a.npy", "--method", "gapr_search", "--initial", "cut.h5"]
    command = [sys.executable, "-m", "gapr_core.cli", "register", *files]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(child.PACKAGES), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "cut.h5, which ITK cannot read" in done.stderr


def voxelised(surface, spacing, turn, flip):
    """The image of a closed mesh on an oblique grid."""
    mask, affine = mask_of(surface, spacing, Rotation.from_rotvec(turn).as_matrix() @ np.diag(flip))
    size = np.linalg.norm(affine[:3, :3], axis=0)
    image = sitk.GetImageFromArray(mask)
    image.SetSpacing(size.tolist())
    image.SetDirection((affine[:3, :3] / size).ravel().tolist())
    image.SetOrigin(affine[:3, 3].tolist())
    return image


GRIDS = [
    ((2.0, 2.0, 2.0), (0.0, 0.0, 0.0), (-1, -1, 1), "nii.gz", False),
    ((1.0, 1.4, 3.0), (0.2, -0.3, 0.5), (1, 1, -1), "nrrd", True),
]
SPACINGS = [(0.5, 0.5, 0.5), (1.0, 1.0, 1.0), (2.0, 2.0, 2.0), (3.0, 3.0, 3.0), (1.0, 1.4, 3.0)]
PLACES = [((0.0, 0.0, 0.0), (1, 1, 1)), ((0.2, -0.3, 0.5), (1, 1, 1)), ((0.1, 0.6, 0.0), (-1, 1, 1))]
ENDINGS = ["nii.gz", "nrrd", "mha"]
LONG = [  # every spacing in every place; every format on every spacing and on every place; both sides
    (spacing, turn, flip, ENDINGS[(i + j) % 3], (i + j) % 2 == 1)
    for i, spacing in enumerate(SPACINGS)
    for j, (turn, flip) in enumerate(PLACES)
]


@pytest.mark.parametrize(
    ("spacing", "turn", "flip", "ending", "mirrored"), GRIDS + [pytest.param(*g, marks=pytest.mark.slow) for g in LONG]
)
def test_a_mask_becomes_a_transform_that_itk_maps_the_right_way_round(
    tmp_path, femur, spacing, turn, flip, ending, mirrored
):
    bone = femur.mirrored() if mirrored else femur
    image = voxelised(bone, np.array(spacing), turn, flip)
    sitk.WriteImage(image * 76, str(tmp_path / f"seg.{ending}"))
    on_bone = bone.sample(6000, np.random.default_rng(1))[0]
    distal = on_bone[on_bone[:, 2] < np.percentile(on_bone[:, 2], 55)]
    source = se3.apply(se3.inverse(T), distal)
    np.save(tmp_path / "source.npy", source)
    command = ["register", "--source", str(tmp_path / "source.npy"), "--target", str(tmp_path / f"seg.{ending}")]
    command += ["--label", "76", "--method", "gapr_search", "--out", str(tmp_path / "pose.tfm")]
    assert main(command) == 0
    inverse = sitk.ReadTransform(str(tmp_path / "pose.tfm")).GetInverse()
    mapped = np.array([inverse.TransformPoint(point.tolist()) for point in source[::20]])
    off = np.linalg.norm(mapped - distal[::20], axis=1)
    assert off.max() < 0.3 * max(spacing) + 0.5, off.max()


def test_a_source_in_a_label_map_has_a_label_of_its_own(tmp_path, femur, capsys):
    """As the bone of an intra-operative scan, next to metal."""
    image = voxelised(femur, np.array([2.0, 2.0, 2.0]), (0.0, 0.0, 0.0), (1, 1, 1))
    sitk.WriteImage(image * 76, str(tmp_path / "ct.nii.gz"))
    voxels = sitk.GetArrayFromImage(image)
    voxels[voxels.shape[0] // 2 :] = 0
    voxels[:4, :4, :4] = 2
    part = sitk.GetImageFromArray(voxels)
    part.CopyInformation(image)
    for key, value in {"Segment0_Name": "Bone", "Segment1_Name": "Metal"}.items():
        part.SetMetaData(key, value)
        part.SetMetaData(key.replace("Name", "LabelValue"), str(int(key[7]) + 1))
    sitk.WriteImage(part, str(tmp_path / "scan.seg.nrrd"))
    command = ["register", "--source", str(tmp_path / "scan.seg.nrrd"), "--target", str(tmp_path / "ct.nii.gz")]
    command += ["--method", "gapr_search", "--label", "76", "--out", str(tmp_path / "pose.txt")]
    assert main(command) == 1
    assert "(Bone, Metal); name one: --label (--source-label of the source)" in capsys.readouterr().err
    assert main([*command, "--source-label", "bone"]) == 0
    np.testing.assert_allclose(np.loadtxt(tmp_path / "pose.txt"), np.eye(4), atol=0.5)


HIP = TargetError("hip", (1.0, 2.0, 3.0), 0.5, 0.9)


def result_with(covariance=None, residuals=None):
    centre, status = np.array([5.0, 0.0, 0.0]), RegistrationStatus.OK
    return RegistrationResult(status, T, covariance, 0.99, 0.5, 1.0, 0.9, centre_mm=centre, residuals=residuals)


def test_the_error_at_a_target_grows_with_its_distance_from_the_pose_centre():
    covariance = np.diag([0.04, 0.01, 0.01, 1e-4, 4e-4, 9e-4])
    plan = np.array([[5.0, 0.0, 0.0], [105.0, 0.0, 0.0], [5.0, 100.0, 0.0]])
    at = {error.label: error for error in result_with(covariance).errors_at(plan, ("c", "x", "y"))}
    assert at["c"].expected_mm == pytest.approx(np.sqrt(0.06))
    assert at["x"].expected_mm == pytest.approx(np.sqrt(0.06 + 1e4 * (4e-4 + 9e-4)))
    assert at["y"].expected_mm == pytest.approx(np.sqrt(0.06 + 1e4 * (1e-4 + 9e-4)))


def test_95_of_100_poses_stay_below_the_bound_at_a_target():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6)) * np.array([0.3, 0.3, 0.3, 0.003, 0.003, 0.003])[:, None]
    covariance, target = root @ root.T, np.array([[80.0, -30.0, 40.0]])
    bound = result_with(covariance).errors_at(target)[0].bound95_mm
    twists = rng.multivariate_normal(np.zeros(6), covariance, size=4000)
    off = [np.linalg.norm(se3.apply(se3.exp(twist, [5.0, 0.0, 0.0]), target) - target) for twist in twists]
    assert np.mean(np.array(off) < bound) == pytest.approx(0.95, abs=0.015)


def test_the_bound_at_a_target_is_the_assessment_s_own(registrar, target, femur):
    """With what was learned from errors of known size (`factor95`): without, it is too small by a fifth."""
    source = femur.sample(3000, np.random.default_rng(5))[0]
    assessment, result = registrar.assess(source, target), registrar.register(source, target)
    for point in target.points[::4000]:
        bound_mm = result.errors_at(point)[0].bound95_mm
        assert bound_mm == pytest.approx(assessment.bound_mm(point[None]), rel=0.05)
    assert result.factor95 > 1.1


@pytest.mark.parametrize(("names", "order", "said"), [
    (("c", "a", "d", "b"), [2, 0, 3, 1], ""), (("D", "b", "A ", "c"), [3, 1, 0, 2], ""),  # by name
    (("1", "2", "3", "4"), [0, 1, 2, 3], ""), (("1", "2", "", ""), [0, 1, 2, 3], ""),  # in their order
    (("d", "b", "apex", "c"), [0, 1, 2, 3], "have 3 of 4 names in common"),
    (("d", "b", "b", "c"), [0, 1, 2, 3], "have 3 of 4 names in common"),
])  # fmt: skip
def test_landmarks_are_paired_by_name_and_else_in_their_order(tmp_path, caplog, names, order, said):
    points = np.array([[0.0, 0, 0], [50, 0, 0], [0, 30, 0], [0, 0, 20]])
    markups.save(tmp_path / "s.mrk.json", markups.Markups(points, ("a", "b", "c", "d")))
    markups.save(tmp_path / "t.mrk.json", markups.Markups(se3.apply(T, points)[order], names))
    start = planning.start_of(tmp_path / "s.mrk.json", tmp_path / "t.mrk.json")
    np.testing.assert_allclose(start.T_target_source, T, atol=1e-9)
    assert [said in message for message in caplog.messages] == [True] * bool(said)
    markups.save(tmp_path / "t.mrk.json", markups.Markups(points[:3], ("1", "2", "3")))
    with pytest.raises(InvalidPointCloudError, match="4 in s.mrk.json and 3 in t.mrk.json"):
        planning.start_of(tmp_path / "s.mrk.json", tmp_path / "t.mrk.json")


def residuals():
    return Residuals(
        POINTS, np.r_[[-3.0, 0.0, 3.0, np.nan], np.zeros(16)], np.r_[[True, True, False, False], [True] * 16]
    )


def test_residuals_are_written_as_json_and_as_colours(tmp_path):
    from plyfile import PlyData

    content = json.loads(json.dumps(scene.residuals_json(residuals())))
    assert content["distance_mm"][:4] == [-3.0, 0.0, 3.0, None] and content["inlier"][:3] == [True, True, False]
    scene.write_coloured(tmp_path / "a.ply", POINTS, residuals())
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    colours = np.stack([rows[c] for c in ("red", "green", "blue")], axis=1)[:4].tolist()
    assert colours == [[0, 0, 255], [255, 255, 255], [255, 0, 0], [150, 150, 150]]
    np.testing.assert_allclose(clouds.load(tmp_path / "a.ply").points, POINTS, atol=1e-4)


def test_a_scene_for_slicer_names_files_that_exist_and_nodes_that_refer_to_each_other(tmp_path, femur):
    result = replace(result_with(np.eye(6), residuals()), bone=femur, targets=(HIP,))
    (tmp_path / "mine.txt").write_text("stays")
    scene.write_slicer(tmp_path, result)
    nodes = list(ElementTree.parse(tmp_path / "scene.mrml").getroot())
    names = {node.get("id") for node in nodes}
    for node in nodes:
        if node.get("fileName"):
            assert (tmp_path / node.get("fileName")).is_file()
        for key in ("storageNodeRef", "displayNodeRef", "transformNodeRef"):
            assert node.get(key) is None or node.get(key) in names
    assert sum(node.get("transformNodeRef") is not None for node in nodes) == 2
    of_targets = {node.get("name"): node.tag for node in nodes if node.get("name", "").startswith("targets")}
    assert of_targets == {  # a MarkupsFiducialStorage reads every line of a .mrk.json as a point, and reports success
        "targets display": "MarkupsFiducialDisplay",
        "targets storage": "MarkupsJsonStorage",
        "targets": "MarkupsFiducial",
    }
    np.testing.assert_allclose(clouds.load(tmp_path / "target.vtk").points, femur.points, atol=1e-3)
    near = np.isfinite(residuals().distance_mm)
    np.testing.assert_allclose(clouds.load(tmp_path / "source.vtk").points, POINTS[near], atol=1e-3)
    assert "0.50 mm" in (tmp_path / "targets.mrk.json").read_text() and (tmp_path / "mine.txt").read_text() == "stays"


def test_points_without_a_surface_near_are_grey_in_a_scene_and_not_on_the_bone(tmp_path, femur):
    scene.write_slicer(tmp_path, replace(result_with(np.eye(6), residuals()), bone=femur))
    shown = (tmp_path / "source.vtk").read_text().split("LOOKUP_TABLE default\n")[1].split()
    assert [float(distance) for distance in shown] == [-3.0, 0.0, 3.0] + [0.0] * 16
    off = clouds.load(tmp_path / "off_bone.vtk", of_bone=False)
    np.testing.assert_allclose(off.points, POINTS[3:4], atol=1e-3)
    assert "SCALARS" not in (tmp_path / "off_bone.vtk").read_text()
    display = ElementTree.parse(tmp_path / "scene.mrml").find(".//ModelDisplay[@name='off_bone display']")
    assert len(set(display.get("color").split())) == 1 and display.get("scalarVisibility") is None
    near = Residuals(POINTS, np.zeros(20), np.ones(20, dtype=bool))
    scene.write_slicer(tmp_path, replace(result_with(np.eye(6), near), bone=femur))
    assert "off_bone" not in (tmp_path / "scene.mrml").read_text()
    assert not (tmp_path / "off_bone.vtk").exists()


def test_targets_of_an_earlier_run_do_not_stay_in_the_folder_of_a_scene(tmp_path, femur):
    result = replace(result_with(np.eye(6), residuals()), bone=femur)
    scene.write_slicer(tmp_path, replace(result, targets=(HIP,)))
    scene.write_slicer(tmp_path, result)
    assert not (tmp_path / "targets.mrk.json").exists()
    assert "targets" not in (tmp_path / "scene.mrml").read_text()


def test_a_scene_that_is_killed_at_any_step_is_of_one_run_alone(tmp_path, femur):
    moved = replace(femur, points=femur.points + 100.0)
    runs = [(femur, np.eye(4)), (moved, se3.from_rotation_translation(np.eye(3), [100.0, 0.0, 0.0]))]
    made = []
    for number, (bone, T) in enumerate(runs):
        result = replace(result_with(np.eye(6), residuals()), T_target_source=T, bone=bone)
        scene.write_slicer(tmp_path / str(number), result)
        made.append({path.name: path.read_bytes() for path in (tmp_path / str(number)).iterdir()})
    finished = False
    for steps in itertools.count():
        folder = tmp_path / f"killed {steps}"
        shutil.copytree(tmp_path / "0", folder)
        if (child := os.fork()) == 0:
            kill_after(steps)
            scene.write_slicer(folder, result)
            os._exit(0)
        if os.waitpid(child, 0)[1] == 0:
            break
        left = {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.startswith(".")}
        assert any(left.items() <= whole.items() for whole in made), steps
        finished |= left != made[0]
    assert steps > 10 and finished


def kill_after(steps):
    """End this process before the step of this number that changes a name in a folder."""
    left = itertools.repeat(None, steps)

    def dying(change):
        def step(*arguments, **options):
            if next(left, "over") == "over":
                os._exit(9)
            return change(*arguments, **options)

        return step

    os.replace, Path.unlink = dying(os.replace), dying(Path.unlink)


def test_a_refused_registration_removes_what_contradicts_it_and_says_so(tmp_path, femur, capsys):
    """An old pose beside a new refusal passed for its answer."""
    np.save(tmp_path / "few.npy", femur.points[:40] - femur.points[0])
    np.savez(tmp_path / "bone.npz", points=femur.points, faces=femur.faces)
    names = {"--out": "pose.tfm", "--residuals": "r.json", "--slicer": "scene", "--json": "new.json"}
    (tmp_path / "scene").mkdir()
    scene.files.write_text(tmp_path / "scene" / "scene.mrml", scene._mrml(False, False))
    for name in ("pose.tfm", "r.json", "scene/pose.tfm", "scene/mine.txt"):
        (tmp_path / name).write_text("old")
    line = [str(word) for option, name in names.items() for word in (option, tmp_path / name)]
    line += ["--source", str(tmp_path / "few.npy"), "--target", str(tmp_path / "bone.npz"), "--method", "gapr_search"]
    assert main(["register", *line]) == 2
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {"few.npy", "bone.npz", "new.json", "scene/mine.txt"}
    assert capsys.readouterr().out.count("is not written, and that of an earlier run is removed") == 3


def test_gapr_pivot_prints_what_register_takes(tmp_path, capsys):
    rng = np.random.default_rng(0)
    rows = ["State,Q0,Qx,Qy,Qz,Tx,Ty,Tz"]
    for rotation in Rotation.from_rotvec(rng.normal(0.0, 0.4, (30, 3))):
        x, y, z, w = rotation.as_quat()
        rows.append(",".join(map(str, ["OK", w, x, y, z, *(-rotation.apply([1.0, 2.0, 150.0]))])))
    (tmp_path / "pivot.csv").write_text("\n".join(rows) + "\n")
    assert main(["pivot", str(tmp_path / "pivot.csv"), "--json", str(tmp_path / "tip.json")]) == 0
    assert "--tip 1.000,2.000,150.000" in capsys.readouterr().out
    assert json.loads((tmp_path / "tip.json").read_text())["poses"] == 30
    assert main(["pivot", str(tmp_path / "none.csv")]) == 1
    before = (tmp_path / "pivot.csv").read_bytes()
    capsys.readouterr()
    for name, said in (("pivot.csv", "which belongs to the recording"), (".", "a folder")):
        assert main(["pivot", str(tmp_path / "pivot.csv"), "--json", str(tmp_path / name)]) == 1
        shown = capsys.readouterr()
        assert said in shown.err and "--tip" not in shown.out  # before the work
    assert (tmp_path / "pivot.csv").read_bytes() == before


def test_a_tip_that_begins_with_a_minus_can_be_pasted(tmp_path, monkeypatch):
    """What `gapr pivot` prints for half of all tools; argparse took it for an option."""
    from gapr_core.commands import register

    given = []
    monkeypatch.setattr(register, "run", lambda args: given.append((args.tip, args.viewpoint, args.clouds)) or 0)
    line = "register --source a.csv --target b.stl --tip -0.100,-2.000,150.000 --viewpoint -.5,1,2 --clouds -3:"
    assert main([*line.split(), "--json", str(tmp_path / "o.json")]) == 0
    assert given == [((-0.1, -2.0, 150.0), (-0.5, 1.0, 2.0), (-3, None))]
