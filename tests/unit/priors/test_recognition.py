"""Which configs each prior recognises, one changed entry at a time, and closed forms of their parts."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin.priors.depthfm import DepthFMPipeline
from geodiff_plugin.priors.depthmaster import DepthMasterPipeline
from geodiff_plugin.priors.geowizard import GeoWizardPipeline, _unet_folder, class_embedding
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.lotus import LotusPipeline
from geodiff_plugin.priors.marigold import MarigoldPrior
from geodiff_plugin.priors.marigold_v2 import MarigoldV2Pipeline
from geodiff_plugin.priors.ppd import PPDPipeline, sampling_timesteps

LOTUS = {"class_embed_type": "projection", "projection_class_embeddings_input_dim": 4, "in_channels": 8}
LOTUS |= {"_class_name": "UNet2DConditionModel"}
MARIGOLD = {"in_channels": 8, "out_channels": 4}
V1 = MARIGOLD | {"projection_class_embeddings_input_dim": 10}
V2 = MARIGOLD | {"projection_class_embeddings_input_dim": 4}
TEXT = {"text_encoder": ["transformers", "CLIPTextModel"]}
FLOW = {"scheduler": {"shift": 1.0}, "prompt": {"length": 3}}
QWEN = {"transformer": {"joint_attention_dim": 8}, "vae": {"latents_mean": [0]}, "prompt": {"length": 3}}
PIXELS = {"dit": {"semantic_size": 8}, "semantic_encoder": {"model_type": "dinov2"}}
CASES = [
    (LotusPipeline, {"unet": LOTUS}, {}, True),
    (LotusPipeline, {"unet": LOTUS | {"in_channels": 4}}, {}, True),
    *((LotusPipeline, {"unet": LOTUS | {name: 9}}, {}, False) for name in LOTUS),
    (MarigoldPrior, {"unet": MARIGOLD}, TEXT, True),
    (
        MarigoldPrior,
        {"unet": {"in_channels": 32, "out_channels": 16}, "vae": {"latent_channels": 16}},
        TEXT,
        True,
    ),
    (MarigoldPrior, {"unet": MARIGOLD, "vae": {"latent_channels": 16}}, TEXT, False),
    (MarigoldPrior, {"unet": MARIGOLD}, {}, False),
    *((MarigoldPrior, {"unet": MARIGOLD | {n: 9}}, TEXT, False) for n in (*MARIGOLD, "class_embed_type")),
    (GeoWizardPipeline, {"unet": V1}, {}, True),
    (GeoWizardPipeline, {"unet": V2}, {"default_domain": "indoor"}, True),
    (GeoWizardPipeline, {"unet": V2}, {}, False),
    (GeoWizardPipeline, {"unet_v2": V2}, {}, True),
    (GeoWizardPipeline, {"unet": V1, "unet_v2": V2}, {}, True),
    (GeoWizardPipeline, {"unet": MARIGOLD}, {"default_domain": "indoor"}, False),
    *((GeoWizardPipeline, {"unet": V1 | {name: 9}}, {}, False) for name in V1),
    (DepthFMPipeline, {"unet": {"in_channels": 8}} | FLOW, {}, True),
    (DepthFMPipeline, {"unet": {"in_channels": 4}} | FLOW, {}, False),
    *(
        (DepthFMPipeline, {"unet": {"in_channels": 8}} | FLOW | {name: {"x": 1}}, {}, name == "prompt")
        for name in FLOW
    ),
    (DepthFMPipeline, {"unet": {"in_channels": 8}, "scheduler": {"shift": 1.0}}, {}, False),
    (DepthMasterPipeline, {"unet": {"in_channels": 4}}, TEXT, True),
    (DepthMasterPipeline, {"unet": {"in_channels": 8}}, TEXT, False),
    (DepthMasterPipeline, {"unet": {"in_channels": 4, "class_embed_type": "projection"}}, TEXT, False),
    (DepthMasterPipeline, {"unet": {"in_channels": 4}}, TEXT | {"scheduler": ["diffusers", "x"]}, False),
    (DepthMasterPipeline, {"unet": {"in_channels": 4}}, {}, False),
    (MarigoldV2Pipeline, QWEN, {}, True),
    *((MarigoldV2Pipeline, {k: v for k, v in QWEN.items() if k != name}, {}, False) for name in QWEN),
    (PPDPipeline, PIXELS, {}, True),
    (PPDPipeline, PIXELS | {"dit": {}}, {}, False),
    (PPDPipeline, PIXELS | {"semantic_encoder": {"model_type": "clip"}}, {}, False),
]


@pytest.mark.parametrize(("adapter", "configs", "index", "expected"), CASES)
def test_a_folder_is_recognised_by_each_of_its_typical_entries(tmp_path, adapter, configs, index, expected):
    for name, config in configs.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(json.dumps(config))
    (tmp_path / "model_index.json").write_text(json.dumps(index))
    assert adapter.recognises(Layout(tmp_path, "x")) is expected


def test_the_authors_folder_of_the_second_version_counts_where_it_is_alone(tmp_path):
    layout = Layout(tmp_path, "x")
    found = [_unet_folder(layout)]
    for name in ("unet_v2", "unet"):
        (tmp_path / name).mkdir()
        found.append(_unet_folder(layout))
    assert found == ["unet", "unet_v2", "unet"]


@pytest.mark.parametrize("domain", [None, "indoor", "outdoor", "object"])
def test_class_embeddings_are_sines_and_cosines_of_one_hot_codes(domain):
    places = ("indoor", "outdoor", "object")
    for row, kind in zip(class_embedding(domain).numpy(), ((0, 1), (1, 0)), strict=True):
        expected = [f(x) for f in (math.sin, math.cos) for x in kind]
        if domain is not None:
            expected += [f(float(place == domain)) for f in (math.sin, math.cos) for place in places]
        np.testing.assert_allclose(row, expected, rtol=1e-6)


@pytest.mark.parametrize("step", [1, 250, 400, 900])
def test_the_flow_starts_on_the_cosine_schedule(step):
    """alpha_bar = cos^2 (pi t / 2): image and noise keep their total variance."""
    pipe = SimpleNamespace(config=SimpleNamespace(noising_step=step))
    one, zero = torch.ones(1, 1, 1, 1), torch.zeros(1, 1, 1, 1)
    image, noise = (float(DepthFMPipeline.add_noise(pipe, *pair)) for pair in ((one, zero), (zero, one)))
    assert image == pytest.approx(math.cos(math.pi * step / 2000), abs=2e-5)
    assert image**2 + noise**2 == pytest.approx(1)


def test_pixel_timesteps_fall_from_1000_in_equal_steps():
    assert sampling_timesteps(4) == [1000, 750, 500, 249] and sampling_timesteps(1) == [1000]
    for steps in (2, 3, 7, 20, 50):
        times = sampling_timesteps(steps)
        np.testing.assert_allclose(times, 1000 - np.arange(steps) * 1001 / steps, atol=0.51)
        assert min(times) >= 0
