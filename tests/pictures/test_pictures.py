"""The pictures show what they say."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from geodiff_plugin.evaluation.datasets import StereoSample
from tests.pictures.badges import BADGES, write_badges
from tests.pictures.charts import CHARTS, FOLDER, Chart, draw, tables_of, value_of, with_charts
from tests.pictures.mistaken import MISTAKES
from tests.pictures.moving import measured
from tests.pictures.orbit import BACKGROUND, look_from, surface_of
from tests.pictures.rooms import Room, RoomResult

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = sorted({*(path.stem for path in (DOCS / "reference").glob("results*.md")), "strength"})
SVG = "{http://www.w3.org/2000/svg}"
SIZE = (48, 64)
K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])


def _checks(rng: np.random.Generator) -> np.ndarray:
    """Squares of eight pixels in colours of their own."""
    return np.kron(rng.integers(0, 255, (6, 8, 3)), np.ones((8, 8, 1))).astype(np.uint8)


def test_the_own_view_of_a_surface_is_the_photograph():
    image, depth_m = _checks(np.random.default_rng(0)), np.full(SIZE, 2.0)
    surface = surface_of(depth_m, image, K, np.ones(SIZE, bool))
    seen = look_from(surface, K, SIZE, yaw=0.0, pitch=0.0, back=0.0)
    squares = (slice(4, None, 8), slice(4, None, 8))  # their middles, where no colour is blended
    assert np.array_equal(seen[squares], image[squares])


def test_a_surface_seen_from_further_away_is_smaller_by_the_factor():
    white, depth_m = np.full((*SIZE, 3), 255, np.uint8), np.full(SIZE, 2.0)
    surface = surface_of(depth_m, white, K, np.ones(SIZE, bool))
    seen = look_from(surface, K, SIZE, yaw=0.0, pitch=0.0, back=1.0)
    covered = (seen != BACKGROUND).any(axis=-1)
    assert covered.any(axis=0).sum() == pytest.approx(SIZE[1] / 2, abs=2)
    assert covered.any(axis=1).sum() == pytest.approx(SIZE[0] / 2, abs=2)


def test_the_distance_in_the_picture_is_that_of_the_points():
    room = Room("plane", "a plane", "the edge", ((11, 20), (41, 20)))
    image = _checks(np.random.default_rng(1))
    flat = np.full(SIZE, 2.0)
    result = RoomResult(image, image, flat, flat, np.full(SIZE, 0.95), K, 0.1, "trusted")
    _, text = measured(result, room)
    assert text.startswith("the edge: 1.00 ± ")  # 30 px at 2 m and 60 px of focal length


def test_a_badge_is_a_picture_that_names_what_it_says(tmp_path):
    write_badges(tmp_path)
    for file, name, value, _ in BADGES:
        root = ElementTree.parse(tmp_path / f"badge-{file}.svg").getroot()
        assert root.attrib["aria-label"] == f"{name}: {value}"
        assert [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")] == [name, value]


@pytest.mark.parametrize("page", PAGES)
def test_every_table_of_results_has_its_present_chart_above_it(page):
    text = (DOCS / "reference" / f"{page}.md").read_text(encoding="utf-8")
    tables = [line for line in text.splitlines() if re.fullmatch(r"\|[ |:-]+\|", line)]
    assert len(tables) == sum(chart.page == page for chart in CHARTS)
    anew, drawn = with_charts(page, text)
    renew = "python -m tests.pictures charts"
    assert anew == text, renew
    for name, svg in drawn.items():
        assert (DOCS / "images" / FOLDER / name).read_text(encoding="utf-8") == svg, renew


def _drawn(markdown, **more):
    """Bars of a table's chart, by their numbers as written."""
    (table,) = tables_of(markdown)
    root = ElementTree.fromstring(draw(Chart("page", 1, "Errors", **more), table))
    shapes = [e for e in root if e.tag in (f"{SVG}rect", f"{SVG}text", f"{SVG}circle", f"{SVG}path")]
    bars = {}
    for shape, text in zip(shapes, shapes[1:], strict=False):
        if shape.get("class") in ("bar", "ours", "gap") and text.tag == f"{SVG}text":
            bars[text.text] = shape
    return root, bars


def test_bars_are_as_long_as_their_numbers():
    _, bars = _drawn(
        "| m | a | b |\n| --- | ---: | ---: |\n| x | 0.10 | 0.3000 |\n| y | 0.20 | - |\n| z | 0.05 | 0.15 |\n"
    )
    widths = {text: float(bar.get("width")) for text, bar in bars.items()}
    assert set(widths) == {"0.10", "0.3000", "0.20", "0.05", "0.15"}
    for text, width in widths.items():
        assert width / widths["0.20"] == pytest.approx(float(text) / 0.20, abs=0.01)


def test_a_number_far_above_the_others_is_cut_and_still_written():
    _, bars = _drawn("| | a |\n| --- | ---: |\n| x | 1.0 |\n| y | 2.0 |\n| z | 90.0 |\n")
    assert bars["90.0"].get("class") == "gap"
    assert {"1.0", "2.0"} < set(bars)


def test_an_interval_lies_beside_zero_as_its_ends_do():
    root, bars = _drawn(
        "| | a [95 %] |\n| --- | ---: |\n| x | -0.4 [-0.6, -0.1] |\n| y | 0.1 [-0.2, +0.3] |\n"
    )
    zero = float(re.match(r"M([\d.]+)", root.find(f"{SVG}path").get("d"))[1])
    x, y = (float(bar.get("cx")) for bar in bars.values())
    assert x < zero < y
    assert (zero - x) / (y - zero) == pytest.approx(4, abs=0.05)


def test_a_chart_is_named_for_those_who_do_not_see_it():
    root, _ = _drawn("| | a |\n| --- | ---: |\n| x | 1.0 |\n")
    assert root.get("role") == "img" and root.find(f"{SVG}title").text == "Errors"


def test_numbers_of_cells_are_those_that_are_written():
    assert value_of("4 of 16").number == 0.25
    assert value_of("0.089 of 59").number == 0.089
    assert value_of("-0.004 [-0.008, +0.002]")[:3] == (-0.004, -0.008, 0.002)
    assert [value_of(cell) for cell in ("-", "", "poses", "7scenes")] == [None] * 4


@pytest.mark.parametrize("title", list(MISTAKES)[1:])
def test_a_mistake_changes_what_is_given(title):
    E = np.eye(4)
    E[0, 3] = 0.1
    left, right = (_checks(np.random.default_rng(seed)) for seed in (2, 3))
    depth_m = np.full(SIZE, 2.0)
    given = StereoSample("made", "up", left, right, K, K, E, depth_m, depth_m > 0)
    made = MISTAKES[title](given, given)
    assert any(not np.array_equal(getattr(made, name), getattr(given, name)) for name in vars(given))
