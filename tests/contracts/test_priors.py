"""What every prior of the table must do, on tiny random pipelines."""

from __future__ import annotations

import copy
import json
import pickle
from functools import cache

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, disable_geometry_guidance, enable_geometry_guidance
from geodiff_plugin.algorithm.gradients import RULES, Adam
from geodiff_plugin.priors import PRIORS, find_adapter, find_prior
from geodiff_plugin.priors.map import DepthMapPipeline
from geodiff_plugin.scale.space import SPACES
from tests.contracts.tiny_priors import CALL, TINY

FAST = {"inner_steps": 3, "min_steps": 2, "weights": {"photometric": 1.0}}


@pytest.fixture
def left(textured_plane):
    return Image.fromarray(textured_plane.left)


@cache
def tiny(key: str):
    """One live pipeline per key, which every test must leave as it was."""
    return TINY[key]()


def prior_of(key: str):
    return find_adapter(tiny(key))(tiny(key))


def run(pipe, image, **kwargs):
    key = "map" if isinstance(pipe, DepthMapPipeline) else ""
    kwargs |= {"generator": torch.Generator().manual_seed(0), **CALL.get(key, {})}
    return pipe(image, output_latent=True, **kwargs)


def guidance_for(pair, **kwargs):
    return GeometryGuidance(pair.right, pair.K, pair.E, **FAST | kwargs)


def state_of(pipe) -> list:
    """What a guided call might leave behind."""
    modules = [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)]
    objects = [pipe, pipe.scheduler, *modules]
    names = [sorted(set(vars(o)) - {"_progress_bar_config", "empty_text_embedding"}) for o in objects]
    return [type(pipe), names, [p.requires_grad for m in modules for p in m.parameters()]]


def test_every_prior_has_a_tiny_one():
    assert set(TINY) == set(PRIORS)


@pytest.mark.parametrize("key", PRIORS)
def test_saved_folder_is_recognised_without_class_name(key, left, tmp_path):
    pipe = tiny(key)
    pipe.save_pretrained(tmp_path)
    index_file = tmp_path / "model_index.json"
    if index_file.is_file():
        index_file.write_text(json.dumps(json.loads(index_file.read_text()) | {"_class_name": "Anything"}))
    space = prior_of(key).space
    found = find_prior(tmp_path)
    assert found.key == key
    loaded = found.load(space=space)
    assert type(loaded) is type(pipe) and find_adapter(loaded) is PRIORS[key]
    assert find_adapter(loaded)(loaded).space == space
    loaded.set_progress_bar_config(disable=True)
    np.testing.assert_allclose(run(loaded, left).prediction, run(pipe, left).prediction, atol=1e-5)


@pytest.mark.parametrize("key", PRIORS)
def test_says_what_guidance_must_know(key, left):
    prior, pipe = prior_of(key), tiny(key)
    assert prior.space in SPACES
    assert prior.max_steps is None or prior.max_steps >= pipe.default_denoising_steps
    owner, method = prior.network()
    assert callable(getattr(owner, method))
    with torch.no_grad():
        latents = run(pipe, left).latent
    z0 = latents[:, prior.latents].detach().requires_grad_()
    x = prior.decode(z0)
    padded, _, _ = pipe.image_processor.preprocess(left, 64)
    assert x.shape == (1, 1, *padded.shape[-2:]) and x.dtype == torch.float32
    (gradient,) = torch.autograd.grad(x.sum(), z0)
    assert gradient.isfinite().all() and gradient.abs().sum() > 0


@pytest.mark.parametrize("key", PRIORS)
def test_nothing_changes_without_guidance(key, left):
    pipe = tiny(key)
    before, state = run(pipe, left), state_of(pipe)
    enable_geometry_guidance(pipe)
    try:
        within = run(pipe, left, guidance=None)
    finally:
        disable_geometry_guidance(pipe)
    assert np.array_equal(before.prediction, within.prediction)
    assert torch.equal(before.latent, within.latent)
    assert state_of(pipe) == state


