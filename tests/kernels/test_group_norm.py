"""The kernel of the group norm against ``torch.nn.functional.group_norm``."""

from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from hypothesis import example, given
from hypothesis import strategies as st

from tests.kernels.drawn import drawn

#: Largest difference by number format: rounding of the result, or of sums in another order.
TOLERANCES = {torch.float32: 2e-5, torch.float16: 4e-3, torch.bfloat16: 4e-2}


@drawn(5)
@given(
    seed=st.integers(0, 999),
    batch=st.integers(1, 2),
    groups=st.sampled_from([1, 3]),
    channels=st.integers(1, 3),
    size=st.tuples(st.integers(1, 24), st.integers(2, 24)),
    dtype=st.sampled_from(sorted(TOLERANCES, key=str)),
)
@example(seed=0, batch=2, groups=3, channels=2, size=(23, 24), dtype=torch.bfloat16)
@example(seed=0, batch=1, groups=1, channels=3, size=(24, 7), dtype=torch.float16)
def test_any_size_and_number_format(device, seed, batch, groups, channels, size, dtype):
    kernels = pytest.importorskip("geodiff_plugin.runtime.kernels.group_norm")
    generator = torch.Generator().manual_seed(seed)
    x = 3 * torch.randn(batch, groups * channels, *size, generator=generator) + 1
    weight, bias = (torch.randn(groups * channels, generator=generator) for _ in range(2))
    x, weight, bias = (value.to(device, dtype) for value in (x, weight, bias))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "BLOCK", 128)  # so that a small group has several parts
        norm = SimpleNamespace(num_groups=groups, weight=weight, bias=bias, eps=1e-6)
        found = kernels.group_norm(norm, pytest.fail, x)
    expected = F.group_norm(x.float(), groups, weight.float(), bias.float(), 1e-6)
    assert found.dtype == dtype
    scale = expected.abs().amax().clamp_min(1.0)
    assert (found.float() - expected).abs().max() <= TOLERANCES[dtype] * scale
