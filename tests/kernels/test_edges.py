"""The kernel of sharp depth edges against its reference, ``algorithm.edges.sharpen_edges``."""

import torch
import torch.nn.functional as F
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.algorithm.edges import sharpen_edges
from tests.kernels.drawn import drawn

#: Two sums of the same weights in another order may lie on both sides of a half: one pixel in a thousand.
MAX_DIFFERING = 1e-3


def blocks(seed: int, size: tuple[int, int], spacing: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Two maps of blurred blocks at 1 m to 8 m, a little rough, and two images with noise."""
    generator = torch.Generator().manual_seed(seed)
    coarse = 1.0 / (1.0 + 7.0 * torch.rand(2, 1, *(-(-side // 6) for side in size), generator=generator))
    inverse = F.interpolate(coarse, size, mode="nearest")
    inverse = F.avg_pool2d(F.pad(inverse, (spacing,) * 4, mode="replicate"), 2 * spacing + 1, 1)
    rough = 1.0 + 0.01 * torch.rand(inverse.shape, generator=generator)
    image = 2.0 * inverse + 0.2 * torch.rand(2, 3, *size, generator=generator)
    return rough / inverse, image.clamp(0.0, 1.0)


@drawn(2)
@given(
    seed=st.integers(0, 999),
    size=st.tuples(st.integers(3, 20), st.integers(3, 20)),
    spacing=st.integers(1, 3),
)
@example(seed=0, size=(21, 25), spacing=1)
@example(seed=1, size=(17, 23), spacing=2)
def test_ramps_of_two_maps(device, seed, size, spacing):
    depth_m, left_01 = (part.to(device) for part in blocks(seed, size, spacing))
    found = sharpen_edges(depth_m, left_01, spacing)
    with without_kernels():
        expected = sharpen_edges(depth_m, left_01, spacing)
    off = ((found / expected).log().abs() > 1e-5).float().mean()
    assert off <= MAX_DIFFERING


def test_many_pixels_of_the_example_are_ramps(device):
    depth_m, left_01 = (part.to(device) for part in blocks(0, (21, 25), 1))
    with without_kernels():
        moved = (sharpen_edges(depth_m, left_01) != depth_m).float().mean()
    assert 0.05 < moved < 0.95


def test_what_is_no_ramp_stays_bit_for_bit_in_any_type(device):
    plane = (1.0 + 0.01 * torch.arange(20.0)).expand(1, 1, 12, 20).to(device)
    for depth_m in (plane, plane.double() + 1e-12, plane.half()):
        assert torch.equal(sharpen_edges(depth_m, torch.rand(1, 3, 12, 20, device=device)), depth_m)
