"""The kernel of the scale's refinement against its reference, ``scale.points.refine_to_matches``."""

import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.constants import KERNEL_FORMS
from geodiff_plugin.scale.points import refine_to_matches
from geodiff_plugin.scale.space import SPACES
from tests.kernels.drawn import drawn


def random_matches(seed: int, space: str, size: tuple[int, int], device: torch.device):
    """Two relative maps, and matches of the first one at 1.3 m to 7 m, noisy and one in ten wrong."""
    generator = torch.Generator().manual_seed(seed)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    x = drawn(2, 1, *size)
    true = SPACES[space].depth_at(x[0], torch.tensor(1.3), torch.tensor(7.0))
    inverse = (1.0 / true) * (1 + 0.05 * (drawn(1, *size) - 0.5)) + (drawn(1, *size) > 0.9) * 0.2
    confidence = (drawn(1, *size) * (drawn(1, *size) > 0.3)).clamp_max(0.99)
    confidence[0, 0, 0] = 0.9  # one match at least
    matches = Matches(*(part.to(device) for part in (inverse, confidence, torch.tensor(0.004))))
    return x.to(device), matches


def test_every_space_has_a_formula():
    assert set(KERNEL_FORMS) == set(SPACES)


def test_a_space_without_a_formula_runs_the_reference(device, monkeypatch):
    x, matches = random_matches(0, "depth", (9, 9), device)
    start = torch.tensor([1.0, 1.0], device=device), torch.tensor([6.0, 6.0], device=device)
    monkeypatch.delitem(KERNEL_FORMS, "depth")
    found = torch.stack(refine_to_matches(x, matches, *start, "depth"))
    with without_kernels():
        assert torch.equal(found, torch.stack(refine_to_matches(x, matches, *start, "depth")))


@drawn(4)
@given(
    seed=st.integers(0, 999),
    space=st.sampled_from(sorted(SPACES)),
    size=st.tuples(st.integers(9, 45), st.integers(9, 45)),
    near=st.floats(0.6, 2.0),
)
@example(seed=0, space="depth", size=(31, 45), near=0.9)
@example(seed=1, space="log1p", size=(31, 45), near=1.2)
@example(seed=323, space="log1p", size=(28, 35), near=1.0)
def test_both_ends_of_two_maps(device, seed, space, size, near):
    x, matches = random_matches(seed, space, size, device)
    start = torch.tensor([near, near + 0.1], device=device), torch.tensor([6.0, 5.0], device=device)
    found = torch.stack(refine_to_matches(x, matches, *start, space))
    with without_kernels():
        expected = torch.stack(refine_to_matches(x, matches, *start, space))
    # The slope is a difference quotient, whose rounding errors are a thousand times those of its values: of
    # 150 drawn cases the largest differs by 2e-4, the last example by 4e-4.
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0.0)


def test_the_true_ends_are_found(device):
    """An independent oracle: exact matches of a known range."""
    x, _ = random_matches(1, "depth", (30, 40), device)
    inverse = 1.0 / (1.3 + (7.0 - 1.3) * x[0])
    matches = Matches(inverse, torch.full_like(inverse, 0.9), torch.tensor(1e-3, device=device))
    start = torch.tensor([1.1], device=device), torch.tensor([8.5], device=device)
    near, far = refine_to_matches(x[:1], matches, *start, "depth")
    torch.testing.assert_close(torch.cat([near, far]).cpu(), torch.tensor([1.3, 7.0]), rtol=1e-3, atol=0.0)


def test_without_a_match_the_ends_stay(device):
    x, matches = random_matches(0, "depth", (9, 9), device)
    nothing = Matches(matches.inverse_depth, 0.0 * matches.confidence, matches.plane_step)
    start = torch.tensor([1.0, 1.0], device=device), torch.tensor([4.0, 4.0], device=device)
    assert torch.equal(torch.stack(refine_to_matches(x, nothing, *start, "depth")), torch.stack(start))
