"""Numbers of the method's parts, stored (``make.py --parts`` makes them again)."""

import json

import numpy as np
import pytest

from tests.golden.make import FEW, STORED_PARTS, part_summary
from tests.golden.parts import PARTS

FROZEN = json.loads(STORED_PARTS.read_text())
#: Of an array's own size, and of its spread, by which processors may round it differently.
RELATIVE, OF_SPREAD = 2e-3, 5e-3


@pytest.mark.parametrize("name", PARTS)
def test_numbers_are_the_frozen_ones(name: str) -> None:
    results, frozen = PARTS[name](), FROZEN[name]
    assert set(results) == set(frozen)
    for key, value in results.items():
        now, then = part_summary(value), frozen[key]
        if isinstance(now, str):
            assert now == then, f"{name}.{key}"
        else:
            near_zero = OF_SPREAD * then[1] if np.asarray(value).size > FEW else 1e-4 * np.abs(then).max()
            np.testing.assert_allclose(
                now, then, rtol=RELATIVE, atol=near_zero + 1e-9, err_msg=f"{name}.{key}"
            )
