"""Numbers that are none in a recording are named, and no command ends with a traceback."""

import numpy as np
import pytest
from recordings import TIP, igs, ndi_csv, turned_poses

from gapr_core import clouds
from gapr_core.cli import main
from gapr_core.errors import InvalidPointCloudError
from gapr_core.formats import reading, tracker
from gapr_core.formats.options import ReadOptions
from gapr_core.formats.poses import poses_in

NO_NUMBERS = ["nan", "1e400", "-inf", "1e300", "-3.697314E+028"]


def damaged(path, column, value, lost=()):
    """The recording of a pivot with another value in the fifth pose, which is row 6 of the file."""
    rows = ndi_csv(path, turned_poses(), lost).read_text().splitlines()
    words, names = rows[5].split(","), rows[0].split(",")
    words[names.index(column)] = value
    path.write_text("\n".join([*rows[:5], ",".join(words), *rows[6:]]) + "\n")
    return path


@pytest.mark.parametrize("column", ["Tx", "Tz", "Q0", "Qz"])
@pytest.mark.parametrize("value", NO_NUMBERS)
def test_a_number_that_is_none_in_a_recording_is_named_with_its_row(tmp_path, capsys, column, value):
    path = damaged(tmp_path / "a.csv", column, value)
    assert main(["pivot", str(path)]) == 1
    said = capsys.readouterr().err
    assert f"expected poses of finite numbers up to 1e+06 mm; got a.csv with {value} in row 6; take that row" in said
    assert said.count("\n") == 1
    with pytest.raises(InvalidPointCloudError, match="in row 6"):
        reading.read(path, ReadOptions(tip_mm=tuple(TIP)))


def test_a_number_that_is_none_in_a_row_without_the_tool_is_not_looked_at(tmp_path):
    path = damaged(tmp_path / "a.csv", "Tx", "nan", lost={4})
    assert len(poses_in(path)) == 39 and main(["pivot", str(path)]) == 0


def test_a_row_that_ends_before_its_pose_is_named(tmp_path):
    path = ndi_csv(tmp_path / "a.csv", turned_poses())
    rows = path.read_text().splitlines()
    path.write_text("\n".join([*rows[:7], rows[7].rsplit(",", 4)[0], *rows[8:]]) + "\n")
    with pytest.raises(InvalidPointCloudError, match="a.csv .row 8 ends before its pose"):
        poses_in(path)


@pytest.mark.parametrize("value", [float(value) for value in NO_NUMBERS])
def test_a_pivot_is_not_computed_of_numbers_that_are_none(tmp_path, capsys, value):
    poses = turned_poses()
    poses[4, 0, 3] = poses[7, 1, 3] = value
    with pytest.raises(InvalidPointCloudError, match="up to 1e.06 mm; got 2 of 40 that are not"):
        tracker.pivot(poses)
    assert main(["pivot", str(igs(tmp_path / "a.igs.mha", poses, ["OK"] * 40))]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_a_pivot_far_from_the_tracker_is_found():
    poses = turned_poses()
    poses[:, :3, 3] += [0.0, 0.0, -9e5]
    np.testing.assert_allclose(tracker.pivot(poses).tip_mm, TIP, atol=1e-3)


@pytest.mark.parametrize("units", ["mm", "cm", "m", "auto"])
def test_a_recording_is_in_mm_whatever_is_named(tmp_path, units):
    path = ndi_csv(tmp_path / "a.csv", turned_poses(), ())
    origin = ReadOptions(tip_mm=(0.0, 0.0, 0.0))  # of the tool, which turns about its tip
    np.testing.assert_array_equal(clouds.load(path, units, origin).points, reading.read(path, origin).points)
