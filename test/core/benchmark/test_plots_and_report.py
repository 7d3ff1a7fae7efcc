"""Plots show the numbers of the records; the report is one file that a browser shows without a network."""

import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from benchmark_cases import make_pair, ok, record, shifted, some_records

from gapr_core.benchmark import table
from gapr_core.benchmark.records import Plan
from gapr_core.data.pair_files import save_pair
from gapr_core.geometry import se3
from gapr_core.pages import benchmark_report, pictures, plots
from gapr_core.results import RegistrationResult, RegistrationStatus


def curve(figure, label):
    return next(line.get_data() for line in figure.axes[0].lines if line.get_label() == label)


def test_recall_against_threshold_steps_at_the_errors_and_never_counts_a_refusal():
    x, y = curve(plots.recall_against_threshold(some_records(), ["a", "b"]), "a")
    assert y[x < 0.49].max() == 0.0
    assert y[(x > 0.51) & (x < 29)] == pytest.approx(1 / 3)
    assert y[-2] == pytest.approx(1 / 3)
    assert y[-1] == pytest.approx(2 / 3)  # the third is exactly 30 mm off, the second was refused
    assert curve(plots.recall_against_threshold(some_records(), ["a", "b"]), "b")[1][-1] == 1.0


def test_a_refusal_is_within_no_limit_though_its_stand_in_is_on_the_truth():
    """Centroid on centroid is where it belongs; without an answer that is no success."""
    pair = make_pair(0)
    on_centroid = pair.source - pair.source.mean(axis=0) + pair.target.mean(axis=0)
    aligned = replace(pair, source=on_centroid, T_target_source=np.eye(4))
    found = record(aligned, RegistrationResult(RegistrationStatus.LOW_CONFIDENCE))
    assert found.rte_mm < 1e-6 and found.rre_deg < 1e-6
    assert curve(plots.recall_against_threshold([found], ["m"]), "m")[1].max() == 0.0


def test_a_turn_counts_from_the_limit_on_at_which_an_angle_of_it_is_let_pass():
    """4 degrees without a shift: 1.25 degrees go with every mm, so from 3.2 mm on."""
    pair = make_pair(0)
    centre = pair.source.mean(axis=0)
    turn = se3.exp([0.0, 0.0, 0.0, 0.0, 0.0, np.radians(4.0)], se3.apply(pair.T_target_source, centre[None])[0])
    found = record(pair, ok(turn @ pair.T_target_source))
    assert found.rte_mm < 1e-6 and found.rre_deg == pytest.approx(4.0)
    x, y = curve(plots.recall_against_threshold([found], ["m"]), "m")
    assert y.tolist() == (x >= 4.0 / 1.25).astype(float).tolist()


def test_recall_against_overlap_has_one_dot_per_value_and_none_without_variation():
    x, y = curve(plots.recall_against(some_records(), ["a", "b"], "overlap", "overlap"), "a")
    assert x == pytest.approx([0.1, 0.15, 0.2]) and y.tolist() == [1.0, 0.0, 0.0]
    assert plots.recall_against(some_records(), ["a", "b"], "noise_mm", "noise") is None


def test_values_that_round_up_stay_in_a_bin_of_their_own():
    found = [record(pair, ok(shifted(pair, 1.0 if k < 4 else 90.0))) for k, pair in enumerate(map(make_pair, range(8)))]
    found = [replace(r, noise_mm=(1 if k < 4 else 2) / 3) for k, r in enumerate(found)]
    x, y = curve(plots.recall_against(found, ["m"], "noise_mm", "noise"), "m")
    assert x == pytest.approx([1 / 3, 2 / 3]) and y.tolist() == [1.0, 0.0]


def test_many_values_are_put_in_at_most_six_bins():
    found = [record(pair, ok(shifted(pair, 1.0))) for pair in map(make_pair, range(40))]
    x, y = curve(plots.recall_against(found, ["m"], "overlap", "overlap"), "m")
    assert 3 <= len(x) <= 6 and np.all(y == 1.0)


def test_the_risk_curve_ends_at_the_share_of_pairs_that_were_answered():
    coverage, risk = curve(plots.risk_coverage(some_records(), ["a"]), "a")
    assert coverage[-1] == 0.5 and risk[-1] == 0.5
    assert risk[0] == 1.0  # the most confident answer was wrong


def test_the_ellipse_found_is_that_of_the_errors():
    found = []
    for k in range(12):
        pair = make_pair(k)
        found.append(record(pair, ok(shifted(pair, (-1) ** k * 1.0), covariance=np.eye(6) * 0.25)))
    figure = plots.error_ellipsoids(found, "m")
    labels = {patch.get_label() for patch in figure.axes[0].patches}
    assert labels == {"errors found", "mean predicted", "mean Cramer-Rao bound"}
    assert figure.axes[0].collections[0].get_offsets().shape == (12, 2)
    predicted = next(p for p in figure.axes[0].patches if p.get_label() == "mean predicted")
    assert predicted.get_width() == pytest.approx(2 * np.sqrt(5.991 * 0.25))
    assert plots.error_ellipsoids(found[:2], "m") is None


