"""Pixel-Perfect Depth: ``geodiff convert`` and our pipeline against the authors' own code, same weights."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.cli.convert import run_convert
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.ppd import (
    AreaImageProcessor,
    PixelDiT,
    PPDPrior,
    sampling_timesteps,
    semantic_tokens,
)
from tests.parity import ppd_reference as reference
from tests.parity.named_weights import named_state

FIXTURE = Path(__file__).parent / "fixtures" / "ppd.npz"
TOLERANCE = {"rtol": 0, "atol": 1e-4}


@pytest.fixture(scope="module")
def theirs():
    with np.load(FIXTURE) as file:
        return dict(file)


def checkpoint_of_theirs() -> dict[str, torch.Tensor]:
    shapes = PixelDiT(**reference.DIT).state_dict()
    return named_state({f"dit.{name}": tuple(value.shape) for name, value in shapes.items()})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """From two files as theirs, by their names, through the command."""
    folder = tmp_path_factory.mktemp("ppd")
    head = {"depth_head.projects.0.bias": torch.zeros(3)}  # in the file, and no part of the encoder
    torch.save(checkpoint_of_theirs(), folder / "ppd.pth")
    torch.save(named_state(reference.semantic_shapes()) | head, folder / "depth_anything_v2_vitl.pth")
    run_convert([folder / "ppd.pth", folder / "converted"], str(folder / "depth_anything_v2_vitl.pth"))
    return folder


@pytest.fixture(scope="module")
def pipe(folder):
    layout = Layout(folder / "converted", "converted")
    assert PPDPrior.recognises(layout) and layout.licence == "cc-by-nc-4.0"
    pipe = PPDPrior.load(layout, torch.float32, None)
    pipe.set_progress_bar_config(disable=True)
    return pipe


@torch.no_grad()
def test_network_output_equals_the_authors(pipe, theirs):
    tokens = semantic_tokens(pipe.semantic_encoder, reference.picture())
    np.testing.assert_allclose(tokens[:, :, ::64], theirs["semantics"], **TOLERANCE)
    condition = {"image": reference.picture() - 0.5, "semantics": tokens}
    velocity = pipe.denoise(reference.noise(), torch.tensor(float(reference.MIDDLE)), condition)
    np.testing.assert_allclose(reference.corners(velocity), theirs["velocity"], **TOLERANCE)
    assert theirs["velocity"].std() > 0.5  # their initialisation would answer 0 everywhere


def test_final_output_equals_the_authors(pipe, theirs):
    out = pipe(
        reference.picture(),
        num_inference_steps=reference.STEPS,
        processing_resolution=0,
        latents=reference.noise(),
        output_type="pt",
        output_latent=True,
    )
    np.testing.assert_allclose(reference.corners(out.prediction), theirs["final"], **TOLERANCE)
    decoded = pipe.decode_relative(out.latent)
    np.testing.assert_allclose(reference.corners(decoded), theirs["final"], **TOLERANCE)


@pytest.mark.parametrize("count", reference.COUNTS)
def test_timesteps_equal_the_authors(pipe, theirs, count):
    assert sampling_timesteps(count) == theirs[f"timesteps_{count}"].tolist()
    pipe.set_timesteps(count, torch.device("cpu"))
    assert pipe.scheduler.timesteps.tolist() == sampling_timesteps(count)


def test_timesteps_are_as_many_as_were_asked_for():
    assert len(sampling_timesteps(29)) == 29  # theirs are 30, the last one -1


@pytest.mark.parametrize("kind", reference.PHOTOGRAPHS)
def test_resizing_equals_the_authors_but_for_their_rounding(theirs, kind):
    processor = AreaImageProcessor(vae_scale_factor=16)
    resized, padding, size = processor.preprocess(Image.fromarray(reference.photograph(kind)), 1024)
    assert padding == (0, 0) and tuple(size) == reference.PHOTOGRAPHS[kind]
    assert tuple(resized.shape[-2:]) == tuple(theirs[f"{kind}_size"])
    ours = resized[:, :, ::97, ::97] / 2 + 0.5
    np.testing.assert_allclose(ours, theirs[kind], rtol=0, atol=1.01 / 255)


def test_weights_that_do_not_fit_are_listed(folder, tmp_path):
    broken = checkpoint_of_theirs()
    broken["dit.blocks.0.attn.extra"] = broken.pop("dit.blocks.1.mlp.fc2.bias")
    torch.save(broken, tmp_path / "ppd.pth")
    encoder = str(folder / "depth_anything_v2_vitl.pth")
    message = "missing: blocks.1.mlp.fc2.bias; unexpected: blocks.0.attn.extra"
    with pytest.raises(ValueError, match=re.escape(message)):
        run_convert([tmp_path / "ppd.pth", tmp_path / "out"], encoder)


def test_an_encoder_that_lacks_weights_is_refused(folder, tmp_path):
    small = {1024: 64, 3072: 192}
    shapes = {k: tuple(small.get(n, n) for n in v) for k, v in reference.semantic_shapes().items()}
    del shapes["pretrained.blocks.0.ls1.gamma"]
    state = named_state(shapes)
    torch.save(state, tmp_path / "encoder.pth")
    with pytest.raises(ValueError, match="layer_scale1"):
        run_convert([folder / "ppd.pth", tmp_path / "out"], str(tmp_path / "encoder.pth"))


def test_without_an_encoder_the_error_says_which(folder, tmp_path):
    with pytest.raises(ValueError, match="Depth-Anything-V2-Large-hf"):
        run_convert([folder / "ppd.pth", tmp_path / "out"], None)
    assert not (tmp_path / "out").exists()
