"""Numbers of the figures on rendered scenes, and what is drawn where."""

import json
import math
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin.evaluation import figures
from geodiff_plugin.evaluation.baselines import Method, NotApplicable, Prediction, Settings
from geodiff_plugin.evaluation.datasets import SampleRef
from geodiff_plugin.evaluation.datasets.sample import make_sample
from geodiff_plugin.evaluation.options import FigureOptions
from tests.tiny import plane_pair
from tests.views import made_rig


@pytest.fixture(scope="module")
def sample():
    """A plane from about 1.4 m to 3.4 m, some of whose ground truth is unknown."""
    pair = plane_pair(rotation_y=0.05)
    depth_m = pair.depth_m.copy()
    depth_m[:5, :9] = 0
    rig = made_rig(pair.K, pair.K, pair.E)
    return make_sample(SampleRef("d", "s", {}), (pair.left, pair.right), rig, depth_m, {})


@pytest.mark.parametrize("space", ["depth", "disparity"])
def test_the_sweep_is_least_at_the_true_scale(sample, space):
    """A map that is right but for its scale has its optimum of loss and error at that scale."""
    full = plane_pair(rotation_y=0.05).depth_m
    factor = 7.3
    half = math.log(2)  # softplus of 0: raw scale and shift of a map that falls with depth
    relative = full / factor if space == "depth" else factor / full / half - 1
    sweep, shown = figures.sweep_g_s(sample, relative, space, 20.0)
    g_s = sweep["g_s_m"]
    assert len(g_s) == 80 and (g_s[0], g_s[-1]) == pytest.approx((1, 20))
    np.testing.assert_allclose(g_s[1:] / g_s[:-1], 20 ** (1 / 79), rtol=1e-5)
    best = {name: g_s[sweep[name].argmin()] for name in ("loss", "abs_rel")}
    assert best["loss"] == pytest.approx(factor, rel=0.08) and best["abs_rel"] == pytest.approx(
        factor, rel=0.03
    )
    np.testing.assert_allclose(sweep["abs_rel"], np.abs(g_s / factor - 1), atol=0.03)
    assert (sweep["visible"] > 0).all() and (sweep["visible"] <= 1).all()
    assert sweep["visible"][sweep["loss"].argmin()] > 0.8 > sweep["visible"][0]
    at = int(sweep["loss"].argmin())
    assert (
        len(shown) == 4
        and {at, int(sweep["abs_rel"].argmin()), 79} <= set(shown)
        and list(shown) == sorted(shown)
    )
    rendered = shown[at][12:-12, 16:-16], sample.left[12:-12, 16:-16] / 255
    assert (
        np.abs(np.subtract(*rendered)).mean() < 0.05 < np.abs(shown[79][12:-12, 16:-16] - rendered[1]).mean()
    )


def test_the_orbit_looks_at_its_centre_from_the_left_and_above():
    T = figures.orbit(3.0)
    np.testing.assert_allclose(T @ [0, 0, 3, 1], [0, 0, 3, 1], atol=1e-12)
    place = np.linalg.inv(T)[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(place - [0, 0, 3]), 3)
    assert place[0] < -0.5 and place[1] < -0.2  # x is right and y is down
    expected = Rotation.from_euler("yx", [-25, 12], degrees=True).as_matrix()
    np.testing.assert_allclose(T[:3, :3], expected, atol=1e-12)


def test_a_cloud_is_seen_by_the_other_camera_and_white_elsewhere(sample):
    depth_m = np.full((30, 40), np.nan)
    depth_m[10:20, 15:25] = 2.0
    depth_m[0, 0] = -1.0
    image, K = np.zeros((30, 40, 3), np.uint8), np.array([[40.0, 0, 20], [0, 40.0, 15], [0, 0, 1]])
    image[..., 1] = 200
    T = np.eye(4)
    T[0, 3] = 0.25  # points move to the right: by 5 px at 2 m
    cloud = figures.render_cloud(depth_m, image, K, T)
    green = (cloud == (0, 200, 0)).all(-1)
    assert (cloud[~green] == 255).all() and green.sum() == 12 * 12  # a point covers its neighbours too
    rows, columns = np.nonzero(green)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (9, 20, 19, 30)


METHODS = {"half": 0.5, "twice": 2.0, "never": None, "holes": math.nan}


@pytest.fixture
def methods(monkeypatch):
    """Methods that scale ground truth, one that cannot and one that answers nowhere."""

    def run(factor, sample, settings, priors):
        if factor is None:
            raise NotApplicable("not today")
        return Prediction(factor * np.where(sample.valid, sample.depth_m, 1.0))

    made = {n: Method(n, n.title(), "", partial(run, f), lambda s: {}, False) for n, f in METHODS.items()}
    monkeypatch.setattr(figures, "find_method", made.__getitem__)
    return made


