"""Frames with both views: how they are split, and which layout is inferred."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats.frame_packing import FRAME_LAYOUTS, Packing, find_packing
from geodiff_plugin.jobs import options

RNG = np.random.default_rng(5)
#: Layout -> whether the views are one above the other, and what undoes their squeeze along x and y.
LAYOUTS = {
    "full": (False, (1, 1)),
    "half": (False, (2, 1)),
    "over-under": (True, (1, 1)),
    "half-over-under": (True, (1, 2)),
}


def test_options_list_the_same_layouts():
    assert (options.AUTO, *FRAME_LAYOUTS) == options.FRAME_LAYOUTS == (options.AUTO, *LAYOUTS)


@pytest.mark.parametrize("layout", FRAME_LAYOUTS)
def test_views_are_the_halves_of_the_frame_left_one_first(layout):
    frame, packing, (stacked, stretch) = RNG.random((12, 20, 3)), Packing(layout), LAYOUTS[layout]
    left, right = packing.split(frame)
    np.testing.assert_array_equal(left, frame[:6] if stacked else frame[:, :10])
    np.testing.assert_array_equal(right, frame[6:] if stacked else frame[:, 10:])
    assert left.flags.c_contiguous and right.flags.c_contiguous
    assert packing.shown_size((10, 6)) == (10 * stretch[0], 6 * stretch[1])
    with pytest.raises(
        InputError, match=r"LEFT must be a frame of both views, of even .*; got 19x11\. Other"
    ):
        packing.split(RNG.random((11, 19, 3)), "LEFT")


def views(size, seed: int = 0) -> list[np.ndarray]:
    """Two views of a scene whose texture is alike in all directions, on several scales."""
    width, height = size
    rng = np.random.default_rng(seed)
    noise = [gaussian_filter(rng.normal(size=(height, width + 24)), 2.0**n) * 2.0**n for n in range(1, 6)]
    scene = sum(noise) / np.std(sum(noise)) * 40 + 120
    crops = scene[:, :width], scene[:, 10 : 10 + width]
    return [np.repeat(np.clip(crop, 0, 255).astype(np.uint8)[..., None], 3, axis=2) for crop in crops]


def packed(layout: str, size, seed: int = 0) -> np.ndarray:
    stacked, (columns, rows) = LAYOUTS[layout]
    stored = size[0] // columns, size[1] // rows
    halves = [cv2.resize(view, stored, interpolation=cv2.INTER_AREA) for view in views(size, seed)]
    return (np.vstack if stacked else np.hstack)(halves)


@pytest.mark.parametrize("size", [(640, 360), (320, 240), (480, 320)])
@pytest.mark.parametrize("layout", FRAME_LAYOUTS)
def test_the_layout_shows_in_shape_and_content(layout, size):
    for seed in range(3):
        frame = packed(layout, size, seed)
        found = find_packing([frame, frame[:, :, ::-1] / 255.0], "LEFT")
        assert found.layout == layout and found.finding.code in ("pairs.layout", "pairs.side-by-side")
        assert f"({layout}), by its shape and content." in found.finding
        assert ("K is for a view of {}x{} ".format(*size) in found.finding) == layout.startswith("half")


def test_an_unusual_shape_makes_the_layout_an_assumption():
    wide = find_packing([packed("half", (960, 288))], "LEFT").finding
    assert wide.code == "pairs.layout" and "This is uncertain." in wide
    clear = find_packing([packed("full", (400, 400))[:, :, :1].repeat(3, 2)], "LEFT")
    assert clear.layout == "full"


@pytest.mark.parametrize(
    ("name", "layout"),
    [
        ("film.H-SBS.mkv", "half"),
        ("hsbs.jpg", "half"),
        ("3d half sbs (2012).mp4", "half"),
        ("trip_full-sbs.png", "full"),
        ("FSBS.png", "full"),
        ("film.HTAB.mkv", "half-over-under"),
        ("half_ou.png", "half-over-under"),
        ("film.full-tab.mp4", "over-under"),
    ],
)
def test_a_tag_in_the_name_decides(name, layout):
    frame = packed("half" if layout != "half" else "full", (640, 360))
    found = find_packing([frame], "LEFT", Path(name))
    assert found.layout == layout and found.finding.code == "pairs.side-by-side"
    assert "by its name" in found.finding


@pytest.mark.parametrize("name", ["chsbsd.png", "houses.png", "table.png", "sbs.png", "halfway.png"])
def test_other_names_decide_nothing(name):
    assert find_packing([packed("half", (640, 360))], "LEFT", Path(name)).layout == "half"
    assert find_packing([packed("over-under", (640, 360))], "LEFT", Path(name)).layout == "over-under"


def test_blank_frames_are_read_as_side_by_side_by_assumption():
    found = find_packing([np.zeros((240, 640, 3), np.uint8)], "LEFT")
    assert found.layout == "full" and found.finding.code == "pairs.layout"
