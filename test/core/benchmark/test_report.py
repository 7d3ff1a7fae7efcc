"""Pages and pictures."""

import re

import numpy as np
import pytest
from PIL import Image

from gapr_core.clouds import Surface
from gapr_core.evaluation.poster import save_poster
from gapr_core.evaluation.report import Report, Step, alignment_figure, timeline_figure

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