@pytest.mark.parametrize("key", PRIORS)
def test_an_enabled_pipeline_can_be_copied_and_pickled(key, left):
    pipe = enable_geometry_guidance(TINY[key]())
    others = [copy.deepcopy(pipe), copy.copy(pipe)]
    if key not in ("marigold-v2", "transformers"):  # hooks of the libraries' own in them cannot be pickled
        others.append(pickle.loads(pickle.dumps(pipe)))
    expected = run(pipe, left).prediction
    for other in others:
        assert type(other) is type(pipe)
        assert vars(other).keys() == vars(pipe).keys()
        assert np.array_equal(run(other, left).prediction, expected)


@pytest.mark.parametrize("key", PRIORS)
def test_latents_that_are_no_tensor_are_refused_by_name(key, left):
    with pytest.raises((TypeError, ValueError), match="latents.* must be"):
        TINY[key]()(left, latents=[torch.zeros(4, 8, 8)])


@pytest.mark.parametrize("key", PRIORS)
def test_guided_call_lowers_the_loss_and_restores(key, left, textured_plane, monkeypatch):
    """With the gradient through the network, where it sees what is guided."""
    pipe, prior, seen = tiny(key), prior_of(key), []

    class Watched(Adam):
        def step(self, gradient, reference=None):
            seen.append(gradient.detach())
            return super().step(gradient, reference)

    monkeypatch.setitem(RULES, "watched", Watched)
    state = state_of(pipe)
    enable_geometry_guidance(pipe)
    try:
        asked = {"gradient": "full", "rule": "watched", "step_latents": 0.02}
        if prior.network_input is None:
            with pytest.raises(ValueError, match="gradient must be 'denoised'"):
                run(pipe, left, guidance=guidance_for(textured_plane, **asked))
            asked["gradient"] = "denoised"
        out = run(pipe, left, guidance=guidance_for(textured_plane, **asked))
        asked |= {"step_latents": 0.0, "step_affine": 0.0}
        still = run(pipe, left, guidance=guidance_for(textured_plane, **asked))
    finally:
        disable_geometry_guidance(pipe)
    assert state_of(pipe) == state
    assert out.prediction.shape == (1, *textured_plane.depth_m.shape, 1)
    assert np.isfinite(out.prediction).all() and (out.prediction > 0).all()
    assert len(out.history) == 2  # one report per round of updates, in two steps or in one
    assert float(out.history[-1].loss) < float(still.history[-1].loss)
    assert seen and all(g.isfinite().all() for g in seen) and all(g.abs().sum() > 0 for g in seen)


@pytest.mark.parametrize("key", PRIORS)
def test_no_gradient_step_touches_other_channels(key, left, textured_plane):
    pipe, prior = tiny(key), prior_of(key)
    if prior.latents == slice(None):
        return
    once = {"num_inference_steps": 1}
    enable_geometry_guidance(pipe)
    try:
        still, guided = (
            run(pipe, left, guidance=guidance_for(textured_plane, step_latents=rate), **once).latent
            for rate in (0.0, 0.1)
        )
    finally:
        disable_geometry_guidance(pipe)
    moved = (guided - still).abs().amax((0, 2, 3))
    assert (moved[prior.latents] > 0).all()
    others = [i for i in range(still.shape[1]) if i not in range(still.shape[1])[prior.latents]]
    assert moved[others].max() == 0


@pytest.mark.parametrize("key", PRIORS)
def test_ensemble(key, left, textured_plane):
    pipe, guidance = tiny(key), guidance_for(textured_plane, inner_steps=0, min_steps=1)
    enable_geometry_guidance(pipe)
    try:
        if prior_of(key).deterministic:
            with pytest.warns(UserWarning, match="one member runs"):
                out = run(pipe, left, guidance=guidance, ensemble_size=2, output_uncertainty=True)
            assert out.uncertainty is None and out.scale.shape == (1, 1)
            return
        out = run(pipe, left, guidance=guidance, ensemble_size=2, output_uncertainty=True)
    finally:
        disable_geometry_guidance(pipe)
    assert out.uncertainty.shape == out.prediction.shape and np.isfinite(out.uncertainty).all()
    assert out.scale.shape == (1, 2) and (out.uncertainty > 0).any()
