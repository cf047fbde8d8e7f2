"""Matches that both views agree on, against NumPy: with several right views, turned, scaled and cut off."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.matching import consistency
from geodiff_plugin.matching.consistency import (
    candidates,
    known_fraction,
    known_shape,
    match_volume,
    view_evidence,
    window_mean,
)
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.sweep import sweep_planes
from geodiff_plugin.matching.volume import CostVolume
from tests.tiny import render_plane
from tests.unit.matching import references as ref
from tests.views import view_of

SIZE = (34, 47)
K = ref.matrix(58.0, 52.0, 22.0, 18.0)
CAMERAS = [
    (SIZE, K + np.array([[0, 0, 2.0], [0, 0, 0], [0, 0, 0]]), ref.right_from_left((0, 0, 0), (0.16, 0, 0))),
    ((41, 39), ref.matrix(52.0, 57.0, 21.0, 19.0), ref.right_from_left((2.0, 3.0, 6.0), (-0.15, 0.06, 0.1))),
]
PLANES = np.linspace(0.1, 0.9, 36)


@pytest.fixture(scope="module")
def volume() -> CostVolume:
    """A slanted plane that fades to grey below, seen by a rectified view and by a turned one."""
    normal, offset = np.array([0.4, -0.3, 1.0]), 2.2
    images = []
    for size, K_view, T in ((SIZE, K, np.eye(4)), *CAMERAS):
        image = render_plane(K_view, np.linalg.inv(T), size, normal, offset, seed=3)[0]
        faded = 1 / (1 + np.exp(np.linspace(-6, 20, size[0])))[:, None]
        images.append(0.5 + faded * (image.mean(-1) / 255.0 - 0.5))
    views = tuple(
        ref.grey_view(image, *camera[1:]) for image, camera in zip(images[1:], CAMERAS, strict=True)
    )
    left = torch.from_numpy(images[0][None]).float()
    return sweep_planes(PosedViews(view_of(left, K), views), torch.from_numpy(PLANES).float())


def right_positions(volume: CostVolume, v: int) -> np.ndarray:
    """The planes of every second row of a right canvas, from the costs of the left pixels that show them."""
    view, levels = volume.aligned[v], volume.levels.numpy()
    rows, columns = np.arange(0, view.size[0], 2), np.arange(view.size[1])
    looked_up = np.full((len(levels), len(rows), len(columns)), ref.UNSEEN)
    for k, (scale, (across, down)) in enumerate(zip(view.scale, view.shift, strict=True)):
        at = [np.rint((lines - by) / scale).astype(int) for lines, by in ((rows, down), (columns, across))]
        shown = np.ix_(*((x >= 0) & (x < last) for x, last in zip(at, volume.size, strict=True)))
        clipped = np.ix_(*(x.clip(0, last - 1) for x, last in zip(at, volume.size, strict=True)))
        looked_up[k][shown] = levels[k][clipped][shown]
    return ref.positions(ref.aggregated(looked_up, view.grey.numpy()[::2]))


def left_right_difference(volume: CostVolume, v: int, position: np.ndarray) -> np.ndarray:
    """Between the plane of every left pixel and that of the right pixel at which it is seen."""
    view, other = volume.aligned[v], right_positions(volume, v)
    found = np.full(position.shape, np.inf)
    number = np.arange(len(PLANES))
    for (row, column), plane in np.ndenumerate(position):
        scale = np.interp(plane, number, view.scale)
        across, down = (np.interp(plane, number, view.shift[:, axis]) for axis in (0, 1))
        u, v_ = int(np.rint(scale * column + across)), int(np.rint(scale * row + down))
        inside = 0 <= u < view.size[1] and 0 <= v_ < view.size[0]
        if inside and (view.valid is None or view.valid[v_, u]):
            above, below = other[v_ // 2, u], other[min((v_ + 1) // 2, len(other) - 1), u]
            found[row, column] = abs((above + below) / 2 - plane)
    return found


def test_confidence_and_deviation_of_matches_follow_from_their_evidence(volume):
    total = ref.aggregated(volume.levels.numpy(), volume.left_01[0].numpy())
    position, best = ref.positions(total), total.min(0)
    index, number = total.argmin(0), np.arange(len(total))[:, None, None]
    second_best = np.where(abs(number - index) > 1, total, 10**6).min(0)
    levels, seen = volume.levels.numpy().astype(float), volume.in_view.numpy()
    own = np.take_along_axis(levels, index[None], 0)[0]
    gain = np.maximum((levels * seen).sum(0) / np.maximum(seen.sum(0), 1) - own, 0) / 224
    sides = [np.take_along_axis(levels, (index + by).clip(0, len(total) - 1)[None], 0)[0] for by in (-4, 4)]
    contrast, sharpness = (ref.window_mean(x, 15) for x in (gain, (sum(sides) / 2 - own) / 224))
    cost = (best / (4 * 224)).clip(0, 0.8)
    margin = ((second_best - best) / (4 * 224)).clip(0, 0.5)
    differences = [left_right_difference(volume, v, position) for v in range(2)]
    confidence = np.zeros(SIZE)
    for difference in differences:
        odds = 5.8 + 0.8 * np.log(margin + 0.03) - 5.9 * cost - 0.62 * np.minimum(difference, 1.5)
        probability = np.minimum(contrast / 0.03, 1) / (1 + np.exp(-odds))
        confidence = np.maximum(confidence, np.where(difference <= 1.5, probability, 0))
    deviation = np.sqrt((1 - confidence) / 0.04) * np.maximum(1, 0.1 / np.maximum(sharpness, 0.001))

    found = match_volume(volume)
    assert float(found.plane_step) == pytest.approx(0.8 / 35, rel=1e-4)
    np.testing.assert_allclose(found.inverse_depth[0], 0.1 + position * 0.8 / 35, rtol=1e-4)
    # A position within a rounding error of half a pixel is seen by a neighbour.
    for ours, theirs in ((found.confidence[0], confidence), (found.deviation[0], deviation)):
        assert (np.abs(ours.numpy() - theirs) > 1e-3 * (1 + theirs)).mean() < 0.005
    assert all(np.isinf(d).any() and (d < 1.5).mean() > 0.3 and (d > 1.5).any() for d in differences)
    assert (confidence > 0.5).mean() > 0.3 and (deviation > 5).any() and (contrast < 0.03).any()
    winners, means, others = candidates(volume)
    np.testing.assert_allclose(means, [contrast, sharpness], atol=1e-5)
    for view, other, difference in zip(volume.aligned, others, differences, strict=True):
        evidence = view_evidence(view, other, winners)
        features = np.stack([np.ones(SIZE), np.log(margin + 0.03), cost, np.minimum(difference, 1.5)])
        assert (np.abs(evidence.features.numpy() - features) > 1e-3).mean() < 0.005
        assert (np.isfinite(evidence.difference.numpy()) != np.isfinite(difference)).mean() < 0.005


def test_the_deviation_grows_with_doubt_and_with_blur_up_to_a_hundred_times():
    confidence = torch.tensor([1.0, 0.99, 0.96, 0.5, 0.0, 0.96, 0.96, 0.96, 0.96])
    sharpness = torch.tensor([0.2, 0.2, 0.1, 0.11, 0.5, 0.05, 0.001, 0.0002, -0.3])
    found = consistency._deviation(confidence, sharpness)
    expected = [0.0, 0.5, 1.0, 12.5**0.5, 5.0, 2.0, 100.0, 100.0, 100.0]
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_the_plane_is_found_in_metres_and_the_order_of_the_views_does_not_matter(volume):
    depth_m = render_plane(K, np.eye(4), SIZE, np.array([0.4, -0.3, 1.0]), 2.2, seed=3)[1]
    found = match_volume(volume)
    sure = found.confidence[0].numpy() > 0.5
    sure[10:] = False  # where the texture fades
    off = np.abs(found.inverse_depth[0].numpy() - 1 / depth_m) / float(found.plane_step)
    assert sure.mean() > 0.2 and np.median(off[sure]) < 0.3 and (off[sure] > 1.5).mean() < 0.05
    swapped = match_volume(replace(volume, aligned=volume.aligned[::-1]))
    torch.testing.assert_close(swapped.confidence, found.confidence)
    alone = [match_volume(replace(volume, aligned=(view,))).confidence for view in volume.aligned]
    torch.testing.assert_close(torch.maximum(*alone), found.confidence)
    assert all((each < found.confidence).any() for each in alone)


@pytest.mark.parametrize("by_pooling", ["0", "1"])
@pytest.mark.parametrize("radius", [0, 1, 4, 15])
def test_the_mean_of_a_window_counts_what_lies_inside_the_image(radius, by_pooling, monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", by_pooling)
    maps = np.random.default_rng(0).random((2, 3, 7, 11))
    found = window_mean(torch.from_numpy(maps), radius)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(found[index], ref.window_mean(maps[index], radius), rtol=1e-6)


def batch() -> Matches:
    """Two images of matches that differ in all values; a few are known points, whose confidence exceeds 1."""
    rng = np.random.default_rng(1)
    shape = (2, 1, 40, 37)
    confidence = rng.random(shape) * (rng.random(shape) < 0.6)
    confidence[1, 0, ::9, ::8] = 12.5
    parts = rng.uniform(0.1, 1.0, shape), confidence, np.array([0.01, 0.023]), rng.uniform(0.3, 4.0, shape)
    return Matches(*(torch.from_numpy(x).float() for x in parts))


def mean_precision(matches: Matches, image: int, least: float) -> np.ndarray:
    deviation, confidence = (x[image, 0].double().numpy() for x in (matches.deviation, matches.confidence))
    precision = np.where(confidence > 0, np.maximum(confidence, 1) / np.maximum(deviation, least) ** 2, 0)
    return ref.window_mean(precision, 15) / 0.3


def test_what_is_known_around_every_pixel_is_the_mean_precision_of_its_own_image():
    matches = batch()
    fraction = known_fraction(matches)
    surface = torch.from_numpy(np.random.default_rng(2).uniform(0.02, 1.5, (2, 1, 40, 37))).float()
    shape = known_shape(matches, surface)
    for image, step in enumerate((0.01, 0.023)):
        expected = np.minimum(mean_precision(matches, image, 1.0), 1)
        np.testing.assert_allclose(fraction[image, 0], expected, rtol=1e-4)
        near = np.minimum(surface[image, 0].numpy() / step / 50, 1)
        expected = np.minimum(mean_precision(matches, image, 0.5) * near, 1)
        np.testing.assert_allclose(shape[image, 0], expected, rtol=1e-4)
        assert (fraction[image] < 1).any()
    assert (shape < 1).any() and (shape[1] == 1).any()
    unknown = Matches(matches.inverse_depth, matches.confidence, matches.plane_step)
    assert (known_fraction(unknown) == 1).all()
    near = (surface / torch.tensor([0.01, 0.023]).view(-1, 1, 1, 1) / 50).clamp_max(1)
    torch.testing.assert_close(known_shape(unknown, surface), near)


def test_what_is_known_without_deviations_is_left_to_the_reference(asked_kernels):
    matches = batch()
    assert known_fraction(matches) == "matching.kernels.windows.known_fraction"
    assert (known_fraction(replace(matches, deviation=None)) == 1).all() and len(asked_kernels) == 1


def test_window_means_of_a_masked_image_are_those_of_its_valid_pixels():
    rng = np.random.default_rng(0)
    maps, valid = rng.random((2, 20, 31)).astype(np.float32), rng.random((20, 31)) > 0.4
    valid[:, :12] = False  # whole windows without a valid pixel
    given, radius = torch.from_numpy(maps), consistency.CONTRAST_RADIUS
    found = consistency._means_of_valid(given, torch.from_numpy(valid)).numpy()
    for v, u in np.ndindex(valid.shape):
        window = np.s_[max(v - radius, 0) : v + radius + 1, max(u - radius, 0) : u + radius + 1]
        inside = valid[window]
        expected = maps[:, *window][:, inside].mean(1) if inside.any() else 0.0
        np.testing.assert_allclose(found[:, v, u], expected, rtol=1e-4, atol=1e-6)
    assert torch.equal(consistency._means_of_valid(given, None), window_mean(given, radius))
    other = torch.where(torch.from_numpy(valid), given, 100.0)
    np.testing.assert_array_equal(consistency._means_of_valid(other, torch.from_numpy(valid)), found)