def test_answers_have_the_error_in_their_title(sample, methods):
    answers = {name: figures._answer(sample, name, Settings(), None) for name in METHODS}
    assert [a.title for a in answers.values()] == [
        *("Half, AbsRel 0.500", "Twice, AbsRel 1.000", "Never: not today", "Holes"),
    ]
    assert [a.abs_rel for a in answers.values()] == [pytest.approx(0.5), pytest.approx(1.0), None, None]
    assert answers["never"].depth_m.shape == sample.depth_m.shape and np.isnan(answers["never"].depth_m).all()


@pytest.mark.parametrize("clouds", [False, True])
def test_a_sample_is_shown_with_depth_ground_truth_errors_and_clouds_on_one_scale(
    sample, methods, monkeypatch, clouds
):
    depths, errors, views = [], [], []
    monkeypatch.setattr(
        figures, "colour_depth", lambda m, near, far: depths.append((m, near, far)) or "depth"
    )
    monkeypatch.setattr(figures, "colour_fraction", lambda e, most: errors.append((e, most)) or "error")
    monkeypatch.setattr(figures, "render_cloud", lambda m, *more: views.append((m, *more)) or "cloud")
    answers = [figures._answer(sample, name, Settings(), None) for name in ("half", "twice")]
    rgb_images, titles, ranges = figures._rows(sample, answers, clouds)
    ground_truth = np.where(sample.valid, sample.depth_m, np.nan)
    assert rgb_images[0] is sample.left
    assert rgb_images[1:] == ["depth"] * 3 + ["error"] * 2 + ["cloud"] * 3 * clouds
    for (shown, near, far), wanted in zip(
        depths, (answers[0].depth_m, answers[1].depth_m, ground_truth), strict=True
    ):
        np.testing.assert_array_equal(shown, wanted)
        assert (
            np.nanmin(ground_truth)
            <= near
            < np.nanquantile(ground_truth, 0.1)
            < np.nanquantile(ground_truth, 0.9)
            < far
        )
    for (error, most), wanted in zip(errors, (0.5, 1.0), strict=True):
        np.testing.assert_allclose(error[sample.valid], wanted, rtol=1e-6)
        assert np.isnan(error[~sample.valid]).all() and most == 0.5
    assert ranges == [depths[0][1:], None, *[None] * clouds], "the row of depths has a bar in metres"
    assert titles[:4] == ["s", "Half, AbsRel 0.500", "Twice, AbsRel 1.000", titles[3]]
    assert titles[3] == f"ground truth, {depths[0][1]:.3g} m to {depths[0][2]:.3g} m"
    assert (
        titles[4:6] == ["error, 0 to 50% of the depth"] * 2
        and titles[6:] == ["view from above left"] * 3 * clouds
    )
    for (m, image, K, T), wanted in zip(
        views, (ground_truth, answers[0].depth_m, answers[1].depth_m), strict=False
    ):
        np.testing.assert_array_equal(m, wanted)
        assert image is sample.left and K is sample.K_left
        np.testing.assert_allclose(T, figures.orbit(np.median(sample.depth_m[sample.valid])))


def test_side_by_side_draws_every_sample_with_every_method(sample, methods, monkeypatch, tmp_path):
    gridded = []
    monkeypatch.setattr(figures, "select", lambda options: ["r1", "r2"])
    monkeypatch.setattr(
        figures,
        "load",
        lambda ref: make_sample(
            SampleRef("d", ref, {}),
            (sample.left, sample.right),
            made_rig(sample.K_left, sample.K_right, sample.E),
            sample.depth_m,
            {},
        ),
    )
    monkeypatch.setattr(figures, "grid", lambda *given, **more: gridded.append((*given, more)) or "grid")
    given = FigureOptions(name="qualitative", out=tmp_path)
    drawing = figures.draw_side_by_side(("half", "never", "twice"), given)
    cells, titles, more = gridded[0]
    ranges = more.pop("depth_ranges")
    assert [each is None for each in ranges] == [False, True] * 2
    assert more == {"columns": 4} and len(cells) == len(titles) == 2 * 8 and drawing.rgb == "grid"
    half, never, twice = pytest.approx(0.5), None, pytest.approx(1.0)
    expected = {f"d/{r}": {"half": half, "never": never, "twice": twice} for r in ("r1", "r2")}
    assert drawing.numbers == {"abs_rel": expected} and titles[0] == "r1" and titles[8] == "r2"
    asked = FigureOptions(name="qualitative", out=tmp_path, methods=("twice",), clouds=True)
    assert list(figures.draw_side_by_side(("half",), asked).numbers["abs_rel"]["d/r1"]) == ["twice"]
    assert gridded[1][2]["columns"] == 2 and len(gridded[1][2]["depth_ranges"]) == 2 * 3
    assert len(gridded[1][0]) == 2 * (1 + 2 + 1 + 2)


