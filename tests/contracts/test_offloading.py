"""Offloading: the weights of every prior's networks are where they are needed when they are needed.

``enable_model_cpu_offload`` brings a network to the device when it is called. That needs a device; here a
hook of the same kind brings back weights that were taken away.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from accelerate import cpu_offload
from accelerate.hooks import ModelHook, add_hook_to_module

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from tests.contracts.tiny_priors import CALL, TINY


class BroughtWhenCalled(ModelHook):
    """Weights are NaN until the first call of the network."""

    def init_hook(self, module):
        self.weights = {name: weight.data for name, weight in module.named_parameters()}
        for weight in module.parameters():
            weight.data = torch.full_like(weight.data, torch.nan)
        return module

    def pre_forward(self, module, *args, **kwargs):
        for name, weight in module.named_parameters():
            weight.data = self.weights[name]
        return args, kwargs


@pytest.mark.parametrize("key", TINY)
def test_a_guided_call_is_what_it_is_without(key, textured_plane):
    pipe = enable_geometry_guidance(TINY[key]())

    def depth_m():
        pair, knobs = textured_plane, {"inner_steps": 1, "min_steps": 1}
        guidance, call = GeometryGuidance(pair.right, pair.K, pair.E, **knobs), CALL.get(key, {})
        return pipe(pair.left, guidance=guidance, generator=torch.manual_seed(0), **call).prediction

    expected = depth_m()
    pipe.empty_text_embedding = None  # Marigold keeps it
    for module in pipe.components.values():
        if isinstance(module, torch.nn.Module):
            add_hook_to_module(module, BroughtWhenCalled())
    assert np.array_equal(depth_m(), expected)


@pytest.mark.parametrize("key", sorted(set(TINY) - {"ppd"}))  # its encoder is not called as a whole
def test_so_is_a_plain_call_with_sequential_offloading(key, textured_plane):
    pipe = TINY[key]()

    def relative():
        return pipe(textured_plane.left, generator=torch.manual_seed(0), **CALL.get(key, {})).prediction

    expected = relative()
    pipe.empty_text_embedding = None
    for module in pipe.components.values():
        if isinstance(module, torch.nn.Module):
            cpu_offload(module, "cpu", offload_buffers=len(module._parameters) > 0)
    assert np.array_equal(relative(), expected)
