"""The kernel of the group norm, in Triton's interpreter, against the norm's definition in NumPy."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.unit.runtime.triton_interpreter import interpreted


@pytest.mark.parametrize(
    ("block", "most_parts", "shape", "groups"),
    [(8, 64, (2, 6, 5, 3), 3), (8, 2, (1, 6, 5, 3), 2), (2048, 64, (2, 4, 2), 4)],
)
def test_groups_are_normalised_and_channels_scaled_and_shifted(monkeypatch, block, most_parts, shape, groups):
    """Groups of one part and of several, whose last one is not full; ``eps`` is about the variance."""
    rng = np.random.default_rng(0)
    x = (0.3 * rng.normal(size=shape) + 2.0).astype(np.float32)
    weight, bias = rng.uniform(0.5, 2.0, shape[1]), rng.normal(size=shape[1])
    grouped = x.reshape(shape[0], groups, -1).astype(np.float64)
    mean, variance = grouped.mean(-1, keepdims=True), grouped.var(-1, keepdims=True)
    channels = (1, shape[1]) + (1,) * (len(shape) - 2)
    expected = ((grouped - mean) / np.sqrt(variance + 0.05)).reshape(shape)
    expected = expected * weight.reshape(channels) + bias.reshape(channels)
    with interpreted("geodiff_plugin.runtime.kernels.group_norm") as kernels:
        monkeypatch.setattr(kernels, "BLOCK", block)
        monkeypatch.setattr(kernels, "MAX_PARTS", most_parts)
        given = (torch.from_numpy(each.astype(np.float32)) for each in (x, weight, bias))
        x, weight, bias = given
        # Values behind the end of what it may write.
        memory = torch.full((x.numel() + 8,), 77.0)
        monkeypatch.setattr(torch, "empty_like", lambda x: memory[: x.numel()].view_as(x))
        norm = SimpleNamespace(num_groups=groups, weight=weight, bias=bias, eps=0.05)
        found = kernels.group_norm(norm, pytest.fail, x)
    assert (memory[-8:] == 77.0).all()
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-4, atol=1e-4)


def test_sizes_of_blocks_are_powers_of_two_as_triton_needs_them():
    with interpreted("geodiff_plugin.runtime.kernels.group_norm") as kernels:
        for size in (kernels.BLOCK, kernels.MAX_PARTS):
            assert size > 1 and size & (size - 1) == 0