def test_errors_are_drawn_along_the_axes_of_the_bone_with_their_mean_in_the_ellipse():
    """Axis 1 of the bone is y, 2 is z, 3 is x; all errors are 2 to 4 mm along y, and that offset is no accuracy."""
    base = record(make_pair(0), ok(shifted(make_pair(0), 1.0)))
    axes, shifts = np.roll(np.eye(3), 1, axis=1).tolist(), np.array([2.0, 3.0, 4.0])
    found = [replace(base, axes=axes, twist=[0.0, y, 0.1, 0.0, 0.0, 0.0], bound_covariance=None) for y in shifts]
    first = plots.error_ellipsoids(found, "m").axes[0]
    np.testing.assert_allclose(first.collections[0].get_offsets(), [[y, 0.1] for y in shifts])
    (ellipse,) = first.patches
    second_moments = [[np.mean(shifts**2), 0.1 * np.mean(shifts)], [0.1 * np.mean(shifts), 0.01]]
    longest = np.linalg.eigvalsh(second_moments)[-1]
    assert max(ellipse.get_width(), ellipse.get_height()) == pytest.approx(2.0 * np.sqrt(5.991 * longest))


def test_lines_that_lie_on_each_other_have_other_dashes():
    records = some_records()
    lines = plots.recall_against_threshold(records, ["a", "b"]).axes[0].lines
    assert len({line.get_linestyle() for line in lines if line.get_label() in ("a", "b")}) == 2


def test_the_worst_cases_begin_with_the_most_confident_false_accept():
    worst = pictures.worst(some_records(), "a")
    assert [r.accepted for r in worst] == [True, False, True]
    assert worst[0].false_accept and worst[0].confidence == 0.95
    assert "FALSE ACCEPT" in pictures.caption(worst[0]) and "refused" in pictures.caption(worst[1])
    assert pictures.worst(some_records(), "b")[0].protocol == "wrong"


def test_of_two_false_accepts_the_more_confident_one_is_worse_though_it_is_nearer():
    pairs = [make_pair(k) for k in range(2)]
    far, near = record(pairs[0], ok(shifted(pairs[0], 90.0), 0.6)), record(pairs[1], ok(shifted(pairs[1], 10.0), 0.95))
    assert [r.pair for r in pictures.worst([far, near], "m")] == [near.pair, far.pair]


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    pairs = [*map(make_pair, range(3)), make_pair(7, "wrong")]
    for pair in pairs[:3]:
        save_pair(folder / f"{pair.name}.npz", pair)
    plan = Plan(
        ours="a", methods=["a", "b"], folder=str(folder), pairs={p.name: "0" for p in pairs},
        command="gapr benchmark <&>", started="now",
    )  # fmt: skip
    found = some_records()
    refused = record(pairs[3], RegistrationResult(RegistrationStatus.AMBIGUOUS, reason="<b>two</b> poses"), "a")
    found = [*found[:-2], refused, found[-1]]
    apart = table.differences(found, ["a", "b"], "a")
    benchmark_report.write(
        folder, found, table.rows(found, ["a", "b"]), apart, plan, {"commit": "c0ffee"}, ["One <note>."]
    )
    return folder


def test_every_plot_of_the_report_has_its_caption(report):
    text = re.sub(r"data:image/png;base64,[^\"]*", "", (report / "report.html").read_text(encoding="utf-8"))
    plots_of_it = re.findall(r'<figure><img alt="(?:recall|reliab|risk|error)[^>]*><figcaption>([^<]*)<', text)
    assert len(plots_of_it) > 2 and all(plots_of_it)


def test_the_report_needs_nothing_but_itself(report):
    page = (report / "report.html").read_text()
    sources = re.findall(r"(?:src|href)=[\"']([^\"']{0,40})", page)
    assert sources and all(source.startswith("data:image/png;base64,") for source in sources)
    assert "http" not in re.sub(r"base64,[^\"]*", "", page) and "<script" not in page
    assert "One &lt;note&gt;." in page and "gapr benchmark &lt;&amp;&gt;" in page
    assert "c0ffee" in page and "worst 3 cases of a" in page
    assert (report / "plots" / "worst_01.png").stat().st_size > 5000


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="opens the report in a browser: apt install chromium")
def test_a_browser_lays_the_report_out(report, tmp_path):
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
             "--disable-component-update", "--disable-sync", f"--user-data-dir={tmp_path}"]  # fmt: skip
    script = f"file://{report / 'report.html'}"
    dom = subprocess.run(["chromium", *flags, "--dump-dom", script], capture_output=True, text=True, timeout=120).stdout
    assert dom.count("<table>") == 6 and dom.count("<figure>") == 7
    subprocess.run(["chromium", *flags, f"--screenshot={tmp_path / 'page.png'}", script], timeout=120, check=True)
    assert (tmp_path / "page.png").stat().st_size > 20_000
