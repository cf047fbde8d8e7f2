"""Matches along rows: on either side, on grids of other sizes, in metres, and what the search may find."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from geodiff_plugin.cameras import PosedViews, View
from geodiff_plugin.matching import rows
from geodiff_plugin.matching.consistency import known_fraction
from geodiff_plugin.matching.gaps import find_gaps
from geodiff_plugin.matching.matches import HalfOcclusions, Matches
from geodiff_plugin.matching.rows import (
    RowMatches,
    first_rectified_pair,
    half_occlusions,
    match_rows,
    row_images,
    row_matches,
    with_occluded,
)
from geodiff_plugin.trust.occlusion_order import occlusion_order
from tests.tiny import rows_of
from tests.unit.matching import references as ref
from tests.views import view_of

SIZE = (100, 220)
FOCAL, BASELINE_M = 160.0, 0.25
#: Shifts of a wall and of two boxes in front of it.
WALL, BOXES = 5, {(10, 90, 60, 100): 17, (15, 85, 150, 180): 12}


def shift_map() -> np.ndarray:
    shift = np.full(SIZE, WALL)
    for (top, bottom, left, right), box in BOXES.items():
        shift[top:bottom, left:right] = box
    return shift


def scene(side: int, infinity_px: int) -> tuple[View, View]:
    """A left view, and one to its right (``side`` 1) or left.

    At infinity a point is ``infinity_px`` further left in the view.
    """
    rng = np.random.default_rng(0)
    brightness = {WALL: 0.0, 12: 0.6, 17: 0.5}
    textures = {
        shift: low + 0.4 * cv2.blur(rng.random((SIZE[0], 500)), (2, 2)) for shift, low in brightness.items()
    }

    def seen(move: int) -> np.ndarray:
        """An image that is ``move`` baselines to the right: near surfaces cover far ones."""
        columns = np.arange(SIZE[1])
        by = {shift: move * shift + (infinity_px if move else 0) for shift in (WALL, 12, 17)}
        image = textures[WALL][:, columns + 100 + by[WALL]].copy()
        for (top, bottom, left, right), shift in sorted(BOXES.items(), key=lambda box: box[1]):
            inside = (columns + by[shift] >= left) & (columns + by[shift] < right)
            image[top:bottom, inside] = textures[shift][top:bottom, columns[inside] + 100 + by[shift]]
        return np.stack([image, 0.9 * image, 0.8 * image])

    K_left = ref.matrix(FOCAL, 150.0, 108.0, 52.0)
    K_right = K_left - infinity_px * np.eye(3)[0][:, None] * np.eye(3)[2]
    T = ref.right_from_left((0.0, 0.0, 0.0), (side * BASELINE_M, 0.0, 0.0))
    left, right = (torch.from_numpy(image).float() for image in (seen(0), seen(side)))
    return view_of(left, K_left), view_of(right, K_right, T)


@pytest.mark.parametrize(("side", "infinity_px"), [(1, 0), (1, -6), (-1, 7)])
def test_shifts_from_infinity_and_metres_are_right_on_either_side(side, infinity_px):
    left, view = scene(side, infinity_px)
    images = row_images(left, view)
    assert images.levels.dtype == torch.uint8 and images.device == left.image_01.device
    greys = images.greys(images.levels)
    for grey, image in zip(greys, (left.image_01, view.image_01), strict=True):
        luma = 255 * np.tensordot([0.299, 0.587, 0.114], image, 1)
        assert grey.dtype == np.uint8 and grey.flags.c_contiguous
        np.testing.assert_allclose(grey[:, ::side], luma, atol=0.501)
    assert images.infinity_px == side * infinity_px and images.focal_px == FOCAL
    assert images.mirrored is (side < 0) and (images.shift_m > 0) == (side < 0)
    assert images.shift_px(0.5) == pytest.approx(0.5 * FOCAL * BASELINE_M)

    shifts, expected = match_rows(images, greys, 19.0), shift_map()
    found = row_matches(images, shifts)
    assert found.baseline_m.shape == () and float(found.baseline_m) == pytest.approx(BASELINE_M)
    matched, occluded, filled = (x.numpy() for x in (found.matched, found.occluded, found.filled))
    assert set(np.unique([matched, occluded, filled])) <= {0.0, 1.0}
    assert matched.mean() > 0.7 and (matched + occluded + filled).max() == 1
    np.testing.assert_array_equal(found.certain, matched + occluded)
    shift = found.shift.numpy()
    off = np.abs(shift - expected)[matched > 0]
    assert np.median(off) < 0.2 and (off > 1).mean() < 0.05
    # A strip as wide as the step next to each box is hidden: on its left from a view on the right.
    for (top, bottom, first, end), box in BOXES.items():
        strip = np.arange(first - box + WALL, first) if side > 0 else np.arange(end, end + box - WALL)
        inner = np.ix_(np.arange(top + 8, bottom - 8), strip[3:-3])
        assert occluded[inner].mean() > 0.6 and matched[inner].mean() < 0.35
        assert np.median(np.abs(shift[inner] - WALL)) < 0.3  # of the wall, which goes on behind
        other = np.arange(end + 2, end + 6) if side > 0 else np.arange(first - 6, first - 2)
        assert occluded[np.ix_(np.arange(top + 8, bottom - 8), other)].mean() < 0.1
    gaps = find_gaps(matched[:, ::side] > 0)
    unknown = gaps.put(np.zeros(SIZE, bool), gaps.inner)[:, ::side]
    np.testing.assert_array_equal(unknown, (occluded + filled) > 0)
    # The checks of the rows see the pair as if its second view were on the right.
    assert shifts.grey is greys[0] and shifts.known.dtype == bool
    np.testing.assert_array_equal(shifts.known, matched[:, ::side] > 0)
    np.testing.assert_array_equal(shifts.gaps.unknown, gaps.unknown)
    at = shifts.known
    np.testing.assert_array_equal(shifts.shift[at], shift[:, ::side][at])
    assert occlusion_order(shifts.grey, shifts.shift, shifts.gaps) > 0.3


@pytest.mark.parametrize(
    ("infinity_px", "nearest_px", "lowest", "count"),
    [
        (0.0, 11.0, 0, 16),  # four pixels more than the nearest shift
        (0.0, 12.5, 0, 32),
        (-2.4, 40.0, -3, 48),
        (3.7, 500.0, 3, 64),  # 0.3 of 200 columns
        (0.0, -3.0, 0, 16),
    ],
)
def test_the_search_goes_from_infinity_to_a_little_beyond_the_nearest_shift(
    monkeypatch, infinity_px, nearest_px, lowest, count
):
    asked, make = [], rows.make_matcher
    monkeypatch.setattr(rows, "make_matcher", lambda *given: asked.append(given) or make(*given))
    image = np.random.default_rng(1).integers(0, 256, (30, 200), dtype=np.uint8)
    right = np.roll(image, -8, axis=1)
    shift, known = rows._row_shifts(image, right, infinity_px, nearest_px)
    assert asked == [(lowest, count, 1)]
    assert shift.shape == known.shape == image.shape and shift.dtype == np.float32
    inner = (slice(5, -5), slice(10, 150))
    assert known[inner].mean() > 0.9
    np.testing.assert_allclose(np.median(shift[inner][known[inner]]), 8 - infinity_px, atol=0.05)


def test_shifts_are_found_where_all_disparities_of_the_search_are_below_0():
    image = np.random.default_rng(1).integers(0, 256, (30, 200), dtype=np.uint8)
    shift, known = rows._row_shifts(image, np.roll(image, 20, axis=1), -24.0, 6.0)
    inner = (slice(5, -5), slice(30, 150))
    assert known[inner].mean() > 0.9
    np.testing.assert_allclose(np.median(shift[inner][known[inner]]), 4.0, atol=0.05)


def test_shifts_below_a_third_of_a_pixel_are_not_known():
    image = np.random.default_rng(1).integers(0, 256, (30, 200), dtype=np.uint8)
    right = np.roll(image, -2, axis=1)
    for infinity_px, known in ((1.69, True), (1.75, False), (2.0, False)):
        found = rows._row_shifts(image, right, infinity_px, 10.0)[1][5:-5, 20:-20]
        assert found.mean() > 0.9 if known else not found.any()


@pytest.mark.parametrize("channels", [1, 3])
def test_the_matcher_has_the_penalties_that_opencv_recommends(channels):
    """8 and 32 times the channels and the area of the block, as in its documentation."""
    matcher = rows.make_matcher(-5, 48, channels)
    assert (matcher.getMinDisparity(), matcher.getNumDisparities()) == (-5, 48)
    size = matcher.getBlockSize()
    assert (matcher.getP1(), matcher.getP2()) == (8 * channels * size**2, 32 * channels * size**2)
    assert matcher.getMode() == cv2.STEREO_SGBM_MODE_SGBM_3WAY
    # A winner is 10 % better than the second, both views agree to a pixel, specks of 100 pixels go.
    assert (size, matcher.getUniquenessRatio(), matcher.getDisp12MaxDiff()) == (5, 10, 1)
    assert (matcher.getSpeckleWindowSize(), matcher.getSpeckleRange()) == (100, 2)


def test_columns_are_padded_on_the_left_by_the_first_one():
    image = np.random.default_rng(2).integers(0, 256, (4, 6), dtype=np.uint8)
    np.testing.assert_array_equal(rows.pad_columns(image, 3), np.pad(image, ((0, 0), (3, 0)), mode="edge"))


def test_large_images_are_matched_on_a_smaller_grid_with_its_cameras(monkeypatch):
    """Of 100 x 220 pixels a quarter: shifts, focal length and infinity are half as many pixels."""
    assert rows.grid_of_rows((600, 1000)) == (600, 1000)
    assert rows.grid_of_rows((1200, 2000)) == (600, 1000)
    assert rows.grid_of_rows((832, 1248)) == (632, 949)
    left, view = scene(1, -6)
    monkeypatch.setattr(rows, "MAX_PIXELS", 50 * 110)
    images = first_rectified_pair(PosedViews(left, (view,)))
    assert images.levels.shape == (2, 50, 110)
    assert images.focal_px == pytest.approx(FOCAL / 2) and images.infinity_px == pytest.approx(-3.0)
    found = rows_of(images, 9.0)
    expected = shift_map()[::2, ::2] / 2
    assert np.median(np.abs(found.shift.numpy() - expected)[found.matched.numpy() > 0]) < 0.4
    depth_m = FOCAL * BASELINE_M / 17  # of the first box
    assert images.shift_px(1 / depth_m) == pytest.approx(17 / 2)


def test_the_first_view_that_is_rectified_and_of_the_left_image_size_is_matched():
    left, view = scene(1, -6)
    turned = view._replace(T_right_from_left=ref.right_from_left((0.0, 3.0, 0.0), (0.3, 0.0, 0.0)))
    smaller = view._replace(image_01=view.image_01[:, :, 1:])
    farther = view._replace(T_right_from_left=view.T_right_from_left * np.array([1.0, 1, 1, 3]))
    images = first_rectified_pair(PosedViews(left, (turned, smaller, view, farther)))
    assert abs(float(images.shift_m)) == pytest.approx(BASELINE_M) and images.infinity_px == -6
    other = first_rectified_pair(PosedViews(left, (smaller, farther, view)))
    assert abs(float(other.shift_m)) == pytest.approx(3 * BASELINE_M)
    for views in ((), (turned,), (smaller,), (turned, smaller)):
        assert first_rectified_pair(PosedViews(left, views)) is None


def test_a_pair_of_which_nothing_matches_has_no_shift():
    blank = torch.full((3, 40, 80), 0.5)
    left = view_of(blank, ref.matrix(FOCAL, 150.0, 40.0, 20.0))
    right = left._replace(T_right_from_left=scene(1, 0)[1].T_right_from_left)
    images = row_images(left, right)
    shifts = match_rows(images, images.greys(images.levels), 10.0)
    assert not shifts.known.any()
    found = row_matches(images, shifts)
    for each in (found.shift, found.matched, found.occluded, found.filled):
        assert each.shape == (40, 80) and not each.any()


def made_rows(size=(12, 30)) -> RowMatches:
    rng = np.random.default_rng(3)
    shift = rng.uniform(0, 20, size) * (rng.random(size) < 0.9)
    kind = rng.integers(0, 4, size)
    maps = [shift, *(kind == k for k in (1, 2, 3))]
    return RowMatches(*(torch.from_numpy(np.asarray(x, np.float32)) for x in maps), torch.tensor(0.2))


@pytest.mark.parametrize("size", [(12, 30), (4, 6), (36, 90)])
def test_hidden_strips_on_another_grid_have_the_inverse_depth_of_the_farther_surface(size):
    found, made = made_rows(), half_occlusions(made_rows(), size, 150.0)
    at = np.ix_(
        *(np.floor((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(size, (12, 30), strict=True))
    )
    shift, occluded = found.shift.numpy()[at], found.occluded.numpy()[at]
    assert made.inside.shape == made.inverse_depth.shape == (1, 1, *size)
    np.testing.assert_array_equal(made.inside[0, 0], (occluded > 0) & (shift > 0))
    np.testing.assert_allclose(made.inverse_depth[0, 0], shift / (150.0 * 0.2), rtol=1e-6)


@pytest.mark.parametrize("deviates", [False, True])
def test_strips_count_as_much_as_the_matches_around_them_where_these_are_not_kept(deviates):
    rng = np.random.default_rng(4)
    shape = (1, 1, 40, 50)
    confidence = np.where(rng.random(shape) < 0.5, 0.0, rng.choice([0.04, 0.06, 0.9], shape))
    parts = [rng.random(shape), confidence, np.array([0.02]), rng.uniform(1, 6, shape)]
    matches = Matches(*(torch.from_numpy(x).float() for x in parts[: 3 + deviates]))
    strips = HalfOcclusions(
        torch.from_numpy(rng.random(shape) < 0.4), torch.from_numpy(rng.random(shape)).float()
    )
    found = with_occluded(matches, strips)
    put = strips.inside.numpy() & (confidence < 0.05)
    assert put.any() and (strips.inside.numpy() & ~put).any()
    known = known_fraction(matches).numpy()
    assert (known == 1).all() if not deviates else (known < 1).any()
    np.testing.assert_allclose(
        found.confidence, np.where(put, 0.8 * known, np.float32(confidence)), rtol=1e-6
    )
    expected = np.where(put, strips.inverse_depth.numpy(), matches.inverse_depth.numpy())
    np.testing.assert_array_equal(found.inverse_depth, expected)
    if deviates:
        np.testing.assert_array_equal(found.deviation, np.where(put, 1, np.float32(parts[3])))
    assert replace(found, inverse_depth=matches.inverse_depth).plane_step is matches.plane_step
    assert deviates or found.deviation is None


def test_strips_among_matches_without_deviations_are_left_to_the_reference(asked_kernels):
    confidence = torch.full((1, 1, 3, 4), 0.5)
    strips = HalfOcclusions(confidence > 1, confidence)
    matches = Matches(confidence, confidence, torch.tensor(0.1), confidence)
    assert with_occluded(matches, strips) == "matching.kernels.windows.with_occluded"
    matches = replace(matches, deviation=None)
    assert torch.equal(with_occluded(matches, strips).confidence, confidence) and len(asked_kernels) == 1


def test_a_match_is_known_only_if_the_right_pixel_is_valid():
    valid = np.ones((2, 8), bool)
    valid[0, 2:4] = valid[1, 0] = False
    disparity = np.array([[0.0, 0, 0, 0.4, 2.0, 2.4, 2.6, -5.0], [3.0] * 8], np.float32)
    expected = [[True, True, False, False, False, False, False, True], [False] * 4 + [True] * 4]
    assert rows._seen_valid(valid, disparity).tolist() == expected


@pytest.mark.parametrize("shift_m", [-0.1, 0.1])
def test_images_and_valid_pixels_are_mirrored_alike(shift_m):
    levels = torch.arange(24, dtype=torch.uint8).view(2, 3, 4)
    images = rows.RowImages(levels, 1.0, 100.0, np.float64(shift_m), (levels > 13).numpy())
    for grey, valid in zip(images.greys(levels), images.compared(), strict=True):
        np.testing.assert_array_equal(valid, grey > 13)