def test_a_risk_coverage_figure_draws_the_mean_curve_of_each_method_and_the_best_order(monkeypatch, tmp_path):
    curves = {"guided": ([0.4, 0.2], [0.4, 0.0]), "fast": ([0.6, 0.5], [0.6, 0.1])}

    def records(options, refs, methods):
        assert methods == ["guided", "fast"]
        found = []
        for method, (risk, oracle) in curves.items():
            for i, factor in enumerate((0.5, 1.5)):  # their mean is 1
                curve = {"risk": [factor * x for x in risk], "oracle": [factor * x for x in oracle]}
                head = {"method": method, "dataset": "d", "sample": f"s{i}", "status": "ok"}
                found.append(head | {"risk_coverage": curve})
        return found

    monkeypatch.setattr(figures, "select", lambda options: [SampleRef("d", f"s{i}", {}) for i in range(2)])
    monkeypatch.setattr(figures, "_records", records)
    drawing = figures.draw_risk_coverage(FigureOptions(name="risk-coverage", out=tmp_path))
    (axes,) = drawing.rgb.axes
    lines = iter(axes.lines)
    for method, (risk, oracle) in curves.items():
        for values, label in ((risk, method), (oracle, "ordered by error")):
            line = next(lines)
            np.testing.assert_allclose(line.get_xydata(), np.c_[(100, 50), values])
            assert line.get_label() == label
        assert drawing.numbers["curves"][method]["risk"] == pytest.approx(risk)
    assert axes.get_ylim()[0] == 0 and "coverage" in axes.get_xlabel()


def test_curves_of_updates_are_means_in_order_with_bands_where_there_are_five(monkeypatch, tmp_path):
    asked, count = [], 6
    refs = [SampleRef("d", f"s{i}", {}) for i in range(count)]

    def error(method, i):
        preset, _, updates = method.partition(":guidance_steps=")
        return (0.1 if preset == "guided" else 0.3) + 0.01 * int(updates) + 0.001 * i

    def records(options, refs, methods):
        asked.append((options, refs, methods))
        found = []
        for method in methods:
            for i in range(count):
                ok = method != "paper:guidance_steps=9" or i < 3
                e = error(method, i)
                scores = {"raw": {"abs_rel": e}, "aligned": {"abs_rel": 9}}
                status = {"status": "ok"} if ok else {"status": "broken"}
                found.append({"method": method, "all_pixels": scores, "seconds": 100 * e} | status)
        return found

    monkeypatch.setattr(figures, "select", lambda options: refs)
    monkeypatch.setattr(figures, "_records", records)
    given = FigureOptions(name="guidance-steps", updates=(9, 2, 2, 5), out=tmp_path)
    drawing = figures.draw_guidance_steps(given)
    methods = [f"{preset}:guidance_steps={n}" for preset in ("guided", "paper") for n in (2, 5, 9)]
    assert asked == [(given, refs, methods)]
    assert drawing.numbers["updates"] == [2, 5, 9] and drawing.numbers["samples"] == [
        f"d/s{i}" for i in range(6)
    ]
    left, right = drawing.rgb.axes
    for preset, line, seconds, colour in zip(
        ("guided", "paper"), left.lines, right.lines, ("#0072B2", "#D55E00"), strict=True
    ):
        wanted = []
        for n in (2, 5, 9):
            number = 3 if (preset, n) == ("paper", 9) else count
            wanted.append(np.mean([error(f"{preset}:guidance_steps={n}", i) for i in range(number)]))
        assert drawing.numbers[preset]["abs_rel"] == pytest.approx(wanted)
        assert drawing.numbers[preset]["seconds"] == pytest.approx([100 * w for w in wanted])
        np.testing.assert_allclose(line.get_xydata(), np.c_[(2, 5, 9), wanted])
        np.testing.assert_allclose(seconds.get_ydata(), 100 * np.array(wanted))
        assert line.get_label() == preset and to_rgb(line.get_color()) == to_rgb(colour)
    assert len(left.collections) == len(right.collections) == 1  # of three pairs there is no interval
    assert (left.get_ylabel(), right.get_ylabel()) == ("AbsRel", "s/pair")
    assert left.get_xlabel() == "updates per denoising step" and left.get_xscale() == "log"
    assert [t.get_text() for t in left.get_xticklabels()] == ["2", "5", "9"]
    assert left.get_ylim()[0] == right.get_ylim()[0] == 0
    assert drawing.rgb.get_suptitle() == "6 pairs" and right.get_legend() and not left.get_legend()
    assert left.lines[0].get_marker() != left.lines[1].get_marker()


