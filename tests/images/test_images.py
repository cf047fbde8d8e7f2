"""The images show what their captions state."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from geodiff_plugin.evaluation.datasets import StereoSample
from tests.images.badges import BADGES, write_badges
from tests.images.mistaken import BEGIN, END, HEADER, MISTAKES, with_table
from tests.images.moving import measured
from tests.images.orbit import BACKGROUND, look_from, surface_of
from tests.images.rooms import Room, RoomResult

DOCS = Path(__file__).resolve().parents[2] / "docs"
SIZE = (48, 64)
K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])


def _checks(rng: np.random.Generator) -> np.ndarray:
    """Squares of eight pixels in colours of their own."""
    return np.kron(rng.integers(0, 255, (6, 8, 3)), np.ones((8, 8, 1))).astype(np.uint8)


def test_the_original_view_of_a_surface_is_the_image():
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


def test_the_distance_in_the_image_is_the_distance_of_the_points():
    room = Room("plane", "a plane", "the edge", ((11, 20), (41, 20)))
    image = _checks(np.random.default_rng(1))
    flat = np.full(SIZE, 2.0)
    result = RoomResult(image, image, flat, flat, np.full(SIZE, 0.95), K, 0.1, "trusted")
    _, text = measured(result, room)
    assert text.startswith("the edge: 1.00 ± ")  # 30 px at 2 m and 60 px of focal length


def test_a_badge_is_an_image_whose_label_is_its_text(tmp_path):
    write_badges(tmp_path)
    for file, name, value, _ in BADGES:
        root = ElementTree.parse(tmp_path / f"badge-{file}.svg").getroot()
        assert root.attrib["aria-label"] == f"{name}: {value}"
        assert [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")] == [name, value]


@pytest.mark.parametrize("title", list(MISTAKES)[1:])
def test_every_error_changes_the_input(title):
    E = np.eye(4)
    E[0, 3] = 0.1
    left, right = (_checks(np.random.default_rng(seed)) for seed in (2, 3))
    depth_m = np.full(SIZE, 2.0)
    given = StereoSample("made", "up", left, right, K, K, E, depth_m, depth_m > 0)
    made = MISTAKES[title](given, given)
    assert any(not np.array_equal(getattr(made, name), getattr(given, name)) for name in vars(given))


def test_the_page_has_a_row_for_every_error():
    page = (DOCS / "how-to" / "debugging-a-pair.md").read_text(encoding="utf-8")
    table = page.partition(BEGIN)[2].partition(END)[0]
    assert table.startswith(HEADER)
    assert [row.split(" | ")[0] for row in table.splitlines()[2:]] == [f"| {title}" for title in MISTAKES]
    assert with_table(page, table) == page
