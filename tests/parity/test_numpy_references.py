"""Parts of the method against NumPy, with their constants written again, and the warp against kornia."""

import math

import numpy as np
import pytest
import torch
from kornia.geometry.depth import warp_frame_depth

from geodiff_plugin.algorithm import match_fitting
from geodiff_plugin.algorithm.terms import photometric_map
from geodiff_plugin.cameras import Camera, PosedViews
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.geometry import plane_rays, project_rays, warp_right_to_left
from geodiff_plugin.matching.aggregation import aggregate
from geodiff_plugin.matching.census import census, census_cost, grey_levels
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.sweep import sweep_planes
from geodiff_plugin.matching.winner import winner
from geodiff_plugin.scale.volume_search import group_pixels, look_up
from tests.golden.parts import scene, volume


def _random(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape)


def test_aggregation_is_equation_13_along_four_paths():
    levels = np.random.default_rng(0).integers(0, 225, (5, 7, 9))
    grey = _random(7, 9)
    expected = np.zeros(levels.shape, int)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        path = np.zeros(levels.shape, int)
        for y in range(7)[:: dy or 1]:
            for x in range(9)[:: dx or 1]:
                before = (y - dy, x - dx)
                path[:, y, x] = levels[:, y, x]
                if not (0 <= before[0] < 7 and 0 <= before[1] < 9):
                    continue
                last, least = path[:, *before], path[:, *before].min()
                jump = max(1.2 / (1 + abs(grey[y, x] - grey[before]) / 0.1), 2 * 0.15)
                steps = [
                    np.pad(last, 1, constant_values=10**6)[k : k + 5] + round(0.15 * 224) for k in (0, 2)
                ]
                path[:, y, x] += (
                    np.minimum.reduce([last, *steps, np.full(5, least + round(224 * jump))]) - least
                )
        expected += path
    found = aggregate(torch.from_numpy(levels).byte(), torch.from_numpy(grey).float())
    assert np.abs(found.numpy() - expected).max() <= 2  # a penalty that rounds the other way


def test_census_counts_16_neighbours_in_a_window_of_7():
    grey = _random(2, 13, 14)
    levels = np.rint(grey * 7 / (6 / 255))
    centre = levels[:, 3:-3, 3:-3]
    moved = [levels[:, 3 + dy : 10 + dy, 3 + dx : 11 + dx] for dy in (-3, -1, 1, 3) for dx in (-3, -1, 1, 3)]
    votes = np.clip(np.stack(moved, 1) - centre[:, None], -7, 7)
    described = [census(grey_levels(torch.from_numpy(image).float())) for image in grey]
    np.testing.assert_array_equal(torch.stack(described), votes)
    np.testing.assert_array_equal(census_cost(*described), np.abs(votes[0] - votes[1]).sum(0))


def test_a_winner_is_the_plane_of_least_sum_with_its_evidence():
    """Pixel by pixel, winners on the first and the last plane among them; a parabola needs three sums."""
    rng, planes = np.random.default_rng(0), 12
    sums = rng.integers(0, 800, (planes, 6, 9))
    sums[0, :, 0], sums[-1, :, 1] = 1, 1
    sums[:, :, 2] = 7  # all alike: the first plane
    levels, seen = rng.integers(0, 225, sums.shape), rng.random(sums.shape) < 0.7
    levels[~seen] = 78
    found = winner(*map(torch.from_numpy, (sums.astype(np.int16), levels.astype(np.uint8), seen)))
    for y, x in np.ndindex(6, 9):
        total, level = sums[:, y, x], levels[:, y, x]
        k = int(total.argmin())
        offset = 0.0
        if 0 < k < planes - 1:
            offset = np.roots(np.polyder(np.polyfit((-1, 0, 1), total[k - 1 : k + 2], 2)))[0]
        assert found.position[y, x].item() == pytest.approx(k + np.clip(offset, -0.5, 0.5), abs=1e-5)
        assert found.best[y, x] == total[k]
        assert found.second_best[y, x] == total[np.abs(np.arange(planes) - k) > 1].min()
        gain = max(0.0, level[seen[:, y, x]].mean() - level[k]) / 224
        assert found.gain[y, x].item() == pytest.approx(gain, abs=1e-6)
        beside = level[max(k - 4, 0)] / 2 + level[min(k + 4, planes - 1)] / 2
        assert found.sharpness[y, x].item() == pytest.approx((beside - level[k]) / 224, abs=1e-6)


