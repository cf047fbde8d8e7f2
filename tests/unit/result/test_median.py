"""The vote on depth edges against NumPy and SciPy, pixel by pixel, with every grid of another size."""

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter, maximum_filter, median_filter, minimum_filter

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.matching import Matches, rows
from geodiff_plugin.matching.rows import RowMatches
from geodiff_plugin.result import median
from tests.views import view_of

FULL, NATIVE, OF_ROWS, OF_MATCHES = (44, 60), (66, 80), (20, 31), (26, 37)
BASELINE_M = 0.35
K = torch.tensor([[70.0, 0, 39.0], [0, 55.0, 34.0], [0, 0, 1]])


def nearest(x: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The values of the nearest pixels, for a map that keeps its outer edges."""
    at = [
        np.floor((np.arange(new) + 0.5) * old / new).astype(int)
        for new, old in zip(size, x.shape, strict=True)
    ]
    return x[np.ix_(*at)]


def weighted_median(votes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The least vote at which half of the weight is reached, over the first axis."""
    order = votes.argsort(0)
    votes, weights = (np.take_along_axis(x, order, 0) for x in (votes, weights))
    reached = (weights.cumsum(0) >= weights.sum(0) / 2).argmax(0)
    return np.take_along_axis(votes, reached[None], 0)[0]


def mean_near_median(votes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The mean of the votes within about a pixel of their weighted median."""
    middle = weighted_median(votes, weights)
    weights = weights / (1 + (votes - middle) ** 2) ** 2
    return (weights * votes).sum(0) / weights.sum(0)


def error_at_edges(error: float, crispness: float) -> float:
    error = max(error, 1e-3)
    return max(error, min(error / crispness**4, 0.14))


def vote(shift, voters, left, error: float) -> np.ndarray:
    """The shift that a map's ``shift`` and ``voters`` agree on; a voter is a map of shifts and its weight."""
    map_vote = 0.03 * max(0.2 / error, 1.0) ** 3
    height, width = shift.shape
    window = [(v, u) for v in range(-2, 3) for u in range(-2, 3) if abs(v - u) in (0, 2, 4)]
    close = {(v, u): np.exp(-(v * v + u * u) / (2 * 1.5**2)) for v, u in window}
    votes, weights = [shift], [np.full_like(shift, map_vote * sum(close.values()))]
    for of_voter, weight in voters:
        log_ratio = np.log(np.maximum(of_voter, 0.1) / shift)
        deviation2 = min(error, 0.1) ** 2 + 1 / shift**2
        weight = weight / (1 + log_ratio**2 / (2.0**2 * deviation2)) ** 2
        for v, u in window:
            row = np.clip(np.arange(height) + 4 * v, 0, height - 1)[:, None]
            column = np.clip(np.arange(width) + 4 * u, 0, width - 1)
            unlike = np.abs(left[:, row, column] - left).mean(0)
            votes.append(of_voter[row, column])
            weights.append(weight[row, column] * np.exp(-unlike / 0.1) * close[v, u])
    return mean_near_median(np.stack(votes), np.stack(weights)), map_vote


def scene(seed: int = 0, farther: float = 1.0):
    """A map with edges, row matches, matches with known points, and an image; no two of one size."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: FULL[0], : FULL[1]]
    depth = gaussian_filter(4.0 + 0.03 * u + 0.02 * v - 1.8 * (u + 0.4 * v > 38), 2.2)
    depth = (farther * depth * (1 + 0.01 * rng.normal(size=FULL))).astype(np.float32)
    rough = nearest(depth, OF_MATCHES) * np.exp(0.08 * rng.normal(size=OF_MATCHES))
    confidence = rng.random(OF_MATCHES) * (rng.random(OF_MATCHES) > 0.3)
    for count in (1.4, 40.0):
        confidence[rng.random(OF_MATCHES) < 0.04] = count  # of the pixels that a known point stands for
    known = rng.uniform(0.2, 1.0, OF_MATCHES)
    px = 70.0 * OF_ROWS[1] / NATIVE[1] * BASELINE_M
    of_rows = px / nearest(depth, OF_ROWS) * np.exp(0.05 * rng.normal(size=OF_ROWS))
    of_rows[rng.random(OF_ROWS) < 0.03] = 0.0  # at infinity
    kind = rng.integers(0, 4, OF_ROWS)  # nothing, matched, hidden or filled
    left = (
        rng.random((3, 1, 1)) * 0.2
        + 0.5 * (np.mgrid[: NATIVE[0], : NATIVE[1]][1] > 43)
        + np.zeros((3, *NATIVE))
    )
    left += 0.05 * rng.random((3, *NATIVE))
    tensor = {
        "depth": torch.from_numpy(depth)[None, None],
        "left": torch.from_numpy(left).float(),
        "known": torch.from_numpy(known)[None, None].float(),
    }
    layers = [of_rows, *(kind == k for k in (1, 2, 3))]
    of_rows_t = [torch.from_numpy(np.asarray(layer, np.float32)) for layer in layers]
    row_matches = RowMatches(*of_rows_t, torch.tensor(BASELINE_M))
    inverse, sure = (torch.from_numpy(x)[None, None].float() for x in (1 / rough, confidence))
    target = Matches(inverse, sure, torch.tensor([0.01]))
    native = PosedViews(view_of(tensor["left"], K), ())
    evidence = Evidence(native, native, None, None, rows=row_matches)
    return tensor, evidence, target, (of_rows, kind, 1 / rough, confidence, known)


def resized_left(left: torch.Tensor, size: tuple[int, int]) -> np.ndarray:
    return F.interpolate(left[None], size, mode="bilinear", antialias=True)[0].double().numpy()


def enlarged(voted: np.ndarray, small: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """The mean of the 9 nearest votes near their median; near ones of the same colour weigh most."""
    height, width = whole.shape[1:]
    v0 = ((np.arange(height) + 0.5) * voted.shape[0] / height - 0.5)[:, None]
    u0 = (np.arange(width) + 0.5) * voted.shape[1] / width - 0.5
    votes, weights = [], []
    for down, right in np.ndindex(3, 3):
        v, u = np.round(v0) + down - 1, np.round(u0) + right - 1
        at = v.clip(0, voted.shape[0] - 1).astype(int), u.clip(0, voted.shape[1] - 1).astype(int)
        votes.append(voted[at])
        unlike = np.abs(small[:, *at] - whole).mean(0)
        weights.append(np.exp(-unlike / 0.1 - 2.0 * ((v - v0) ** 2 + (u - u0) ** 2)))
    return mean_near_median(np.array(votes), np.array(weights))


@pytest.mark.parametrize(
    ("error", "spacing", "most_pixels", "farther"),
    [
        (0.3, 1.0, 600_000, 1.0),
        (0.12, 1.0, 32 * 44, 1.0),
        (0.015, 1.0, 600_000, 1.0),
        (0.008, 1.0, 600_000, 1.0),
        (0.0003, 1.0, 600_000, 1.0),
        (0.09, 5.0, 32 * 44, 1.0),
        (0.3, 1.0, 600_000, 12.0),  # shifts of less than a pixel
    ],
)
def test_the_vote_equals_its_formula(monkeypatch, error, spacing, most_pixels, farther):
    """Map, image, rows and matches are on four grids; a low limit on pixels moves the vote to a fifth one."""
    monkeypatch.setattr(rows, "MAX_PIXELS", most_pixels)
    monkeypatch.setattr(median, "ROUNDS", 40)  # an exact median
    tensor, evidence, target, (of_rows, kind, inverse, confidence, known) = scene(farther=farther)
    found = median.filter_depth(
        tensor["depth"], evidence, target, tensor["known"], torch.full((1, 1, 1, 1), error), spacing
    )
    depth = tensor["depth"][0, 0].double().numpy()
    size = rows.grid_of_rows(FULL)
    assert (size == FULL) == (most_pixels == 600_000)
    small, inverse, confidence, known = (nearest(x, size) for x in (depth, inverse, confidence, known))
    shift_of_rows, kind = nearest(of_rows, size) * size[1] / OF_ROWS[1], nearest(kind, size)
    left = resized_left(tensor["left"], size)
    px = 70.0 * size[1] / NATIVE[1] * BASELINE_M
    coarseness = max(1.0, size[1] / FULL[1] * spacing / 2)
    assert 0.3 < crispness(small) < 0.9
    error = error_at_edges(error, crispness(small) / coarseness)
    of_kind = np.array([0.0, 1.5, 1.5, 0.5])[kind]
    voters = (shift_of_rows, known * of_kind), (px * inverse, known * np.minimum(confidence, 1.0))
    voted, map_vote = vote(px / small, voters, left, error)
    if map_vote < 1.0:
        voted = np.where(confidence > 1.0, voted, median_filter(voted, 5, mode="nearest"))
    if size != FULL:
        voted = enlarged(voted, left, resized_left(tensor["left"], FULL))
    expected = np.clip(px / voted, depth.min(), depth.max())
    assert found.dtype == tensor["depth"].dtype and found.shape == tensor["depth"].shape
    off = np.abs(found[0, 0].numpy() / expected - 1)
    assert np.quantile(off, 0.995) < 1e-5, "two votes of one weight may be told apart by rounding"
    assert np.abs(expected / depth - 1).mean() > (0.003 if map_vote < 10 else 0), "the vote changes the map"


def test_the_crispness_of_a_map_is_what_two_pixels_take_of_its_steps():
    for blur in (0.1, 1.0, 2.5):
        tensor, *_ = scene(3)
        wide = np.kron(tensor["depth"][0, 0].numpy(), np.ones((2, 2)))
        depth = np.exp(cv2.GaussianBlur(np.log(wide), (0, 0), blur)).astype(np.float32)
        expected = crispness(depth)
        for unit in (1.0, 0.01):
            assert float(median._edge_sharpness(torch.from_numpy(unit * depth))) == pytest.approx(
                expected, rel=1e-4
            )
        depth[20:22, 30:40] = 0.0
        assert float(median._edge_sharpness(torch.from_numpy(depth))) == pytest.approx(
            crispness(depth), rel=1e-4
        )


def crispness(depth: np.ndarray) -> float:
    log_depth = np.log(np.maximum(depth, 1e-9))
    near, wide = (maximum_filter(log_depth, n) - minimum_filter(log_depth, n) for n in (9, 25))
    across, down = (np.abs(log_depth - np.roll(log_depth, 2, axis)) for axis in (1, 0))
    step = maximum_filter(np.maximum(across, down), 9)
    inner = (slice(12, -12),) * 2
    edges = ((near > 0.1) & (wide < 2.2 * near))[inner]
    fractions = np.sort((step[inner] / near[inner])[edges])
    return 1.0 if not len(fractions) else float(np.clip(fractions[(len(fractions) - 1) // 2] / 0.8, 0.1, 1.0))


def test_the_bisection_finds_the_weighted_median_to_a_part_of_the_range():
    """Of 31 votes per pixel; without any weight it gives about the least vote."""
    rng = np.random.default_rng(4)
    votes, weights = rng.uniform(-3.0, 9.0, (31, 2000)), rng.random((31, 2000)) ** 3
    found = median.weighted_median(*(torch.from_numpy(x) for x in (votes, weights))).numpy()
    off = np.abs(found - weighted_median(votes, weights)) / np.ptp(votes, axis=0)
    assert off.max() <= 2.0**-8 and off.mean() > 2.0**-11
    nothing = median.weighted_median(
        torch.from_numpy(votes), torch.zeros(31, 2000, dtype=torch.float64)
    ).numpy()
    assert (np.abs(nothing - votes.min(0)) <= 2.0**-7 * np.ptp(votes, axis=0)).all()


@pytest.mark.parametrize("rows_at_once", [1, 7])
def test_strips_of_any_height_and_both_ways_of_a_device_give_the_same_vote(monkeypatch, rows_at_once):
    tensor, evidence, target, _ = scene(1)
    given = tensor["depth"], evidence, target, tensor["known"], torch.full((1, 1, 1, 1), 0.2)
    monkeypatch.setattr(rows, "MAX_PIXELS", 32 * 44)
    whole = median.filter_depth(*given)
    monkeypatch.setattr(median, "STRIP", rows_at_once * FULL[1] - (rows_at_once == 1))
    torch.testing.assert_close(median.filter_depth(*given), whole, rtol=1e-6, atol=0.0)
    monkeypatch.setattr(median, "launch_bound", lambda tensor: True)
    torch.testing.assert_close(median.filter_depth(*given), whole, rtol=1e-6, atol=0.0)
    monkeypatch.setattr(median, "STRIP_OF_DEVICE", rows_at_once * FULL[1])
    torch.testing.assert_close(median.filter_depth(*given), whole, rtol=1e-6, atol=0.0)


def test_an_image_without_row_matches_keeps_its_map():
    tensor, evidence, target, _ = scene()
    bare = Evidence(evidence.native, evidence.grid, None, None)
    assert (
        median.filter_depth(tensor["depth"], bare, target, tensor["known"], torch.full((1, 1, 1, 1), 0.2))
        is tensor["depth"]
    )


def test_a_map_of_64_bits_is_voted_on_in_32_and_comes_back_as_it_was():
    tensor, evidence, target, _ = scene()
    error = torch.full((1, 1, 1, 1), 0.2)
    single = median.filter_depth(tensor["depth"], evidence, target, tensor["known"], error)
    double = median.filter_depth(tensor["depth"].double(), evidence, target, tensor["known"], error)
    assert double.dtype == torch.float64
    torch.testing.assert_close(double.float(), single, rtol=1e-5, atol=0.0)
