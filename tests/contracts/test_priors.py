"""What every prior of the table must do, on tiny random pipelines."""

import copy
import json
from contextlib import contextmanager, nullcontext
from functools import cache

import numpy as np
import pytest
import torch
from accelerate import cpu_offload
from accelerate.hooks import ModelHook, add_hook_to_module
from PIL import Image

from geodiff_plugin import GeometryGuidance, disable_geometry_guidance, enable_geometry_guidance
from geodiff_plugin.algorithm.optimizers import OPTIMIZERS, Adam
from geodiff_plugin.priors import PRIORS, find_prior, prior_of
from geodiff_plugin.priors.map import DepthMapPipeline
from geodiff_plugin.scale.space import SPACES
from tests.contracts.tiny_priors import CALL, TINY

FAST = {"guidance_steps": 3, "min_steps": 2, "weights": {"photometric": 1.0}}
pytestmark = pytest.mark.parametrize("key", PRIORS)


@pytest.fixture
def left(textured_plane):
    return Image.fromarray(textured_plane.left)


@cache
def tiny(key: str):
    """One live pipeline per key, which every test must leave as it was."""
    return TINY[key]()


@contextmanager
def enabled(key: str):
    try:
        yield enable_geometry_guidance(tiny(key))
    finally:
        disable_geometry_guidance(tiny(key))


def run(pipe, image, **kwargs):
    reported = CALL["map"] if isinstance(pipe, DepthMapPipeline) else {}
    return pipe(image, output_latent=True, generator=torch.Generator().manual_seed(0), **reported, **kwargs)


def guidance_for(pair, **kwargs):
    return GeometryGuidance(pair.right, pair.K, pair.E, **FAST | kwargs)


def modules_of(pipe) -> list[torch.nn.Module]:
    return [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)]


def state_of(pipe) -> list:
    """What a guided call might leave behind."""
    modules = modules_of(pipe)
    objects = [pipe, pipe.scheduler, *modules]
    names = [sorted(set(vars(o)) - {"_progress_bar_config", "empty_text_embedding"}) for o in objects]
    return [type(pipe), names, [p.requires_grad for m in modules for p in m.parameters()]]


def test_a_saved_folder_is_recognised_without_class_name(key, left, tmp_path):
    pipe = tiny(key)
    pipe.save_pretrained(tmp_path)
    index_file = tmp_path / "model_index.json"
    index_file.write_text(json.dumps(json.loads(index_file.read_text()) | {"_class_name": "Anything"}))
    space = prior_of(tiny(key)).space
    found = find_prior(tmp_path)
    assert found.key == key
    loaded = found.load(space=space)
    assert type(loaded) is type(pipe) and type(prior_of(loaded)) is PRIORS[key]
    assert prior_of(loaded).space == space
    loaded.set_progress_bar_config(disable=True)
    np.testing.assert_allclose(run(loaded, left).prediction, run(pipe, left).prediction, atol=1e-5)


def test_it_declares_what_guidance_needs(key, left):
    prior, pipe = prior_of(tiny(key)), tiny(key)
    assert prior.space in SPACES
    assert prior.max_steps is None or prior.max_steps >= pipe.default_denoising_steps
    owner, method = prior.network()
    assert callable(getattr(owner, method))
    with torch.no_grad():
        latents = run(pipe, left).latent
    z0 = latents[:, prior.depth_channels].detach().requires_grad_()
    x = prior.decode(z0)
    padded, _, _ = pipe.image_processor.preprocess(left, 64)
    assert x.shape == (1, 1, *padded.shape[-2:]) and x.dtype == torch.float32
    (gradient,) = torch.autograd.grad(x.sum(), z0)
    assert gradient.isfinite().all() and gradient.abs().sum() > 0


def test_nothing_changes_without_guidance_nor_in_a_copy(key, left):
    before, state = run(tiny(key), left), state_of(tiny(key))
    with enabled(key) as pipe:
        within = run(pipe, left, guidance=None)
        copies = [copy.deepcopy(pipe), copy.copy(pipe)]
    for found in (within, *(run(other, left) for other in copies)):
        assert np.array_equal(before.prediction, found.prediction)
        assert torch.equal(before.latent, found.latent)
    assert state_of(pipe) == state


def test_latents_that_are_no_tensor_are_rejected_by_name(key, left):
    with pytest.raises((TypeError, ValueError), match="latents.* must be"):
        tiny(key)(left, latents=[torch.zeros(4, 8, 8)], **CALL.get(key, {}))