def test_the_cost_of_a_plane_is_from_the_views_that_see_the_pixel():
    coloured, _ = scene()
    left, *rights = (
        view._replace(image_01=view.image_01.mean(0, keepdim=True))
        for view in (coloured.left, *coloured.rights)
    )
    planes = torch.linspace(0.01, 0.4, 20)
    given = (PosedViews(left, tuple(views)) for views in (rights[:1], rights[1:], rights))
    one, other, both = (sweep_planes(posed, planes) for posed in given)
    seen = np.stack([one.in_view, other.in_view])
    assert all(seen[k][~seen[1 - k]].any() for k in (0, 1)) and (~seen).all(0).any()
    costs = np.stack([one.levels, other.levels]).astype(float)
    mean = np.where(seen.any(0), (costs * seen).sum(0) / np.maximum(seen.sum(0), 1), 78)
    np.testing.assert_array_equal(both.in_view, seen.any(0))
    assert np.abs(both.levels.numpy() - mean).max() <= 0.5


def test_a_candidate_costs_the_mean_of_what_is_in_view():
    """Beyond the nearest plane nothing is known: as bad as an outlier, and counted."""
    made = volume()
    at = torch.arange(0, made.size[0] * made.size[1], 3)
    cost, in_view = made.at_pixels(at)
    planes, x = made.inverse_depth.numpy(), _random(len(at), seed=1)
    groups = group_pixels(torch.from_numpy(x).float(), cost, in_view)
    each = -(-len(at) // 512)
    parts = np.split(np.argsort(x), range(each, len(at), each))
    assert each > 1 and len(parts) == len(groups.mean)
    depth = 1.5 + 12 * _random(4, len(parts))
    found, fraction = look_up(groups, made.inverse_depth, torch.from_numpy(depth).float())
    np.testing.assert_allclose(groups.mean, [x[part].mean() for part in parts], rtol=1e-5)
    for row, mean, seen in zip(depth, found, fraction, strict=True):
        total, count = 0.0, 0.0
        for part, z in zip(parts, row, strict=True):
            position = (1 / z - planes[0]) / (planes[1] - planes[0])
            if position > len(planes) - 1:
                total, count = total + 0.35 * len(part), count + len(part)
                continue
            below = min(int(position), len(planes) - 2)
            for plane, weight in ((below, 1 - position + below), (below + 1, position - below)):
                known = part[in_view.numpy()[plane, part]]
                total += weight * np.minimum(cost.numpy()[plane, known], 0.35).sum()
                count += weight * len(known)
        assert float(mean) == pytest.approx(total / count, rel=1e-4)
        assert float(seen) == pytest.approx(count / len(at), rel=1e-4)


def test_the_photometric_error_is_ssim_in_a_gaussian_window_and_l1():
    a, b = _random(2, 3, 11, 13)
    beside = np.exp(-0.5 / 1.5**2)
    window = np.outer([beside, 1, beside], [beside, 1, beside])
    window /= window.sum()

    def mean(image):
        padded = np.pad(image, ((0, 0), (1, 1), (1, 1)), mode="reflect")
        return sum(window[i, j] * padded[:, i : i + 11, j : j + 13] for i in range(3) for j in range(3))

    mean_a, mean_b = mean(a), mean(b)
    variances = mean(a * a) - mean_a**2 + mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    similar = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
    similar /= (mean_a**2 + mean_b**2 + 1e-4) * (variances + 9e-4)
    expected = 0.7 * (1 - similar) / 2 + 0.3 * np.abs(a - b)
    found = photometric_map(*(torch.from_numpy(image)[None].float() for image in (a, b)), 0.7)
    np.testing.assert_allclose(found[0], expected, atol=1e-5)


class Fit:
    """The correction of a small map by dense algebra: what matches ask, with which weights and links."""

    height, width = 17, 22

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        rows, columns = np.mgrid[: self.height, : self.width]
        self.depth = 4 + 0.1 * columns + 2.0 * (rows > 9)
        self.inverse = np.exp(0.1 * np.sin(rows / 3) + 0.02 * rng.normal(size=rows.shape)) / self.depth
        self.confidence = rng.random(rows.shape) * (rng.random(rows.shape) > 0.4)
        self.inverse[rng.random(rows.shape) < 0.05] *= 2
        self.left = rng.random((3, 1, 1)) + 0.3 * (columns > 12) + 0.05 * rng.random((3, *rows.shape))
        self.step = 0.004
        self.noise = np.hypot(self.step / self.inverse, DEFAULT.match_sigma)
        self.weight = self.confidence * (DEFAULT.match_sigma / self.noise) ** 2
        self.residual = np.where(self.weight > 0, np.log(self.inverse * self.depth), 0)
        self.correct_fraction = (self.weight * self.confidence).sum() / self.weight.sum()
        scale = self.width / 512
        self.edges = []  # the two ends of every link, and its strength
        index = np.arange(rows.size).reshape(rows.shape)
        for axis in (1, 0):
            colour = np.abs(np.diff(self.left, axis=axis + 1)).mean(0) / 0.1
            jump = np.abs(np.diff(np.log(self.depth), axis=axis)) / 0.1
            strength = scale**2 * np.maximum(np.exp(-scale * (colour + jump)), 1e-3)
            first, second = (np.delete(index, end, axis).ravel() for end in (-1, 0))
            self.edges += list(zip(first, second, strength.ravel(), strict=True))

    def torch(self) -> tuple[torch.Tensor, Matches, torch.Tensor]:
        """Depth, matches and left image as the package takes them."""
        depth, inverse, confidence, left = (
            torch.from_numpy(x).float().view(1, -1, self.height, self.width)
            for x in (self.depth, self.inverse, self.confidence, self.left)
        )
        return depth, Matches(inverse, confidence, torch.tensor([self.step])), left

    def solve(self, data, weight, smoothness, tikhonov, robust, rounds):
        """The field of reweighted least squares, and the weights of another round."""
        laplacian = np.zeros((data.size, data.size))
        for i, j, strength in self.edges:
            laplacian[[i, j], [i, j]] += strength
            laplacian[[i, j], [j, i]] -= strength
        for _ in range(rounds):
            matrix = np.diag((weight + tikhonov).ravel()) + smoothness * laplacian
            field = np.linalg.solve(matrix, (weight * data).ravel()).reshape(data.shape)
            weight = robust(field - data)
        return field, weight

    def stiff(self, weight, error):
        """The field over wide regions."""

        def robust(left_over):
            return weight / (1 + left_over**2 / (DEFAULT.outlier_sigma**2 * (self.noise**2 + error**2)))

        return self.solve(self.residual, weight, 400.0, 1.3e-3 * 400, robust, 3)[0]

    def spread(self, residual):
        """Standard deviation of residuals beyond the noise, by the 80 % quantile of right matches."""
        largest = self.quantile(np.abs(residual), 0.8 * self.correct_fraction)
        return np.sqrt(max((largest / 1.2816) ** 2 - self.quantile(self.noise, 0.5) ** 2 / 4, 0))

    def quantile(self, values, fraction):
        order = np.argsort(values.ravel())
        below = np.cumsum(self.weight.ravel()[order])
        return values.ravel()[order][np.searchsorted(below, fraction * below[-1])]


@pytest.fixture
def fit(monkeypatch) -> Fit:
    monkeypatch.setattr(match_fitting, "SOLVER_STEPS", 60)  # exact, as a dense solver
    return Fit()


def test_the_error_of_a_prior_is_what_other_blocks_of_matches_do_not_predict(fit):
    side = round(0.08 * fit.width)
    rows, columns = np.mgrid[: fit.height, : fit.width] // side
    black = (rows + columns) % 2
    first = np.clip(fit.spread(fit.residual), 0.01, 0.5)
    of_black, of_white = (fit.stiff(fit.weight * colour, first) for colour in (black, 1 - black))
    expected = fit.spread(np.where(black > 0, of_white, of_black) - fit.residual)
    depth, target, left = fit.torch()
    assert 0.02 < expected < 0.4
    assert float(match_fitting.prior_error(depth, target, left)) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("error", [0.03, 0.07])
def test_a_correction_is_three_passes_of_weighted_least_squares(fit, error):
    broad = fit.stiff(fit.weight, error)
    doubted = (broad - fit.residual) ** 2 / (DEFAULT.outlier_sigma**2 * (fit.noise**2 + error**2))
    trusted = fit.weight / (1 + doubted)

    def robust(left_over):
        return trusted / (1 + (left_over / (2.5 * fit.noise)) ** 2)

    last = np.clip(DEFAULT.smoothness * (0.05 / error) ** 4, 0.03, 100)
    first, total, weight = max(last, 50), np.zeros_like(fit.residual), trusted
    for k in range(3):
        least = 1e-4 ** (1 - k / 2) * 5e-4 ** (k / 2)
        tikhonov = max(min(0.015 * (0.05 / error) ** 4, 0.03), least)
        smoothness = first ** (1 - k / 2) * last ** (k / 2)
        part, weight = fit.solve(fit.residual - total, weight, smoothness, tikhonov, robust, 2)
        total += part
    depth, target, left = fit.torch()
    refined, _, field = match_fitting.fit_depth(depth, target, left, torch.full((1, 1, 1, 1), error))
    np.testing.assert_allclose(field[0, 0], total, atol=5e-4)
    np.testing.assert_allclose(refined[0, 0], fit.depth * np.exp(-total), rtol=1e-3)


@pytest.mark.parametrize("angle", [0.0, 0.08])
@pytest.mark.parametrize("at", [(0.2, 0.0, 0.0), (-0.1, 0.15, 0.3)])
def test_warp_equals_kornia(angle, at):
    generator = torch.Generator().manual_seed(0)
    right = torch.rand(2, 3, 20, 28, generator=generator, dtype=torch.float64)
    depth = 1.5 + torch.rand(2, 1, 20, 28, generator=generator, dtype=torch.float64)
    K = torch.tensor([[25.0, 0, 13.2], [0, 26.0, 9.7], [0, 0, 1]], dtype=torch.float64)
    T = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    T[:, 0, 0] = T[:, 2, 2] = math.cos(angle)
    T[:, 0, 2], T[:, 2, 0] = math.sin(angle), -math.sin(angle)
    T[:, :3, 3] = torch.tensor(at, dtype=torch.float64)
    camera = Camera(K.numpy())
    rays = plane_rays(depth, [camera] * 2, [camera] * 2, T.numpy())
    ours = warp_right_to_left(right, depth, rays)
    theirs = warp_frame_depth(right, depth, T, K.expand(2, 3, 3))
    # kornia blends the last hundredth of a pixel before the edge with zeros, where we repeat the edge
    u, v = project_rays(depth, rays)[0].unbind(-1)
    inside = (u >= 0) & (u <= 27) & (v >= 0) & (v <= 19)
    visible = (ours.visible & inside[:, None]).expand_as(right)
    assert 0.3 < visible.double().mean() < 1.0
    torch.testing.assert_close(ours.image[visible], theirs[visible])