def test_the_sweep_is_drawn_with_both_optima_and_written(sample, monkeypatch, tmp_path):
    relative = plane_pair(rotation_y=0.05).depth_m / 3
    run = lambda sample, settings, priors: Prediction(None, relative)  # noqa: E731
    monkeypatch.setitem(figures.METHODS, "prior-aligned", SimpleNamespace(run=run))
    monkeypatch.setattr(figures, "select", lambda options: ["first", "second"])
    monkeypatch.setattr(figures, "load", {"first": sample}.__getitem__)
    drawn = []
    monkeypatch.setattr(figures, "_save_png", lambda rgb, path: drawn.append((rgb, path)))
    path = figures.run_figure("figure", FigureOptions(name="gs-sweep", max=12.0, out=tmp_path))
    assert path == tmp_path / "figure-gs-sweep.png" and drawn[0][1] == path
    numbers = json.loads(path.with_suffix(".json").read_text())
    assert numbers["sample"] == "d/s" and len(numbers["loss"]) == 80 and "--max 12.0" in numbers["command"]
    g_s, loss, abs_rel = (np.array(numbers[name]) for name in ("g_s_m", "loss", "abs_rel"))
    assert g_s[-1] == pytest.approx(12) and g_s[abs_rel.argmin()] == pytest.approx(3, rel=0.03)
    upper, lower, *rgb_images = drawn[0][0].axes
    for axes, values, name in ((upper, loss, "L_geo (visible)"), (lower, abs_rel, "AbsRel")):
        curve, least_loss, least_error = axes.lines
        np.testing.assert_allclose(curve.get_xydata(), np.c_[g_s, values], rtol=1e-6)
        assert least_loss.get_xdata()[0] == g_s[loss.argmin()] and axes.get_ylabel() == name
        assert least_error.get_xdata()[0] == g_s[abs_rel.argmin()] and axes.get_xscale() == "log"
        assert axes.get_xlim() == pytest.approx((0.95 * g_s[0], 1.05 * g_s[-1]))
    texts = [text.get_text() for text in upper.get_legend().get_texts()]
    assert texts[0].startswith("min L_geo: g_s = ") and texts[1].startswith("min AbsRel: g_s = ")
    assert (
        lower.get_yscale() == "log" and lower.get_xlabel() == "global scale g_s, m" and len(rgb_images) == 5
    )
    assert rgb_images[0].get_title() == "left image"
    np.testing.assert_array_equal(rgb_images[0].images[0].get_array(), sample.left)
    last = rgb_images[-1].get_title()
    assert last == f"g_s = 12 m\n{numbers['visible'][-1]:.0%} in view"


def test_images_and_figures_are_written_as_png(tmp_path):
    pixels = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    figures._save_png(Image.fromarray(pixels), tmp_path / "new" / "a.png")
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "new" / "a.png")), pixels)
    figure = Figure(figsize=(2, 1), dpi=50, facecolor="red")
    figures._save_png(figure, tmp_path / "b.png")
    image = Image.open(tmp_path / "b.png")
    assert image.size == (100, 50) and image.mode == "RGB" and image.getpixel((3, 3)) == (255, 0, 0)
    drawn = figures._new_figure(3, 2)
    assert tuple(drawn.get_size_inches()) == (3, 2) and drawn.get_dpi() == 90
    with pytest.raises(ValueError, match="the figure must be one of"):
        figures.run_figure("figure", FigureOptions(name="none", out=Path("out")))


def test_records_of_a_figure_are_measured_from_its_cells(monkeypatch, tmp_path):
    monkeypatch.setattr(figures, "method_cells", lambda *given: given)
    monkeypatch.setattr(figures, "measure_cells", lambda cells, options: [cells, options])
    given = FigureOptions(name="guidance-steps", out=tmp_path)
    (((refs, methods, settings, out), options),) = [figures._records(given, ["r"], ["m"])]
    assert (refs, methods, out, options) == (["r"], ["m"], tmp_path, given) and settings == given.settings
    monkeypatch.setattr(figures, "measure_cells", lambda cells, options: None)
    assert figures._records(given, ["r"], ["m"]) == []
