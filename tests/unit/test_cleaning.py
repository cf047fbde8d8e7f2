"""Removal of JPEG blocks and sensor noise from photographs before they are compared."""

import io

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GuidanceConfig
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.evidence.prepare import make_evidence
from geodiff_plugin.formats.lenses import distortion_from_text, undistorted
from geodiff_plugin.jobs.reading import pinhole
from geodiff_plugin.matching import build_cost_volume, clean, match_volume
from geodiff_plugin.matching.census import grey
from geodiff_plugin.matching.cleaning import find_flaws
from geodiff_plugin.types import CameraView, PosedViews
from tests.scenes import SyntheticPair, render_pair

GRID = 210_000


@pytest.fixture(scope="module")
def pair() -> SyntheticPair:
    return render_pair(3, "terrain", size=(240, 320))


def compressed(image_01: torch.Tensor, quality: int) -> torch.Tensor:
    levels = (image_01 * 255).round().byte().permute(1, 2, 0).numpy()
    with io.BytesIO() as buffer:
        Image.fromarray(levels).save(buffer, "JPEG", quality=quality)
        return torch.from_numpy(np.array(Image.open(buffer))).permute(2, 0, 1).float() / 255


def noisy(image_01: torch.Tensor, levels: float) -> torch.Tensor:
    noise = torch.randn(image_01.shape[1:], generator=torch.Generator().manual_seed(0))
    return (image_01 + noise * levels / 255).clamp(0, 1)


@pytest.mark.parametrize("channels", [1, 3])
def test_noise_is_found_and_removed_and_a_good_photograph_stays_as_it_is(
    pair: SyntheticPair, channels: int
) -> None:
    scene = pair.left.image_01[:channels]
    before = noisy(scene, 6.0)
    (after,) = clean([before], GRID)
    assert find_flaws(255 * grey(before))[0].noise == pytest.approx(6.0, rel=0.25)
    assert float((after - scene).square().mean()) < 0.5 * float((before - scene).square().mean())
    assert clean([scene], GRID)[0] is scene
    assert clean([before], before[0].numel() // 6 - 1)[0] is before  # it is shrunk anyway


@pytest.mark.parametrize("flawed", [lambda x: compressed(x, 40), lambda x: noisy(x, 8.0)])
def test_fewer_matches_are_wrong(pair: SyntheticPair, flawed) -> None:
    T, left, right = torch.linalg.inv(pair.E).float(), flawed(pair.left.image_01), flawed(pair.right.image_01)

    def wrong(images: tuple[torch.Tensor, torch.Tensor]) -> float:
        view = CameraView(images[1], pair.K_right.float(), T)
        matches = match_volume(build_cost_volume(PosedViews(images[0], (view,), pair.K_left.float())))
        truth, seen = 1.0 / pair.left.depth_m, torch.isfinite(pair.left.depth_m) & ~pair.occluded
        off = ((matches.inverse_depth - truth).abs() / matches.plane_step > 1.5) * matches.confidence
        return float(off[seen].sum() / matches.confidence[seen].sum())

    cleaned = clean([left], GRID)[0], clean([right], GRID)[0]
    assert wrong(cleaned) < 0.9 * wrong((left, right))
    view = CameraView(right, pair.K_right.float(), T)
    config = GuidanceConfig(pose="given")
    made = make_evidence(left, Inputs(pair.K_left.numpy(), (view,), (), None), config)
    assert torch.equal(made.native.left_01, cleaned[0])
    assert torch.equal(made.native.views[0].image_01, cleaned[1])


def test_a_photograph_is_cleaned_before_it_is_undistorted(pair: SyntheticPair) -> None:
    """Afterwards its blocks stand nowhere near a multiple of 8 pixels, and are not found."""
    blocky, lens = compressed(pair.left.image_01, 30), distortion_from_text("-0.2,0.05,0,0")
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])

    def straight(image_01: torch.Tensor) -> np.ndarray:
        return undistorted(image_01.permute(1, 2, 0).contiguous().numpy(), K, lens)

    given = blocky.permute(1, 2, 0).contiguous().numpy()
    np.testing.assert_array_equal(
        pinhole(given, K, lens, GuidanceConfig()), straight(clean([blocky], GRID)[0])
    )
    off = GuidanceConfig(clean_photographs=False)
    np.testing.assert_array_equal(pinhole(given, K, lens, off), straight(blocky))
    assert pinhole(given, K, None, GuidanceConfig()) is given
