"""Pages and pictures."""

from io import BytesIO

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image as Image_

from gapr_core.pages import views
from gapr_core.pages.camera_pictures import CameraView, save_scene_poster, views_as_png
from gapr_core.pages.poster import charts_as_png, draw_bone, save_poster
from gapr_core.pages.report import Image, Report
from gapr_core.pages.views import OnBone
from gapr_core.results import Guidance
from gapr_core.surface import Surface

TETRAHEDRON = Surface(
    np.array([[0.0, 0, 0], [40, 0, 0], [0, 40, 0], [0, 0, 40]]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
)


@pytest.fixture
def page(tmp_path):
    report = Report("Femur & <friends>", "one sweep")
    report.verdict("refused", "1 wrong <pose>", ["look at it"])
    report.film([Image(charts_as_png({"confidence": ([0.0, 0.9], 0.5)}, "frame"), "chart", "frame <1>")])
    report.table(["frame", "status"], [["1", "<ambiguous>"]], ["hold"], text=["status"])
    report.write(tmp_path / "page.html")
    return (tmp_path / "page.html").read_text(encoding="utf-8")


def test_names_are_text_and_not_markup(page):
    assert "<h1>Femur &amp; &lt;friends&gt;</h1>" in page
    assert "&lt;ambiguous&gt;" in page
    assert "<ambiguous>" not in page and "<pose>" not in page and "frame &lt;1&gt;" in page


def test_a_poster_shows_the_bone_and_the_points(tmp_path):
    charts = {"confidence": ([0.0, 0.9], 0.5), "error, mm": ([np.nan, 0.4], 4.0)}
    pictures = []
    for points in (np.zeros((0, 3)), np.full((500, 3), 10.0) + np.linspace(0, 5, 500)[:, None]):
        save_poster(tmp_path / "p.png", TETRAHEDRON, points, np.full(len(points), 4.9), "title", charts)
        pictures.append(np.asarray(Image_.open(tmp_path / "p.png").convert("RGB"), dtype=int))
    bare, dotted = pictures
    assert (bare.reshape(-1, 3).max(axis=1) < 250).mean() > 0.05  # not an empty sheet
    assert (np.abs(dotted - bare).max(axis=2) > 50).sum() > 20  # the points are seen


def on(points, distance_mm, **more):
    return OnBone(TETRAHEDRON, np.array(points), np.array(distance_mm), np.zeros((0, 3)), **more)


def pixels(drawn, side="anterior"):
    return np.asarray(Image_.open(BytesIO(views.png(drawn, side))).convert("RGB"), dtype=int).reshape(-1, 3)


@pytest.mark.parametrize(("distance_mm", "is_blue", "is_red"), [(-1.0, True, False), (1.0, False, True)])
def test_points_inside_are_blue_and_outside_red_on_a_scale_of_the_data(distance_mm, is_blue, is_red):
    red, _, blue = pixels(on([[10.0, -1.0, 10.0]] * 2, [distance_mm, distance_mm])).T
    assert ((blue > red + 80).sum() > 20, (red > blue + 80).sum() > 20) == (is_blue, is_red)


def test_the_scale_ends_where_nine_of_ten_points_are():
    assert on(np.zeros((20, 3)), [0.1, -0.25] * 9 + [0.2, 30.0]).scale_mm == 0.3
    assert on(np.zeros((0, 3)), []).scale_mm == 0.1


def test_a_place_behind_the_bone_is_shown_from_the_side_that_sees_it():
    behind = [[10.0, 0.0, 10.0]], [0.0]
    assert on(*behind).sides(1) == ["anterior"]  # the face at y = 0
    assert on([[13.4, 13.4, 13.4]], [0.0]).sides(1)[0] in ("posterior", "left", "superior")  # the slanted one


def test_a_long_bone_lies_and_shows_no_end(femur):
    drawn = OnBone(femur, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
    picture = views.picture_of(drawn, "anterior")
    assert picture.light.shape[1] > 2 * picture.light.shape[0] and drawn.view("anterior").axes[0].tolist() == [0, 0, -1]
    assert set(drawn.sides()) <= {"anterior", "posterior", "left", "right"}


def test_the_gain_of_a_look_is_laid_on_the_nearest_vertices():
    gain = Guidance(TETRAHEDRON.points + 0.01, np.array([0.0, 0.0, 0.0, 5.0]), 0.0, ())
    values = views.picture_of(on(np.zeros((0, 3)), [], gain=gain), "anterior").values
    rows = [row[np.isfinite(row)].mean() for row in values if np.isfinite(row).any()]
    assert rows[0] > 4.5 and rows[-1] < 0.5


def test_a_camera_poster_shows_what_was_taken(tmp_path):
    rng = np.random.default_rng(0)
    cloud = np.column_stack([rng.uniform(-60, 60, (2000, 2)), rng.uniform(440, 450, 2000)])
    seen, taken = cloud[:, 0] > -40, cloud[:, 0] > 20
    views = [CameraView("frame 1", cloud, seen, taken), CameraView("frame 2", cloud, ~seen, ~seen & ~seen & taken)]
    colours = np.asarray(Image_.open(BytesIO(views_as_png(views[:1], 1))).convert("RGB"), dtype=int).reshape(-1, 3)
    red, green, blue = colours.T
    assert ((red > 1.5 * green) & (red > 60)).sum() > 500, "left out"
    assert ((red > 60) & (green > 0.8 * red) & (blue < 0.8 * red)).sum() > 500, "taken for bone"
    charts = {"confidence": ([0.0, 0.9], 0.5)}
    save_scene_poster(
        tmp_path / "p.png", TETRAHEDRON, views, np.array([[1.0, 1, 0], [2, 2, 0.5]]), np.zeros(2), "title", charts
    )
    assert 10_000 < (tmp_path / "p.png").stat().st_size < 300_000


def test_a_poster_shows_the_bone_from_where_the_camera_was():
    spots = []
    for facing in (np.array([0.0, -3.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])):
        figure = Figure()
        draw_bone(figure, TETRAHEDRON, np.array([[40.0, 0.0, 10.0]]), np.zeros(1), facing)
        drawn = [dots.get_offsets() for dots in figure.axes[0].collections]
        spots.append(next(each[0] for each in drawn if len(each)))
    np.testing.assert_allclose(spots, [[40, 10], [0, 10], [-40, 10]], atol=1e-9)
