"""Memory is counted by running fake tensors; on tiny networks it can be checked."""

import pytest
import torch

from geodiff_plugin.priors import PRIORS
from tests.benchmarks.full_sizes import FULL_SIZES
from tests.benchmarks.memory import count_memory
from tests.contracts.tiny_priors import TINY


@pytest.mark.parametrize("key", [pytest.param("marigold", marks=pytest.mark.slow), "depthmaster"])
def test_gradients_cost_memory(key, monkeypatch):
    monkeypatch.setitem(FULL_SIZES, key, TINY[key])
    assert set(FULL_SIZES) == set(PRIORS) - {"map"}  # which has no network
    found, parts = count_memory(key), TINY[key]().components.values()
    real = sum(p.numel() for m in parts if isinstance(m, torch.nn.Module) for p in m.parameters())
    assert found.parameters == real and found.weights == 2 * real  # bfloat16
    assert 0 < found.plain < found.denoised
    assert found.full is None if key == "depthmaster" else found.full > found.denoised
