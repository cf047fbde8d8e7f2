"""Torn rows against a plain search over all shifts, and the limits of what counts as a tear."""

import cv2
import numpy as np
import pytest
import torch

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.evidence.pose_check import image_facts
from geodiff_plugin.pose.fit import posed_greys
from geodiff_plugin.trust import ImagesStage, tearing
from geodiff_plugin.trust.tearing import Tear, Tearing, find_tear_row
from tests.unit.trust.sheets import good, judged
from tests.views import view_of


def texture(seed: int, size=(120, 300)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    details = sum(cv2.GaussianBlur(rng.normal(0, 60 * s, size), (0, 0), s) for s in (2, 6))
    return np.clip(128 + details + rng.normal(0, 1, size), 0, 255).astype(np.uint8)


def plain_shift(above: np.ndarray, below: np.ndarray) -> tuple[float, int]:
    """Mean difference of the pixels that overlap, over all shifts up to 8 % of the width."""
    a, b, width = above.astype(float), below.astype(float), len(above)
    most = int(0.08 * width)
    means = {}
    for shift in range(-most, most + 1):
        pairs = [(b[x], a[x - shift]) for x in range(width) if 0 <= x - shift < width]
        means[shift] = np.mean([abs(p - q) for p, q in pairs])
    best = min(means, key=means.__getitem__)
    return means[0] / max(means[best], 0.5), best


@pytest.mark.parametrize("shift", [-20, -7, 3, 14])
def test_the_shift_of_a_row_and_its_gain_are_those_of_a_plain_search(shift):
    image = texture(0)
    above, below = image[40], np.roll(image[41], shift)
    gain, found = tearing._shift(above, below)
    expected = plain_shift(above, below)
    assert found == expected[1] and abs(found - shift) <= 1
    assert gain == pytest.approx(expected[0], rel=1e-3)


def parts_moved(count: int, flat: int = 0, level: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A row of eight parts of which so many are moved by 9 px, and so many of the others have no texture.

    Those without differ by a level; the rest is another texture, which no shift makes more alike.
    """
    rng = np.random.default_rng(3)
    line = cv2.GaussianBlur(rng.normal(0, 150, (1, 420)), (0, 0), 2)[0] + 128
    above, moved = line[9:409], line[:400]
    below = np.where(np.arange(400) * 8 // 400 < count, moved, line[::-1][:400])
    textureless = np.arange(400) * 8 // 400 >= 8 - flat
    above = np.where(textureless, 100, np.clip(above, 0, 255))
    below = np.where(textureless, 100 + level, np.clip(below, 0, 255))
    return above.astype(np.uint8), below.astype(np.uint8)


@pytest.mark.parametrize(
    ("count", "flat", "level", "is_clear"),
    [
        (8, 0, 0, True),
        (7, 0, 0, True),
        (6, 0, 0, False),
        (6, 2, 0, True),
        (6, 2, 1, True),
        (6, 2, 2, False),  # a level of two is texture
        (7, 1, 2, True),
        (5, 3, 0, False),
    ],
)
def test_most_parts_of_a_row_have_to_move_and_six_to_have_texture(count, flat, level, is_clear):
    gain, shift = tearing._shift(*parts_moved(count, flat, level))
    assert (gain > 1.3) is is_clear
    if is_clear:
        assert shift == 9


@pytest.mark.parametrize("side", [1, -1])
def test_a_shift_at_the_end_of_the_search_is_none(side):
    image = texture(1)
    for shift, found in ((23 * side, True), (26 * side, False)):
        gain, _ = tearing._shift(image[40], np.roll(image[40], shift))
        assert (gain > 1.3) is found


def slanted(px: int, size=(80, 300)) -> np.ndarray:
    """Each row is the one above, moved by so many pixels, with a little noise."""
    rng = np.random.default_rng(5)
    line = cv2.GaussianBlur(rng.normal(0, 150, (1, 300)), (0, 0), 3)[0] + 128
    rows = np.stack([np.roll(line, px * row) for row in range(size[0])])
    return np.clip(rows + rng.normal(0, 1, size), 0, 255).astype(np.uint8)


def test_rows_that_all_move_alike_are_slanted_lines_and_one_that_moves_further_is_a_tear():
    image = slanted(4)
    gain, shift = tearing._shift(image[30], image[31])
    assert gain > 2 and shift == 4 and tearing._tears(image) == []
    (tear,) = tearing._tears(torn(image, 40, 6))
    assert (tear.row, tear.shift) == (40, 10)
    rows = np.abs(np.diff(torn(image, 40, 6).astype(float), axis=0)).mean(1)
    steep = rows[39] / max(rows[[36, 37, 41, 42]])  # two and three rows away
    assert tear.gain == pytest.approx(steep, rel=1e-5) and steep < 2.0


def test_two_tears_in_successive_rows_do_not_hide_each_other():
    found = tearing._tears(torn(torn(texture(2), 60, 12), 61, 9))
    assert {(each.row, each.shift) for each in found} == {(60, 12), (61, 9)}


@pytest.mark.parametrize(("noise", "found"), [(14.0, True), (40.0, False), (80.0, False)])
def test_a_shift_has_to_make_rows_clearly_more_alike(noise, found):
    """A row that is noisy itself is only a little more alike with its shift."""
    image = torn(texture(2), 60, 12)
    noisy = image[60] + noise * np.random.default_rng(0).normal(size=300)
    image[60] = np.clip(noisy, 0, 255).astype(np.uint8)
    gain, shift = plain_shift(image[59], image[60])
    assert abs(shift - 12) <= 1 and (1.3 < gain < 2.3 if found else 1.0 < gain < 1.3)
    assert (shift in [each.shift for each in tearing._tears(image)]) is found


def torn(image: np.ndarray, row: int, px: int) -> np.ndarray:
    out = image.copy()
    out[row:] = np.roll(out[row:], px, axis=1)
    return out


@pytest.mark.parametrize(("row", "found"), [(4, False), (5, True), (60, True), (115, True), (116, False)])
def test_the_rows_at_the_edges_are_not_looked_at(row, found):
    tear = find_tear_row([torn(texture(2), row, 10), texture(3)], [120, 120])
    assert (tear == Tear(0, row, 10)) is found and (tear is None) is not found


@pytest.mark.parametrize(("px", "found"), [(2, False), (3, True), (-2, False), (-3, True)])
def test_a_tear_moves_rows_by_three_pixels(px, found):
    image = texture(4)
    image[60:] = image[59:-1]  # the row of the tear is that above it, moved
    tear = find_tear_row([texture(5), torn(image, 60, px)], [120, 120])
    assert (tear is not None) is found
    if found:
        assert tear == Tear(1, 60, px)


def test_one_image_alone_may_be_torn_and_in_a_few_rows():
    whole, broken = texture(6), torn(texture(7), 50, 12)
    assert find_tear_row([whole, broken, whole], [240, 360, 120]) == Tear(1, 150, 36)
    assert find_tear_row([broken, torn(whole, 70, -9)], [120, 120]) is None  # two of them: a pattern
    few, many = texture(8), texture(8)
    for number, row in enumerate((20, 40, 60, 80, 100)):
        many = torn(many, row, 9 + number)
        if row <= 80:
            few = torn(few, row, 9 + number)
    assert len(tearing._tears(few)) == 4 and len(tearing._tears(many)) == 5
    assert find_tear_row([whole, few], [120, 120]) is not None
    assert find_tear_row([whole, many], [120, 120]) is None
    assert find_tear_row([broken, many], [120, 120]) is None


def test_tears_are_in_order_of_their_clearness():
    found = tearing._tears(torn(torn(texture(9), 30, 5), 80, -14))
    assert {(each.row, each.shift) for each in found} == {(30, 5), (80, -14)}
    assert [each.gain for each in found] == sorted((each.gain for each in found), reverse=True)
    image = texture(9)
    assert len(tearing._tears(torn(image, 5, 12)[:10])) == 1 and tearing._tears(torn(image, 5, 12)[:9]) == []


def test_sums_of_rows_are_exact():
    rows = np.random.default_rng(0).integers(0, 256, (5, 3000), np.uint8)
    np.testing.assert_array_equal(tearing._sums(rows), rows.astype(np.int64).sum(1))


@pytest.mark.parametrize("px", [4, -11, 22])
@pytest.mark.parametrize(("row", "end"), [(30, None), (40, 80), (100, None)])
@pytest.mark.parametrize("view", [0, 1, 2])
def test_a_moved_part_of_any_image_is_found_with_its_row_and_shift(view, row, end, px):
    images = [texture(seed) for seed in (1, 2, 3)]
    images[view][row:end] = np.roll(images[view][row:end], px, axis=1)
    found = find_tear_row(images, [120] * 3)
    assert found in [Tear(view, row, px), Tear(view, end, -px)]
    halved = find_tear_row(images, [240] * 3)
    assert halved == Tear(view, 2 * found.row, 2 * found.px)


@pytest.mark.parametrize("view", [0, 1])
def test_row_and_shift_are_in_pixels_of_the_torn_image_whatever_size_the_other_has(view):
    images, factors = [texture(1), texture(2)[:90]], (4, 2)
    images[view] = torn(images[view], 50, -12)
    heights = [len(image) * factor for image, factor in zip(images, factors, strict=True)]
    assert find_tear_row(images, heights) == Tear(view, 50 * factors[view], -12 * factors[view])


@pytest.mark.parametrize("seed", range(20))
def test_whole_images_are_not_torn(seed):
    assert find_tear_row([texture(seed), texture(100 + seed)], [120, 120]) is None


def bricks() -> np.ndarray:
    """Courses of bricks without mortar between them, each shifted by half a brick, and noise."""
    v, u = np.mgrid[:120, :300]
    image = np.where((u + 10 * (v // 20)) % 20 < 4, 60, 180)
    return (image + np.random.default_rng(0).normal(0, 2, image.shape)).astype(np.uint8)


def test_a_pattern_of_the_scene_is_no_tear():
    courses = bricks()
    part = texture(0)
    part[50:] = courses[50:]
    for image in (courses, part, courses[:45]):
        assert find_tear_row([image, image], [len(image)] * 2) is None
        assert find_tear_row([texture(5), courses], [120, 120]) is None


def test_letterbox_bars_cuts_and_blank_images_are_no_tearing():
    barred, cut = texture(0), texture(1)
    barred[:15], barred[-15:] = 0, 0
    cut[60:] = texture(2)[60:]  # of another image: no shift makes the rows alike
    blank = np.full((120, 300), 90, np.uint8)
    for image in (barred, cut, blank, blank[:5], torn(blank, 50, 9)):
        assert find_tear_row([texture(7), image], [120, len(image)]) is None


def test_the_images_of_posed_views_are_searched_without_any_match():
    left, whole, broken = (
        torch.from_numpy(image / 255.0).float().expand(3, -1, -1)
        for image in (texture(6), texture(7), torn(texture(7), 50, 12))
    )
    for right, tear in ((whole, None), (broken, Tear(1, 50, 12))):
        posed = PosedViews(view_of(left, torch.eye(3)), (view_of(right, torch.eye(3), torch.eye(4)),))
        assert image_facts(posed_greys(posed))[Tearing] == tear
    images = ImagesStage([texture(6), torn(texture(7), 50, 12)], [240, 360])
    assert Tearing.of_images(images) == Tear(1, 150, 36)


@pytest.mark.parametrize(
    ("tear", "words"),
    [
        (Tear(0, 123, -7), "The left image is torn: all rows from 123 on are shifted 7 px to the left"),
        (Tear(1, 45, 6), "The right image is torn: all rows from 45 on are shifted 6 px to the right"),
        (Tear(2, 45, 6), "The image of right view 2 is torn"),
    ],
)
def test_the_finding_names_the_image_the_row_and_the_shift(tear, words):
    assert words in judged(good(tear), "views.tearing")
