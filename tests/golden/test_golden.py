"""Results that no change of the structure may move (``make.py`` freezes them again)."""

import json

import numpy as np
import pytest

from tests.golden.cases import CASES, DATA, NEEDS_DATA
from tests.golden.make import STORED, summary

FROZEN = json.loads(STORED.read_text())
#: Relative difference of a quantile that another processor may make, and the same of flags and small numbers.
TOLERANCE, NEAR_ZERO = 0.02, 0.02
NEEDS_POSELIB = {"estimated_pose"}
#: One of each way through the method; ``test_parts.py`` guards its numbers closer, and the rest is slow.
FAST = (
    "default_bundled_pair",
    "plain_wall",
    "preset_paper",
    "preset_marigold_dc",
    "points_and_view",
    "three_views",
)


# The verdict is one of the frozen results: of some cases it is that they are not to be trusted.
@pytest.mark.filterwarnings("ignore:(Image .. )?Do not trust this depth:UserWarning")
@pytest.mark.parametrize(
    "name", [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_result_is_the_frozen_one(name: str) -> None:
    if name in NEEDS_DATA and not DATA.is_dir():
        pytest.skip("the real pairs are not here")
    if name in NEEDS_POSELIB:
        pytest.importorskip("poselib")
    results, frozen = CASES[name](), FROZEN["cases"][name]
    assert set(results) == set(frozen)
    for key, value in results.items():
        now, then = summary(value), frozen[key]
        if isinstance(value, str):
            assert now == then, f"{name}.{key} moved"
            continue
        assert now["shape"] == then["shape"]
        np.testing.assert_allclose(
            now["numbers"], then["numbers"], rtol=TOLERANCE, atol=NEAR_ZERO, err_msg=f"{name}.{key}"
        )
