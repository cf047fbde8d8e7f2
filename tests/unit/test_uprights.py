"""A sheared right picture is found by upright lines; that of cameras that look up or down is not one."""

import cv2
import numpy as np
import pytest
import torch

from geodiff_plugin.matching.rows import match_rows, row_pictures
from geodiff_plugin.matching.uprights import FEWEST_LINES, certain_shear, upright_lines
from geodiff_plugin.types import CameraView

HEIGHT, WIDTH = 240, 320
ROWS = np.arange(HEIGHT)


def bars(k: float, count: int = 14, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Bars that meet in one vanishing point, and the shift of each, 10 to 40 px at half height.

    Of parallel lines in space both the place in the row, from the vanishing point on, and the shift grow by
    ``1 + k (v - v_c)``.
    """
    rng = np.random.default_rng(seed)
    grey = np.full((HEIGHT, WIDTH), 120, np.uint8)
    shift = np.full((HEIGHT, WIDTH), 8.0, np.float32)
    for x in np.linspace(20, WIDTH - 30, count):
        grows = 1 + k * (ROWS - HEIGHT / 2)
        left, right = (WIDTH / 2 + (x + side - WIDTH / 2) * grows for side in (0, 9))
        inside = (np.arange(WIDTH) >= left[:, None]) & (np.arange(WIDTH) <= right[:, None])
        grey[inside] = rng.integers(0, 80)
        shift = np.where(inside, np.float32(rng.uniform(10, 40) * grows[:, None]), shift)
    return cv2.GaussianBlur(grey, (0, 0), 0.7), shift


@pytest.mark.parametrize("k", [-0.002, 0.0, 0.0015])
@pytest.mark.parametrize("shear", [-0.06, 0.03, 0.08])
def test_a_shear_is_measured_and_a_pitch_of_the_cameras_only_hides_it(k, shear):
    grey, shift = bars(k)
    moved = shift + shear * (ROWS - HEIGHT / 2)[:, None]
    found = certain_shear(upright_lines(grey), moved, np.ones_like(shift))
    assert found * shear >= 0 and abs(found) <= abs(shear) + 0.002
    if k == 0:
        assert found == pytest.approx(shear, abs=0.012)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("k", [-0.003, -0.001, 0.0, 0.002])
def test_a_right_picture_of_pitched_cameras_is_not_sheared(k, seed):
    grey, shift = bars(k, seed=seed)
    noisy = shift + np.random.default_rng(seed).normal(0, 0.3, shift.shape).astype(np.float32)
    assert abs(certain_shear(upright_lines(grey), noisy, np.ones_like(shift))) < 0.003


@pytest.mark.parametrize("seed", range(8))
def test_lines_that_lean_each_its_own_way_show_no_shear(seed):
    """Poles in a heap: no common vanishing point in space, though each looks upright."""
    grey, shift = bars(0.0, seed=seed)
    own = np.random.default_rng(seed).normal(0, 0.08, WIDTH // 20)[np.arange(WIDTH) * (WIDTH // 20) // WIDTH]
    assert abs(certain_shear(upright_lines(grey), shift + own * ROWS[:, None], np.ones_like(shift))) < 0.03


@pytest.mark.parametrize("others", [3, 4])
def test_a_tilted_board_among_few_other_lines_is_no_shear(others):
    """Its lines meet, and shifts grow along them; lines that lean otherwise hide where they meet."""
    k, pole = 0.004, np.arange(WIDTH)
    grows = 1 + k * (ROWS - HEIGHT / 2)[:, None]
    board = (pole - WIDTH / 2) / grows
    grey = np.where((np.abs(board) < 60) & (board % 12 < 5), 40, 120).astype(np.uint8)
    shift = np.broadcast_to(30 * grows, grey.shape).astype(np.float32).copy()
    for n in range(others):  # poles beside it that lean inwards, where the board's lines lean outwards
        at = (1 - 2 * (n % 2)) * (-130 - 8 * (n // 2) + 0.18 * (ROWS - HEIGHT / 2)[:, None]) + WIDTH / 2
        pole_here = np.abs(pole - at) < 2
        grey[pole_here], shift[pole_here] = 10, 12.0
    lines = upright_lines(cv2.GaussianBlur(grey, (0, 0), 0.7))
    assert not abs(certain_shear(lines, shift, np.ones_like(shift))) > 0.003


def test_few_lines_and_few_matches_say_nothing():
    grey, shift = bars(0.0)
    everywhere = np.ones_like(shift)
    nothing = (
        (np.full_like(grey, 90), everywhere),
        (grey, 0 * everywhere),
        (bars(0.0, count=(FEWEST_LINES - 1) // 2)[0], everywhere),
        (np.where(np.arange(WIDTH) < 60, grey, 120).astype(np.uint8), everywhere),
    )
    for picture, matched in nothing:
        assert np.isnan(certain_shear(upright_lines(picture), shift, matched))


@pytest.mark.parametrize("way", [1, -1])
def test_matched_rows_of_a_sheared_picture_say_so(way):
    """The right view on either side: what it sees lies further left, or further right."""
    grey = bars(0.0)[0]
    grey = np.clip(grey + np.random.default_rng(0).normal(0, 12, grey.shape), 0, 255).astype(np.uint8)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    T = torch.eye(4)
    T[0, 3] = -0.1 * way
    for shear in (0.0, 0.05):
        right = cv2.remap(grey, u + way * (20 + np.float32(shear) * v), v, cv2.INTER_LINEAR)
        left_01, right_01 = (
            torch.from_numpy(each / 255.0).float().expand(3, -1, -1) for each in (grey, right)
        )
        found = match_rows(row_pictures(left_01, CameraView(right_01, K, T), K), 60.0).checks.result().shear
        assert found == pytest.approx(shear, abs=0.01)
