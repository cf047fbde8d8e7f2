"""What a call reads of a pipeline's layers: each once, their weights, and where these lie."""

import pytest
import torch
from accelerate.hooks import ModelHook, add_hook_to_module, remove_hook_from_module
from diffusers import DiffusionPipeline

from geodiff_plugin import enable_geometry_guidance
from geodiff_plugin.runtime.hooks import Layers, frozen_weights, layers_of, networks_of, weights_of

pytestmark = pytest.mark.end_to_end


def test_layers_and_weights_are_those_of_torch_each_once(pipe):
    shared = torch.nn.Linear(2, 2)
    twice = torch.nn.ModuleDict({"a": shared, "b": torch.nn.Sequential(shared, torch.nn.Identity())})
    twice["c"] = torch.nn.Linear(2, 2)
    twice["c"].weight = shared.weight
    twice.register_module("none", None)
    for network in (*networks_of(pipe), twice):
        layers = layers_of(network)
        assert sorted(map(id, layers)) == sorted(map(id, network.modules()))
        assert sorted(map(id, weights_of(layers))) == sorted(map(id, network.parameters()))
    assert len(weights_of(layers_of(twice))) == 3


def test_weights_are_frozen_in_the_block_and_afterwards_as_they_were(pipe):
    weights = [weight for network in networks_of(pipe) for weight in network.parameters()]
    for i, weight in enumerate(weights):
        weight.requires_grad_(i % 3 == 0)
    with pytest.raises(KeyError), frozen_weights(pipe):
        assert not any(weight.requires_grad for weight in weights)
        raise KeyError
    assert [weight.requires_grad for weight in weights] == [i % 3 == 0 for i in range(len(weights))]


def test_the_device_is_the_stock_pipelines_which_is_asked_where_hooks_or_several_devices_are(pipe):
    enable_geometry_guidance(pipe)
    stock = DiffusionPipeline._execution_device.fget
    assert Layers.of(pipe).device == stock(pipe) == pipe._execution_device == torch.device("cpu")
    hook = ModelHook()
    hook.execution_device = torch.device("meta")
    add_hook_to_module(pipe.unet, hook)
    assert Layers.of(pipe).device is None and pipe._execution_device == stock(pipe) == torch.device("meta")
    remove_hook_from_module(pipe.unet)
    assert Layers.of(pipe).device == torch.device("cpu")
    pipe.vae.to("meta")
    assert Layers.of(pipe).device is None and pipe._execution_device == stock(pipe)
