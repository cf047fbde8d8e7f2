"""The plane of least sum: its position alone, ties, and few planes."""

import numpy as np
import torch

from geodiff_plugin.matching.constants import NEVER
from geodiff_plugin.matching.winner import winner, winner_positions
from tests.unit.matching import references as ref


def test_positions_alone_are_those_of_the_winner_with_its_evidence():
    rng = np.random.default_rng(0)
    for planes in (1, 2, 3, 13):
        sums = rng.integers(0, 60, (planes, 9, 11)).astype(np.int16)
        levels = torch.from_numpy(rng.integers(0, 225, sums.shape).astype(np.uint8))
        seen = torch.from_numpy(rng.random(sums.shape) < 0.6)
        alone = winner_positions(torch.from_numpy(sums))
        np.testing.assert_allclose(alone, ref.positions(sums), atol=1e-5)
        found = winner(torch.from_numpy(sums.copy()), levels, seen)
        assert torch.equal(found.position, alone)
        np.testing.assert_array_equal(found.best, sums.min(0))
        if planes < 3:
            assert (found.second_best == NEVER).all()
        elif planes == 3:  # only at the ends is there a plane that is no neighbour
            middle = sums.argmin(0) == 1
            np.testing.assert_array_equal(found.second_best == NEVER, middle)


def test_where_no_view_sees_a_pixel_nothing_is_gained():
    levels = torch.full((5, 2, 3), 78, dtype=torch.uint8)
    seen = torch.zeros(5, 2, 3, dtype=torch.bool)
    found = winner(torch.full((5, 2, 3), 4 * 78, dtype=torch.int16), levels, seen)
    assert (found.gain == 0).all() and (found.sharpness == 0).all() and (found.position == 0).all()
    levels[2], seen[2:4] = 40, True  # seen on two planes, of which one costs less
    levels[3] = 60
    sums = torch.full((5, 2, 3), 500, dtype=torch.int16)
    sums[2] = 160
    gain = winner(sums, levels, seen).gain
    np.testing.assert_allclose(gain, np.full((2, 3), (50 - 40) / 224), rtol=1e-6)
