"""The pictures show what they say."""

from xml.etree import ElementTree

import numpy as np
import pytest

from geodiff_plugin.evaluation.datasets import StereoSample
from tests.pictures.badges import BADGES, write_badges
from tests.pictures.mistaken import MISTAKES
from tests.pictures.moving import measured
from tests.pictures.orbit import BACKGROUND, look_from, surface_of
from tests.pictures.rooms import Room, RoomResult

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


@pytest.mark.parametrize("title", list(MISTAKES)[1:])
def test_a_mistake_changes_what_is_given(title):
    E = np.eye(4)
    E[0, 3] = 0.1
    left, right = (_checks(np.random.default_rng(seed)) for seed in (2, 3))
    depth_m = np.full(SIZE, 2.0)
    given = StereoSample("made", "up", left, right, K, K, E, depth_m, depth_m > 0)
    made = MISTAKES[title](given, given)
    assert any(not np.array_equal(getattr(made, name), getattr(given, name)) for name in vars(given))
