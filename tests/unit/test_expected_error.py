"""The error that the geometry lets a matched depth have, against triangulation of shifted matches."""

import numpy as np
import pytest

from geodiff_plugin.runtime.confidence import MATCH_NOISE_PX, expected_error

K = np.array([[80.0, 0, 20.5], [0, 95.0, 11.0], [0, 0, 1]])


def pose(x: float, y: float, z: float) -> np.ndarray:
    E = np.eye(4)
    E[:3, 3] = x, y, z
    return E


@pytest.mark.parametrize("moved", [(0.12, 0, 0), (0, -0.2, 0), (0.1, 0.05, 0.3), (0.02, 0.01, -0.4)])
def test_a_match_shifted_by_its_noise_gives_it(moved):
    E, row, column, z = pose(*moved), 3, 35, 4.0

    def seen(depth):
        x = np.linalg.inv(K) @ [column, row, 1] * depth - E[:3, 3]
        return (K @ x / x[2])[:2]

    pixels_a_metre = np.linalg.norm(seen(z + 1e-5) - seen(z - 1e-5)) / 2e-5
    error = expected_error(np.full((24, 40), z), K, [E])[row, column]
    assert error == pytest.approx(MATCH_NOISE_PX / pixels_a_metre, rel=1e-6)
