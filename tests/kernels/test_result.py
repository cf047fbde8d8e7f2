"""The kernels of act 3 against their references."""

import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._kernels import without_kernels
from geodiff_plugin.matching.rows import RowMatches
from geodiff_plugin.result.voting import Voters, _voted
from tests.kernels.drawn import drawn


def random_voters(seed: int, size: tuple[int, int], device: torch.device) -> tuple[Voters, torch.Tensor]:
    """Matches around a map of 2 m to 6 m, some of them wrong, and a picture."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator).to(device)

    depth_m, px = 2.0 + 4.0 * rand(*size), torch.tensor(60.0)
    near_it, wrong = 1.0 + 0.1 * rand(*size), rand(*size) > 0.8
    inverse_depth = torch.where(wrong, rand(*size), near_it / depth_m)
    confidence = rand(*size) * (rand(*size) > 0.3) + 3.0 * (rand(*size) > 0.95)  # some known points
    matched = (rand(*size) > 0.5).float()
    shift = px.to(device) / depth_m * (1.0 + 0.1 * rand(*size))
    rows = RowMatches(shift, matched, (1.0 - matched) * (rand(*size) > 0.5), torch.tensor(0.1))
    return Voters(depth_m, inverse_depth, confidence, rand(*size), rows, px), rand(3, *size)


@drawn(3)
@given(
    seed=st.integers(0, 999),
    size=st.tuples(st.integers(2, 30), st.integers(2, 30)),
    error=st.floats(0.01, 0.3),
    map_vote=st.floats(0.01, 2.0),
)
@example(seed=0, size=(21, 33), error=0.08, map_vote=0.05)
@example(seed=1, size=(17, 9), error=0.02, map_vote=1.5)
def test_votes(device, seed, size, error, map_vote):
    voters, left = random_voters(seed, size, device)
    numbers = (torch.tensor(value, device=device) for value in (error, map_vote))
    error, map_vote = numbers
    found = _voted(voters, left, error, map_vote)
    with without_kernels():
        expected = _voted(voters, left, error, map_vote)
    # Where a half of the weight is reached is found by comparing sums, which rounding may decide otherwise.
    off = ((found - expected).abs() > 1e-5 * expected.abs().amax()).float().mean()
    assert off <= 5e-3 and found.isfinite().all()
