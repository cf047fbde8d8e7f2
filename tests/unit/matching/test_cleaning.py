"""JPEG blocks and noise: found for each image of a batch, and removed as by SciPy's DCT."""

import io

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.fft import dctn, idctn

from geodiff_plugin import GuidanceConfig
from geodiff_plugin.cameras import Camera
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.evidence.prepare import pinhole, plan_evidence
from geodiff_plugin.formats.lenses import distortion_from_text, undistorted
from geodiff_plugin.matching import build_cost_volume, cleaning, match_volume
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.cleaning import Flaws, clean, find_flaws
from tests.scenes import SyntheticPair, render_pair
from tests.views import posed_of, view_of

END_TO_END = pytest.mark.end_to_end
GRID = 210_000


def quantization(quality: int) -> np.ndarray:
    """Pillow's luminance table ``(8, 8)``."""
    with io.BytesIO() as buffer:
        Image.new("L", (8, 8)).save(buffer, "JPEG", quality=quality)
        return np.array(Image.open(buffer).quantization[0]).reshape(8, 8)


def photo(seed: int, size=(168, 200), falls: float = 1.6) -> np.ndarray:
    """Grey levels with detail of all sizes, the fine one faint as in images."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(rng.normal(size=size))
    frequency = np.hypot(np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1]))
    image = np.fft.irfft2(spectrum / np.maximum(frequency, 0.01) ** falls, size)
    return np.clip(127 + 35 * image / image.std(), 0, 255)


def compressed(levels: np.ndarray, quality: int) -> np.ndarray:
    with io.BytesIO() as buffer:
        Image.fromarray(np.uint8(np.rint(levels))).save(buffer, "JPEG", quality=quality)
        return np.array(Image.open(buffer)).astype(float)


def flaws_of(*images: np.ndarray) -> list[Flaws]:
    return find_flaws(torch.from_numpy(np.stack(images)).float())


def test_the_table_is_that_of_a_jpeg_file_of_quality_50():
    np.testing.assert_array_equal(np.reshape(cleaning._LUMA_STEPS, (8, 8)), quantization(50))


def jpeg_scale(levels: np.ndarray, row: int, column: int) -> float:
    """The scale of the table by the definition: steps of which the blocks' coefficients are multiples."""
    rows, columns = (levels.shape[0] - row) // 8, (levels.shape[1] - column) // 8
    blocks = levels[row : row + 8 * rows, column : column + 8 * columns].reshape(rows, 8, columns, 8)
    values = np.abs(dctn(blocks, axes=(1, 3), norm="ortho"))
    scales = []
    for i, j in ((0, 1), (1, 0), (2, 0), (1, 1), (0, 2), (0, 3), (1, 2), (2, 1), (3, 0)):
        largest = 0
        for step in range(2, 100):
            value = values[:, i, :, j][values[:, i, :, j] > 0.6 * step]
            if len(value) >= 32 and np.cos(2 * np.pi * value / step).mean() > 0.5:
                largest = step
        scales.append(largest / quantization(50)[i, j])
    found = sorted(scale for scale in scales if scale)
    if len(found) < 5:
        return 0.0
    middle = found[(len(found) - 1) // 2]
    return middle if sum(abs(scale / middle - 1) < 0.3 for scale in found) >= 5 else 0.0


def test_every_image_of_a_batch_has_the_scale_of_its_own_table_wherever_its_blocks_begin():
    """Crops that begin within a block, by different rows and columns; the last one was never compressed."""
    qualities, corners = (20, 30, 75, 90), ((0, 0), (3, 6), (7, 1), (5, 4))
    crops = [
        compressed(photo(n), quality)[row : row + 144, column : column + 176]
        for n, (quality, (row, column)) in enumerate(zip(qualities, corners, strict=True))
    ]
    never = photo(9)[:144, :176]
    found = flaws_of(*crops, never)
    for image, flaws, quality, (row, column) in zip(crops, found, qualities, corners, strict=False):
        expected = jpeg_scale(image, -row % 8, -column % 8)
        assert flaws.jpeg_scale == pytest.approx(expected, rel=1e-4)
        table = np.median(quantization(quality)[:3, :3] / quantization(50)[:3, :3])
        assert expected == pytest.approx(table, rel=0.25)
        assert flaws_of(image)[0].jpeg_scale == pytest.approx(expected, rel=1e-4)
    assert found[-1].jpeg_scale == jpeg_scale(never, 0, 0) == 0.0


@pytest.mark.parametrize(
    ("number", "scale", "found"),
    [(32, 3.0, 3.0), (31, 3.0, 0.0), (64, 0.2, 0.2), (40, 6.0, 6.0)],
)
def test_a_step_counts_from_32_multiples_on(number, scale, found):
    """Blocks whose nine lowest coefficients are a few steps of the table, or 0."""
    rng = np.random.default_rng(0)
    coefficients = np.zeros((8, 8, 8, 8))
    for i, j in ((0, 1), (1, 0), (2, 0), (1, 1), (0, 2), (0, 3), (1, 2), (2, 1), (3, 0)):
        signs = np.where(np.arange(64) < number, rng.choice([-5, 4, 5, 6, -7], 64), 0)
        coefficients[:, :, i, j] = (signs * np.rint(scale * quantization(50)[i, j])).reshape(8, 8)
    levels = idctn(coefficients, axes=(2, 3), norm="ortho").swapaxes(1, 2).reshape(64, 64)
    given = torch.from_numpy(levels[None]).float()
    assert cleaning._jpeg_scales(given, np.zeros((1, 2), int))[0] == pytest.approx(found, rel=0.08)
    assert jpeg_scale(levels, 0, 0) == pytest.approx(cleaning._jpeg_scales(given, np.zeros((1, 2), int))[0])


@pytest.mark.parametrize(
    ("scales", "agreed"),
    [
        ((0.5, 0.5, 0.0, 0.52, 0.48, 0.0, 0.51, 0.0, 0.0), 0.5),
        ((0.5, 0.5, 0.0, 0.52, 0.48, 0.0, 0.0, 0.0, 0.0), 0.0),  # four are too few
        ((1.0, 1.29, 1.0, 0.71, 1.2, 3.0, 0.2, 0.0, 0.0), 1.0),
        ((1.0, 1.31, 1.0, 0.71, 1.2, 3.0, 0.2, 0.0, 0.0), 0.0),
        ((1.0, 1.29, 1.0, 0.69, 1.2, 3.0, 0.2, 0.0, 0.0), 0.0),
        ((0.9, 1.1, 1.0, 1.2, 0.8, 1.15, 0.0, 0.0, 0.0), 1.0),  # of six the third
    ],
)
def test_five_coefficients_have_to_agree_on_a_scale(scales, agreed):
    assert cleaning._scale(np.array(scales)) == agreed


def test_some_blocks_of_a_large_image_are_read_and_the_fewer_ones_of_another_are_not_padded(monkeypatch):
    monkeypatch.setattr(cleaning, "_MAX_BLOCKS", 50)
    levels = np.random.default_rng(0).random((2, 75, 90)).astype(np.float32)
    begins = np.array([[3, 2], [0, 7]])
    found = cleaning._some_blocks(torch.from_numpy(levels), begins).numpy()
    for image, (row, column), blocks in zip(levels, begins, found, strict=True):
        rows, columns = (75 - row) // 8, (90 - column) // 8
        every = -(-rows * columns // 50)
        expected = [
            image[row + 8 * i : row + 8 * i + 8, column + 8 * j : column + 8 * j + 8].ravel()
            for i in range(rows)
            for j in range(columns)
        ][::every]
        assert every > 1 and len(expected) <= 50
        np.testing.assert_array_equal(blocks[: len(expected)], expected)
        assert not blocks[len(expected) :].any()


def test_the_noise_of_each_image_is_measured_in_its_own_flattest_blocks():
    rng = np.random.default_rng(1)
    noises = (1.0, 4.0, 9.0)
    smooth = [np.add.outer(np.linspace(60, 120, 165), np.linspace(-20, 40, 218)) for _ in noises]
    images = [
        image + sigma * rng.normal(size=image.shape) for image, sigma in zip(smooth, noises, strict=True)
    ]
    for flaws, sigma in zip(flaws_of(*images), noises, strict=True):
        assert flaws.noise == pytest.approx(sigma, rel=0.08)
    textured = images[1].copy()
    textured[:, 120:] += 40 * (rng.random((165, 98)) - 0.5)  # in a part of the image only
    (flaws,) = flaws_of(textured)
    assert flaws.noise == pytest.approx(4.0, rel=0.25)
    blocks = textured[:160, :216].reshape(20, 8, 27, 8).swapaxes(1, 2)
    energy = (dctn(blocks, axes=(2, 3), norm="ortho")[..., 4:, 4:] ** 2).mean((2, 3))
    assert flaws.noise == pytest.approx(np.sqrt(np.quantile(energy, 0.1)) / 0.77, rel=1e-3)


def test_the_noise_of_a_few_blocks_is_interpolated_between_two_of_them():
    """Of 15 blocks: between the second and the third, by four tenths, which differ much."""
    levels = np.random.default_rng(2).uniform(0, 255, (26, 45)) * np.linspace(0, 1, 45)
    blocks = levels[:24, :40].reshape(3, 8, 5, 8).swapaxes(1, 2)
    energy = np.sort((dctn(blocks, axes=(2, 3), norm="ortho")[..., 4:, 4:] ** 2).mean((2, 3)).ravel())
    assert energy[2] > 1.1 * energy[1]
    expected = np.sqrt(0.6 * energy[1] + 0.4 * energy[2]) / 0.77
    assert flaws_of(levels)[0].noise == pytest.approx(expected, rel=1e-4)


MASKS = {
    "circle": np.hypot(*(np.mgrid[:168, :200] - np.array([84, 100])[:, None, None])) < 80,
    "wedge": np.add.outer(np.linspace(0, 20, 168), np.zeros(200)) + 5 < np.arange(200),
    "holes": np.random.default_rng(0).random((7, 8)).repeat(24, 0).repeat(25, 1) > 0.2,
}


def masked_flaws(levels: np.ndarray, valid: np.ndarray) -> Flaws:
    """The flaws of an image whose content is a smooth gradient where it is not valid."""
    smooth = np.linspace(60, 120, levels.shape[1])
    given = torch.from_numpy(np.where(valid, levels, smooth)[None]).float()
    return find_flaws(given, torch.from_numpy(valid)[None])[0]


@pytest.mark.parametrize("name", MASKS)
def test_smooth_content_outside_of_the_mask_hides_no_flaws(name):
    grainy = np.linspace(60, 120, 200) + 5 * np.random.default_rng(1).normal(size=(168, 200))
    (whole,) = flaws_of(grainy)
    assert whole.noise == pytest.approx(5.0, rel=0.08)
    assert masked_flaws(grainy, MASKS[name]).noise == pytest.approx(whole.noise, rel=0.05)
    blocky = np.pad(compressed(photo(3), 30), ((0, 3), (0, 5)))[3:, 5:]
    scale = flaws_of(blocky)[0].jpeg_scale
    assert scale > 0 and masked_flaws(blocky, MASKS[name]).jpeg_scale == pytest.approx(scale, rel=0.05)
    (edges,) = find_flaws(torch.from_numpy(blocky)[None].float(), torch.ones(1, *blocky.shape).bool())
    assert edges.jpeg_scale == pytest.approx(scale)


def test_a_mask_without_a_whole_block_shows_no_flaws():
    valid = np.zeros((168, 200), bool)
    valid[:5] = True
    assert masked_flaws(compressed(photo(3), 30), valid) == Flaws(0.0, 0.0)


def test_each_masked_image_is_cleaned_by_the_flaws_of_its_valid_pixels():
    valid = torch.from_numpy(MASKS["circle"])
    clear = torch.from_numpy(photo(5, falls=2.0)[None] / 255).float()
    grainy = (clear + 6 / 255 * torch.randn(clear.shape, generator=torch.Generator().manual_seed(0))).clamp(
        0, 1
    )
    filled = torch.where(valid, grainy, 0.4)
    plain, masked, unmasked = clean([grainy, filled, filled], GRID, [None, valid, None])
    assert torch.equal(plain, clean([grainy], GRID)[0]) and unmasked is filled
    assert (masked - clear)[:, valid].square().mean() < 0.5 * (filled - clear)[:, valid].square().mean()


@pytest.mark.parametrize(
    ("scale", "noise", "counted"), [(0.4, 0.0, 0.0), (0.0, 2.25, 1.125), (0.3, 5.0, 5.0), (0.5, 1.6, 0.0)]
)
def test_coefficients_below_the_steps_and_the_noise_are_removed_but_never_the_mean(scale, noise, counted):
    """Noise counts in full from 2.8 levels on, not at all to 1.7, and in proportion between."""
    threshold = cleaning._threshold(Flaws(scale, noise))
    expected = np.sqrt((1.2 * scale * quantization(50)) ** 2 + (3.6 * counted) ** 2)
    expected[0, 0] = 0
    np.testing.assert_allclose(threshold, expected, rtol=1e-5)
    assert cleaning._threshold(Flaws(0.0, 1.69)) is None


def thresholded(levels: np.ndarray, threshold: np.ndarray) -> np.ndarray:
    """The mean over 16 grids of blocks, which begin at every row and column twice, of the reflected image."""
    height, width = levels.shape
    wide = np.pad(levels, ((8, 16), (8, 16)), mode="reflect")
    total = np.zeros(levels.shape)
    for row in range(8):
        for column in ((3 * row) % 8, (3 * row + 4) % 8):
            rows, columns = (-(-side // 8) + 1 for side in levels.shape)
            part = wide[row : row + 8 * rows, column : column + 8 * columns]
            blocks = dctn(part.reshape(rows, 8, columns, 8), axes=(1, 3), norm="ortho")
            blocks *= np.abs(blocks) >= threshold[:, None]
            back = idctn(blocks, axes=(1, 3), norm="ortho").reshape(part.shape)
            total += back[8 - row : 8 - row + height, 8 - column : 8 - column + width] / 16
    return total


@pytest.mark.parametrize("at_once", [False, True])
@pytest.mark.parametrize("size", [(40, 56), (37, 50), (41, 63)])
def test_small_coefficients_are_removed_as_by_scipys_transform(monkeypatch, at_once, size):
    monkeypatch.setattr(cleaning, "launch_bound", lambda _: at_once)
    levels = photo(2, size) + np.random.default_rng(3).normal(0, 6, size)
    threshold = cleaning._threshold(Flaws(0.5, 5.0))
    found = cleaning._without(torch.from_numpy(levels).float(), threshold)
    np.testing.assert_allclose(found, thresholded(levels, threshold), atol=2e-3)


def test_each_image_of_a_list_is_cleaned_by_its_own_flaws_and_keeps_its_colours():
    rng = np.random.default_rng(4)
    size, other = (120, 152), (136, 128)
    colour = np.stack([photo(5, size, 2.0)] * 3) * np.array([1.0, 0.8, 0.9])[:, None, None]
    images = [
        colour,
        colour + rng.normal(0, 5, size),
        compressed(photo(6, other), 40)[None],
        compressed(photo(7, size), 30)[None],
        colour + rng.normal(0, 12, size),
        photo(8, (300, 280))[None] + rng.normal(0, 9, (300, 280)),
    ]
    given = [torch.from_numpy(np.clip(image / 255, 0, 1)).float() for image in images]
    found = clean(given, 5000)  # six times as many pixels as that are too many for the last one
    assert found[0] is given[0] and found[5] is given[5]
    for n in (1, 2, 3, 4):
        luma = np.tensordot([0.299, 0.587, 0.114], given[n], 1) if len(given[n]) == 3 else given[n][0].numpy()
        (flaws,) = flaws_of(255 * luma)
        change = thresholded(255 * luma, cleaning._threshold(flaws)) / 255 - luma
        np.testing.assert_allclose(found[n], np.clip(given[n].numpy() + change, 0, 1), atol=2e-4)
        assert np.abs(change).max() > 0.01
    assert torch.equal(clean(given[1:2], 5000)[0], found[1])
    least = size[0] * size[1] / 6
    assert (
        clean(given[1:2], int(least))[0] is not given[1] and clean(given[1:2], int(least) - 1)[0] is given[1]
    )


@pytest.fixture(scope="module")
def pair() -> SyntheticPair:
    return render_pair(3, "terrain", size=(240, 320))


def compressed_of_cleaning(image_01: torch.Tensor, quality: int) -> torch.Tensor:
    levels = (image_01 * 255).round().byte().permute(1, 2, 0).numpy()
    with io.BytesIO() as buffer:
        Image.fromarray(levels).save(buffer, "JPEG", quality=quality)
        return torch.from_numpy(np.array(Image.open(buffer))).permute(2, 0, 1).float() / 255


def noisy(image_01: torch.Tensor, levels: float) -> torch.Tensor:
    noise = torch.randn(image_01.shape[1:], generator=torch.Generator().manual_seed(0))
    return (image_01 + noise * levels / 255).clamp(0, 1)


@END_TO_END
@pytest.mark.parametrize("channels", [1, 3])
def test_noise_is_found_and_removed_and_a_clean_image_is_unchanged(
    pair: SyntheticPair, channels: int
) -> None:
    scene = pair.left.image_01[:channels]
    before = noisy(scene, 6.0)
    (after,) = clean([before], GRID)
    assert find_flaws(255 * grey(before))[0].noise == pytest.approx(6.0, rel=0.25)
    assert float((after - scene).square().mean()) < 0.5 * float((before - scene).square().mean())
    assert clean([scene], GRID)[0] is scene
    assert clean([before], before[0].numel() // 6 - 1)[0] is before  # it is shrunk anyway


@END_TO_END
@pytest.mark.parametrize("flawed", [lambda x: compressed_of_cleaning(x, 40), lambda x: noisy(x, 8.0)])
def test_fewer_matches_are_wrong(pair: SyntheticPair, flawed) -> None:
    T, left, right = torch.linalg.inv(pair.E), flawed(pair.left.image_01), flawed(pair.right.image_01)

    def wrong(images: tuple[torch.Tensor, torch.Tensor]) -> float:
        posed = posed_of(images[0], pair.K_left, (images[1], pair.K_right, T))
        matches = match_volume(build_cost_volume(posed))
        ground_truth, seen = 1.0 / pair.left.depth_m, torch.isfinite(pair.left.depth_m) & ~pair.occluded
        off = ((matches.inverse_depth - ground_truth).abs() / matches.plane_step > 1.5) * matches.confidence
        return float(off[seen].sum() / matches.confidence[seen].sum())

    cleaned = clean([left], GRID)[0], clean([right], GRID)[0]
    assert wrong(cleaned) < 0.9 * wrong((left, right))
    view = view_of(right, pair.K_right, T)
    config = GuidanceConfig(pose="given")
    made = plan_evidence(left, Inputs(Camera(pair.K_left.numpy()), (view,), (), None), config).evidence
    assert torch.equal(made.native.left.image_01, cleaned[0])
    assert torch.equal(made.native.rights[0].image_01, cleaned[1])


@END_TO_END
def test_an_image_is_cleaned_before_it_is_undistorted(pair: SyntheticPair) -> None:
    """Afterwards its blocks stand nowhere near a multiple of 8 pixels, and are not found."""
    blocky, lens = compressed_of_cleaning(pair.left.image_01, 30), distortion_from_text("-0.2,0.05,0,0")
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])

    def straight(image_01: torch.Tensor) -> np.ndarray:
        return undistorted(image_01.permute(1, 2, 0).contiguous().numpy(), Camera(K, lens=lens))

    given = blocky.permute(1, 2, 0).contiguous().numpy()
    np.testing.assert_array_equal(
        pinhole(given, Camera(K, lens=lens), GuidanceConfig()), straight(clean([blocky], GRID)[0])
    )
    off = GuidanceConfig(clean_images=False)
    np.testing.assert_array_equal(pinhole(given, Camera(K, lens=lens), off), straight(blocky))
    assert pinhole(given, Camera(K), GuidanceConfig()) is given
