"""Marigold V2: ``geodiff convert`` and our pipeline against the authors' own step on the same weights."""

from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLQwenImage, QwenImageTransformer2DModel
from diffusers.models.autoencoders import vae as vae_module
from safetensors.torch import save_file

from geodiff_plugin.cli.results import run_convert
from geodiff_plugin.priors import find_prior
from tests.parity import marigold_v2_reference as reference

FIXTURE = Path(__file__).parent / "fixtures" / "marigold_v2.npz"
SPACES = {"Log": "log", "Uniform": "depth", "Disparity": "disparity"}


@pytest.fixture(scope="module")
def theirs():
    with np.load(FIXTURE) as file:
        return dict(file)


@pytest.fixture(scope="module")
def downloads(tmp_path_factory):
    """Base, checkpoints and prompts, laid out as the authors' download lays them out."""
    folder = tmp_path_factory.mktemp("assets")
    transformer = QwenImageTransformer2DModel(**reference.TRANSFORMER)
    vae = AutoencoderKLQwenImage(**reference.VAE)
    transformer.load_state_dict(reference.base_state(transformer, "transformer."))
    vae.load_state_dict(reference.base_state(vae, "vae."))
    transformer.save_pretrained(folder / "base" / "transformer")
    vae.save_pretrained(folder / "base" / "vae")
    for name in reference.CHECKPOINTS:
        own = folder / "Marigold-V2" / "depth" / name
        own.mkdir(parents=True)
        save_file(reference.trainables(name, transformer, vae), own / "trainables.safetensors")
    prompts = folder / "Marigold-V2" / "qwen_text_embeddings"
    prompts.mkdir()
    for part, value in zip(("embeds", "mask"), reference.prompts(), strict=True):
        torch.save(value, prompts / f"{reference.PREFIX}_prompt_{part}.pt")
    return folder


def converted(downloads, name, dtype=torch.float32):
    """By the command, then by ``find_prior``."""
    target = downloads / f"converted-{name}"
    if not target.exists():
        checkpoint = downloads / "Marigold-V2" / "depth" / name
        run_convert([Path("marigold-v2"), downloads / "base", checkpoint, target], None)
    found = find_prior(target)
    assert found.key == "marigold-v2" and found.licence == "apache-2.0"
    pipe = found.load(dtype=dtype)
    pipe.set_progress_bar_config(disable=True)
    return pipe


@torch.no_grad()
def compare(pipe, theirs, label):
    """Latents, unclipped map (theirs is about [-1, 1], ours about [0, 1]) and final map, which it gives."""
    reported = pipe.prepare_condition(reference.image().to(pipe.dtype), 1, 1, None)
    call = {"processing_resolution": 0, "output_type": "pt", "output_latent": True}
    out = pipe(reference.image() / 2 + 0.5, **call)
    unclipped, final = 2 * pipe.decode(out.latent) - 1, 2 * out.prediction.float() - 1
    for name, ours in (
        ("image_latent", reference.keep_latent(reported["image_latent"][0])),
        ("z0", reference.keep_latent(out.latent[0])),
        ("unclipped", reference.keep(unclipped[0, 0])),
        ("final", reference.keep(final[0, 0])),
    ):
        np.testing.assert_allclose(ours, theirs[f"{label}/{name}"], rtol=0, atol=1e-4, err_msg=name)
    return final


@pytest.mark.parametrize("name", reference.CHECKPOINTS)
def test_every_checkpoint_equals_the_authors(name, downloads, theirs, monkeypatch):
    pipe = converted(downloads, name)
    assert pipe.config.prediction_type == SPACES[name.split("-")[0]]
    pipe.register_to_config(sample_latent=True)  # as their inference draws it
    monkeypatch.setattr(vae_module, "randn_tensor", lambda shape, **_: reference.posterior(tuple(shape)))
    compare(pipe, theirs, name)


def test_the_fixture_shows_checkpoints_and_clipping(theirs):
    finals, unclipped = ([theirs[f"{n}/{m}"] for n in reference.CHECKPOINTS] for m in ("final", "unclipped"))
    assert min(np.abs(a - b).max() for i, a in enumerate(finals) for b in finals[:i]) > 0.05
    assert any(np.abs(a - b).max() > 0.05 for a, b in zip(finals, unclipped, strict=True))


def test_the_mode_equals_theirs_and_bfloat16_behaves(downloads, theirs):
    exact = compare(converted(downloads, "Log-stage2"), theirs, "mode")
    pipe = converted(downloads, "Log-stage2", torch.bfloat16)
    out = pipe(reference.image() / 2 + 0.5, processing_resolution=0, output_type="pt")
    own = (2 * out.prediction.float() - 1 - exact).abs()[0, 0, ::5, ::5].numpy()
    authors = np.abs(theirs["bfloat16/final"] - theirs["mode/final"])
    assert own.mean() < 1.5 * authors.mean() and own.mean() < 0.05 * theirs["mode/final"].std()
    pipe.set_timesteps(1, torch.device("cpu"))
    reported = (pipe.scheduler.timesteps[0] / 1000).to(torch.bfloat16)
    assert reported == 0.5 == torch.full((), 499.0, dtype=torch.bfloat16) / 1000  # as theirs comes out
