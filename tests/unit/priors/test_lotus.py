"""Lotus: the task input of the network, its inputs, whole cells, and which version a folder is."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import PNDMScheduler

from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.lotus import TIMESTEP, LotusPipeline, space_of_name
from tests.contracts.tiny_priors import make_lotus


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def pipes():
    return {kind: make_lotus(kind) for kind in "gd"}


@pytest.mark.parametrize("kind", ["g", "d"])
def test_the_network_is_asked_for_depth_and_sees_the_image_before_any_noise(kind, pipes):
    pipe, image = pipes[kind], torch.rand(2, 3, 64, 64) * 2 - 1
    with torch.no_grad():
        condition = pipe.prepare_condition(image, 2, 1, torch.Generator().manual_seed(0))
        again = pipe.image_latents(image, 2, 1, torch.Generator().manual_seed(0), sample=True)
    assert torch.equal(condition["image_latent"], again) and not torch.equal(again[0], again[1])
    task = [math.sin(1), math.sin(0), math.cos(1), math.cos(0)]
    np.testing.assert_allclose(condition["class_labels"], [task] * 4, rtol=1e-6)
    assert torch.equal(condition["prompt"], pipe.prompt_embedding(again))
    seen, latents = [], torch.randn(4, 4, 8, 8)
    stand_in = SimpleNamespace(sees_latents=pipe.sees_latents, run_unet=lambda *given: seen.append(given))
    LotusPipeline.denoise(stand_in, latents, 999, condition)
    wanted = torch.cat([again, latents], dim=1) if kind == "g" else again
    assert torch.equal(seen[0][0], wanted) and seen[0][1:] == (999, condition)
    assert pipe.sees_latents == (kind == "g")
    assert pipe.network_input == (slice(None) if kind == "g" else None)


def test_a_map_is_encoded_up_to_its_last_whole_cell(pipes):
    pipe = pipes["g"]
    x = torch.rand(2, 1, 53, 70)
    with torch.no_grad():
        found, whole = pipe.encode(x), pipe.encode(x[..., :48, :64])
        assert found.shape == (2, 4, 6, 8) and torch.equal(found, whole)
        beyond = x.clone()
        beyond[..., 48:, :], beyond[..., 64:] = 0.0, 0.0
        assert torch.equal(pipe.encode(beyond), found)
        x[..., 47, 63] = 9.0
        assert not torch.equal(pipe.encode(x), found)


def test_every_channel_is_clipped_before_their_mean():
    rgb = 2 * torch.randn(2, 3, 5, 6)
    found = LotusPipeline.decode_prediction(SimpleNamespace(decode_image=lambda z: rgb), None)
    wanted = (np.clip(rgb.numpy(), -1, 1).mean(1, keepdims=True) + 1) / 2
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


def test_a_scheduler_of_noise_prediction_is_replaced_and_networks_of_others_are_rejected(pipes):
    parts = dict(pipes["g"].components)
    own = DirectScheduler(timestep=5)
    kept = LotusPipeline(**parts | {"scheduler": own}, prediction_type="depth")
    assert kept.scheduler is own and kept.space == "depth"
    replaced = LotusPipeline(**parts | {"scheduler": PNDMScheduler()}, prediction_type="disparity")
    assert isinstance(replaced.scheduler, DirectScheduler) and replaced.scheduler.timesteps.tolist() == [999]
    assert TIMESTEP == 999 and replaced.space == "disparity"
    for channels, task in ((8, 5), (5, 4), (9, 4), (8, None)):
        sizes = {"in_channels": channels, "projection_class_embeddings_input_dim": task}
        unet = SimpleNamespace(config=SimpleNamespace(**sizes))
        with pytest.raises(ValueError, match=f"got {channels} channels, {task}-d class embedding"):
            LotusPipeline(**parts | {"unet": unet}, prediction_type="depth")
    for space in (None, "log"):
        with pytest.raises(
            ValueError, match=f"prediction_type must be 'depth' or 'disparity'; got {space!r}"
        ):
            LotusPipeline(**parts, prediction_type=space)


def test_the_space_is_from_the_user_the_index_or_the_name_in_this_order(tmp_path, pipes):
    folder = tmp_path / "lotus-depth-g-v1-0"
    pipes["g"].save_pretrained(folder)
    layout = Layout(folder, str(folder))
    assert LotusPipeline.load(layout, torch.float32, "depth").space == "depth"
    loaded = LotusPipeline.load(layout, torch.bfloat16, None)
    assert (loaded.space, loaded.dtype, loaded.scheduler.config.timestep) == (
        "disparity",
        torch.bfloat16,
        999,
    )
    index = json.loads((folder / "model_index.json").read_text())
    del index["prediction_type"]
    (folder / "model_index.json").write_text(json.dumps(index))
    assert LotusPipeline.load(Layout(folder, str(folder)), torch.float32, None).space == "depth"
    for name, words in (("x", "got 'x'. Only the name"), ("a/lotus", "a name like its authors'")):
        with pytest.raises(ValueError, match=words):
            LotusPipeline.load(Layout(folder, name), torch.float32, None)


@pytest.mark.parametrize(
    ("name", "space"),
    [
        ("jingheya/lotus-depth-g-v2-1-disparity", "disparity"),
        ("Jingheya/Lotus-Depth-D-v2-0-Disparity", "disparity"),
        ("jingheya/lotus-depth-g-v1-0", "depth"),
        (r"C:\priors\lotus-depth-d-v1-0", "depth"),
        (r"C:\lotus-disparity\lotus-depth-d-v1-0", "depth"),
        ("lotus-depth-g-v1-0/lotus-depth-g-v2-1-disparity/snapshots/abc", "disparity"),
    ],
)
def test_the_last_folder_that_names_lotus_sets_the_space(name, space):
    assert space_of_name(name) == space


def test_the_task_is_made_on_the_cpu_whatever_the_default_device_is():
    latents = torch.zeros(2, 4, 3, 3, dtype=torch.bfloat16)
    pipe = SimpleNamespace(image_latents=lambda *_, **reported: latents, prompt_embedding=lambda like: like)
    with torch.device("meta"):
        labels = LotusPipeline.prepare_condition(pipe, None, 2, 1, None)["class_labels"]
    wanted = torch.tensor([math.sin(1), 0, math.cos(1), 1]).bfloat16()
    assert torch.equal(labels, wanted.expand(2, 4)) and labels.dtype == torch.bfloat16