def test_guided_call_lowers_the_loss_and_restores(key, left, textured_plane, monkeypatch):
    """With the gradient through the network, where it sees what is guided."""
    prior, seen = prior_of(tiny(key)), []

    class Watched(Adam):
        def step(self, gradient, reference=None):
            seen.append(gradient.detach())
            return super().step(gradient, reference)

    monkeypatch.setitem(OPTIMIZERS, "watched", Watched)
    state = state_of(tiny(key))
    with enabled(key) as pipe:
        asked = {"gradient": "full", "optimizer": "watched", "lr_latents": 0.02}
        if prior.network_input is None:
            with pytest.raises(ValueError, match="gradient must be 'denoised'"):
                run(pipe, left, guidance=guidance_for(textured_plane, **asked))
            asked["gradient"] = "denoised"
        out = run(pipe, left, guidance=guidance_for(textured_plane, **asked))
        asked |= {"lr_latents": 0.0, "lr_affine": 0.0}
        still = run(pipe, left, guidance=guidance_for(textured_plane, **asked))
    assert state_of(tiny(key)) == state
    assert out.prediction.shape == (1, *textured_plane.depth_m.shape, 1)
    assert np.isfinite(out.prediction).all() and (out.prediction > 0).all()
    assert len(out.history) == 2  # one report per round of updates, in two steps or in one
    assert float(out.history[-1].loss) < float(still.history[-1].loss)
    assert seen and all(g.isfinite().all() for g in seen) and all(g.abs().sum() > 0 for g in seen)


def test_no_gradient_step_touches_other_channels(key, left, textured_plane):
    channels = prior_of(tiny(key)).depth_channels
    if channels == slice(None):
        return
    with enabled(key) as pipe:
        still, guided = (
            run(pipe, left, guidance=guidance_for(textured_plane, lr_latents=rate), num_inference_steps=1)
            for rate in (0.0, 0.1)
        )
    moved = (guided.latent - still.latent).abs().amax((0, 2, 3))
    assert (moved[channels] > 0).all()
    others = [i for i in range(len(moved)) if i not in range(len(moved))[channels]]
    assert moved[others].max() == 0


def test_an_ensemble_has_a_spread_or_one_member(key, left, textured_plane):
    guidance = guidance_for(textured_plane, guidance_steps=0, min_steps=1)
    once = prior_of(tiny(key)).deterministic
    said = pytest.warns(UserWarning, match="one ensemble member is computed") if once else nullcontext()
    with enabled(key) as pipe, said:
        out = run(pipe, left, guidance=guidance, ensemble_size=2, output_uncertainty=True)
    assert out.scale.shape == (1, 1 if once else 2)
    if once:
        assert out.uncertainty is None
        return
    assert out.uncertainty.shape == out.prediction.shape and np.isfinite(out.uncertainty).all()
    assert (out.uncertainty > 0).any()


class BroughtWhenCalled(ModelHook):
    """As ``enable_model_cpu_offload``, without a device: weights are NaN until the network is called."""

    def init_hook(self, module):
        self.weights = {name: weight.data for name, weight in module.named_parameters()}
        for weight in module.parameters():
            weight.data = torch.full_like(weight.data, torch.nan)
        return module

    def pre_forward(self, module, *args, **kwargs):
        for name, weight in module.named_parameters():
            weight.data = self.weights[name]
        return args, kwargs


@pytest.mark.parametrize("guided", [True, False])
def test_offloaded_weights_are_there_when_they_are_needed(key, guided, left, textured_plane):
    """By model in a guided call, sequentially in a plain one."""
    if key == "ppd" and not guided:
        pytest.skip("its encoder is not called as a whole")
    pipe, reported = enable_geometry_guidance(TINY[key]()), {}
    if guided:
        reported["guidance"] = guidance_for(textured_plane, guidance_steps=1, min_steps=1)
    expected = run(pipe, left, **reported).prediction
    pipe.empty_text_embedding = None  # Marigold keeps it
    for module in modules_of(pipe):
        if guided:
            add_hook_to_module(module, BroughtWhenCalled())
        else:
            cpu_offload(module, "cpu", offload_buffers=len(module._parameters) > 0)
    assert np.array_equal(run(pipe, left, **reported).prediction, expected)
