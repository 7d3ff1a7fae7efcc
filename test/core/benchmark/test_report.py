"""Pages and pictures."""

import re
from io import BytesIO

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from gapr_core.pages.camera_pictures import CameraView, save_scene_poster, views_as_png
from gapr_core.pages.guidance import GuidedStep, gain_at, guidance_figure
from gapr_core.pages.poster import draw_bone, save_poster
from gapr_core.pages.report import Report, Step, alignment_figure, timeline_figure
from gapr_core.surface import Surface

TETRAHEDRON = Surface(
    np.array([[0.0, 0, 0], [40, 0, 0], [0, 40, 0], [0, 0, 40]]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
)
STEPS = [
    Step("1", "refused: too few points", np.zeros((0, 3)), np.zeros(0)),
    Step("2", "OK", np.array([[1.0, 1, 0], [2, 2, 0.5]]), np.array([0.0, 0.5])),
]


@pytest.fixture
def page(tmp_path):
    report = Report("Femur & <friends>", "one sweep")
    report.figure(alignment_figure(TETRAHEDRON, STEPS))
    report.figure(timeline_figure([1, 2], {"confidence": [0.0, 0.9]}, "frame", {"confidence": 0.5}))
    report.table(["frame", "status"], [["1", "<ambiguous>"]], ["hold"], text=["status"])
    report.write(tmp_path / "page.html")
    return (tmp_path / "page.html").read_text(encoding="utf-8")


def test_a_page_asks_nothing_of_the_network(page):
    assert not re.search(r"<(script|link|img|iframe)[^>]+(src|href)\s*=", page)


def test_the_viewer_is_written_into_the_page_once(page):
    assert page.count("plotly.js v") == 1
    assert page.count("Plotly.newPlot(") == 2


def test_names_are_text_and_not_markup(page):
    assert "<h1>Femur &amp; &lt;friends&gt;</h1>" in page
    assert "&lt;ambiguous&gt;" in page
    assert "<ambiguous>" not in page


def test_each_step_of_the_slider_shows_the_bone_and_one_cloud():
    figure = alignment_figure(TETRAHEDRON, STEPS)
    for chosen, step in enumerate(figure.layout.sliders[0].steps):
        visible = step.args[0]["visible"]
        assert visible[0] and [k for k, shown in enumerate(visible[1:]) if shown] == [chosen]
    assert figure.layout.title.text == "OK"  # the last step is shown first


def test_points_keep_their_place_and_their_distance():
    cloud = alignment_figure(TETRAHEDRON, STEPS).data[2]
    np.testing.assert_allclose(np.stack([cloud.x, cloud.y, cloud.z], axis=1), STEPS[1].points)
    np.testing.assert_allclose(cloud.marker.color, STEPS[1].distances_mm)


def test_a_poster_shows_the_bone_and_the_points(tmp_path):
    charts = {"confidence": ([0.0, 0.9], 0.5), "error, mm": ([np.nan, 0.4], 4.0)}
    pictures = []
    for points in (STEPS[0].points, np.full((500, 3), 10.0) + np.linspace(0, 5, 500)[:, None]):
        save_poster(tmp_path / "p.png", TETRAHEDRON, points, np.full(len(points), 4.9), "title", charts)
        pictures.append(np.asarray(Image.open(tmp_path / "p.png").convert("RGB"), dtype=int))
    bare, dotted = pictures
    assert (bare.reshape(-1, 3).max(axis=1) < 250).mean() > 0.05  # not an empty sheet
    assert (np.abs(dotted - bare).max(axis=2) > 50).sum() > 20  # the points are seen


def test_points_that_do_not_count_are_shown_with_their_step():
    steps = [Step("1", "a", np.zeros((1, 3)), np.zeros(1), np.ones((2, 3))), STEPS[1]]
    figure = alignment_figure(TETRAHEDRON, steps)
    for chosen, step in enumerate(figure.layout.sliders[0].steps):
        assert np.flatnonzero(step.args[0]["visible"]).tolist() == [0, 1 + chosen, 3 + chosen]
    assert len(figure.data[3].x) == 2 and len(figure.data[4].x) == 0


def test_the_gain_of_a_look_is_laid_on_the_nearest_vertices():
    at = TETRAHEDRON.points[[0, 1]] + 0.01
    step = GuidedStep("1", "", np.zeros((3, 3)), 1, (at, np.array([2.0, 5.0]), at[1]))
    gain = gain_at(TETRAHEDRON, step)
    assert gain[0] == 2.0 and gain[1] == 5.0
    assert not gain_at(TETRAHEDRON, GuidedStep("2", "", np.zeros((3, 3)), 1, None)).any()


def test_each_look_shows_its_own_bone_its_points_and_the_next_place():
    points = np.arange(9.0).reshape(3, 3)
    advice = (TETRAHEDRON.points, np.arange(4.0), TETRAHEDRON.points[3])
    figure = guidance_figure(TETRAHEDRON, [GuidedStep("1", "a", points[:1], 1, advice),
                                           GuidedStep("2", "b", points, 2, None)])  # fmt: skip
    assert [np.flatnonzero(step.args[0]["visible"]).tolist() for step in figure.layout.sliders[0].steps] == [
        [0, 1, 2, 3], [4, 5, 6, 7],
    ]  # fmt: skip
    assert [len(trace.x) for trace in figure.data] == [4, 0, 1, 1, 4, 1, 2, 0]
    np.testing.assert_allclose(figure.data[0].intensity, [0, 1, 2, 3])
    assert figure.data[0].cmax == 3.0, "the colours end at the best look"


def test_a_camera_poster_shows_what_was_taken(tmp_path):
    rng = np.random.default_rng(0)
    cloud = np.column_stack([rng.uniform(-60, 60, (2000, 2)), rng.uniform(440, 450, 2000)])
    seen, taken = cloud[:, 0] > -40, cloud[:, 0] > 20
    views = [CameraView("frame 1", cloud, seen, taken), CameraView("frame 2", cloud, ~seen, ~seen & ~seen & taken)]
    colours = np.asarray(Image.open(BytesIO(views_as_png(views[:1], 1))).convert("RGB"), dtype=int).reshape(-1, 3)
    red, green, blue = colours.T
    assert ((red > 1.5 * green) & (red > 60)).sum() > 500, "left out"
    assert ((red > 60) & (green > 0.8 * red) & (blue < 0.8 * red)).sum() > 500, "taken for bone"
    charts = {"confidence": ([0.0, 0.9], 0.5)}
    save_scene_poster(tmp_path / "p.png", TETRAHEDRON, views, STEPS[1].points, np.zeros(2), "title", charts)
    assert 10_000 < (tmp_path / "p.png").stat().st_size < 300_000


def test_a_view_begins_from_where_the_camera_was(tmp_path):
    behind = alignment_figure(TETRAHEDRON, STEPS, facing=np.array([0.0, 3.0, 1.0])).layout.scene.camera.eye
    front = alignment_figure(TETRAHEDRON, STEPS).layout.scene.camera.eye
    assert (behind.y, front.y) == (1.2, -1.2) and behind.z == front.z
    spots = []
    for facing in (None, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])):
        figure = Figure()
        draw_bone(figure, TETRAHEDRON, np.array([[40.0, 0.0, 10.0]]), np.zeros(1), facing)
        spots.append(figure.axes[0].collections[0].get_offsets()[0])
    np.testing.assert_allclose(spots, [[40, 10], [0, 10], [-40, 10]], atol=1e-9)
