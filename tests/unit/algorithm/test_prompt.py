"""The depth prompt: what it is made of, how large it is, and that it follows what is known."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from geodiff_plugin.algorithm.match_fitting import fit_depth, prior_error
from geodiff_plugin.algorithm.prompt import depth_prompt
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.matching import Matches
from tests.views import posed_of

#: Smaller than a prompt, and larger: of 300 pixels 256 remain.
SIZES = {"small": (14, 26), "large": (7, 300)}


def drawn(*shape: int, seed: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def ground_truth(size: tuple[int, int]) -> torch.Tensor:
    """A slanted wall from 2 m to 5 m, ``(1, H, W)``."""
    return (2.0 + 3.0 * torch.linspace(0, 1, size[1]) ** 2).expand(1, *size)


def given(size, fraction: float, seed: int, factor: float = 1.0) -> Matches:
    known = (drawn(1, *size, seed=seed) < fraction).float()
    depth_m = factor * ground_truth(size)
    return Matches(known / depth_m, known, 0.01 / depth_m.median())


def evidence(size, points: Matches | None, reliable: Matches | None) -> Evidence:
    left = posed_of(drawn(3, *size, seed=9), np.eye(3))
    return Evidence(left, left, None, reliable, points, reliable)


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
@pytest.mark.parametrize("kind", ["points", "matches", "both"])
def test_a_prompt_is_a_flat_map_that_was_fitted_to_what_is_known(size, kind):
    points, reliable = given(size, 0.05, 1), given(size, 0.5, 2, factor=1.3)
    of_kind = {"points": (points, None), "matches": (None, reliable), "both": (points, reliable)}[kind]
    image = evidence(size, *of_kind)
    (found,) = depth_prompt([image], DEFAULT)
    factor = min(1.0, 256 / max(size))
    assert found.shape == (1, round(size[0] * factor), round(size[1] * factor))
    # By hand: points replace matches and stand for the pixels around them.
    known = points.confidence > 0
    weight = known / known.float().mean() if kind == "points" else torch.where(
        known, 1.0 / known.float().mean(), reliable.confidence
    )  # fmt: skip
    inverse = points.inverse_depth if kind == "points" else torch.where(
        known, points.inverse_depth, reliable.inverse_depth
    )  # fmt: skip
    step = points.plane_step if kind == "points" else reliable.plane_step
    if kind == "matches":
        weight, inverse = reliable.confidence, reliable.inverse_depth
    target = Matches(inverse[None], weight[None], step[None])
    # torch's median is the lower one of the middle two.
    middle = np.sort(inverse[weight > 0])[(int((weight > 0).sum()) - 1) // 2]
    flat, left = torch.full((1, 1, *size), float(1.0 / middle)), image.grid.left.image_01[None]
    fitted = fit_depth(flat, target, left, prior_error(flat, target, left, DEFAULT), DEFAULT).depth_m
    expected = F.interpolate(fitted, found.shape[-2:], mode="bilinear", antialias=True)[0]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
    true_m = F.interpolate(ground_truth(size)[None], found.shape[-2:], mode="bilinear")[0]
    right = (found / true_m / (1.3 if kind == "matches" else 1.0)).log().abs().median()
    assert right < (0.05 if kind != "both" else 0.3)


def test_all_images_have_a_prompt_or_none():
    size = SIZES["small"]
    with_points = evidence(size, given(size, 0.1, 1), None)
    with_matches = evidence(size, None, given(size, 0.5, 2, factor=1.3))
    both = depth_prompt([with_points, with_matches], DEFAULT)
    assert both.shape == (2, 1, *size)
    for found, image in zip(both, (with_points, with_matches), strict=True):
        torch.testing.assert_close(found, depth_prompt([image], DEFAULT)[0])
    assert depth_prompt([with_points, evidence(size, None, None)], DEFAULT) is None
