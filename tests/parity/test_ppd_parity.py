"""Pixel-Perfect Depth: ``geodiff convert`` and our pipeline against the authors' own code, same weights."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.cli.convert import run_convert
from geodiff_plugin.priors import find_prior
from geodiff_plugin.priors.ppd import AreaImageProcessor, PixelDiT, sampling_timesteps, semantic_tokens
from tests.parity import ppd_reference as reference
from tests.parity.named_weights import named_state

TOLERANCE = {"rtol": 0, "atol": 1e-4}


@pytest.fixture(scope="module")
def theirs():
    with np.load(Path(__file__).parent / "fixtures" / "ppd.npz") as file:
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
    found = find_prior(folder / "converted")
    assert found.key == "ppd" and found.licence == "cc-by-nc-4.0"
    pipe = found.load()
    pipe.set_progress_bar_config(disable=True)
    return pipe


@torch.no_grad()
def test_network_and_final_output_equal_the_authors(pipe, theirs):
    tokens = semantic_tokens(pipe.semantic_encoder, reference.picture())
    np.testing.assert_allclose(tokens[:, :, ::64], theirs["semantics"], **TOLERANCE)
    condition = {"image": reference.picture() - 0.5, "semantics": tokens}
    velocity = pipe.denoise(reference.noise(), torch.tensor(float(reference.MIDDLE)), condition)
    np.testing.assert_allclose(reference.corners(velocity), theirs["velocity"], **TOLERANCE)
    assert theirs["velocity"].std() > 0.5  # their initialisation would answer 0 everywhere
    call = {"num_inference_steps": reference.STEPS, "processing_resolution": 0, "latents": reference.noise()}
    out = pipe(reference.picture(), **call, output_type="pt", output_latent=True)
    for map_01 in (out.prediction, pipe.decode_relative(out.latent)):
        np.testing.assert_allclose(reference.corners(map_01), theirs["final"], **TOLERANCE)


@pytest.mark.parametrize("count", reference.COUNTS)
def test_timesteps_equal_the_authors(pipe, theirs, count):
    assert sampling_timesteps(count) == theirs[f"timesteps_{count}"].tolist()
    pipe.set_timesteps(count, torch.device("cpu"))
    assert pipe.scheduler.timesteps.tolist() == sampling_timesteps(count)
    assert len(sampling_timesteps(29)) == 29  # theirs are 30, the last one -1


@pytest.mark.parametrize("kind", reference.PHOTOGRAPHS)
def test_resizing_equals_the_authors_but_for_their_rounding(theirs, kind):
    processor = AreaImageProcessor(vae_scale_factor=16)
    resized, padding, size = processor.preprocess(Image.fromarray(reference.photograph(kind)), 1024)
    assert padding == (0, 0) and tuple(size) == reference.PHOTOGRAPHS[kind]
    assert tuple(resized.shape[-2:]) == tuple(theirs[f"{kind}_size"])
    np.testing.assert_allclose(resized[:, :, ::97, ::97] / 2 + 0.5, theirs[kind], rtol=0, atol=1.01 / 255)


def test_weights_that_do_not_fit_are_listed(folder, tmp_path):
    broken = checkpoint_of_theirs()
    broken["dit.blocks.0.attn.extra"] = broken.pop("dit.blocks.1.mlp.fc2.bias")
    torch.save(broken, tmp_path / "ppd.pth")
    encoder = folder / "depth_anything_v2_vitl.pth"
    small = {1024: 64, 3072: 192}
    shapes = {k: tuple(small.get(n, n) for n in v) for k, v in reference.semantic_shapes().items()}
    del shapes["pretrained.blocks.0.ls1.gamma"]
    torch.save(named_state(shapes), tmp_path / "encoder.pth")
    for checkpoint, told, sentence in (
        (tmp_path / "ppd.pth", encoder, "missing: blocks.1.mlp.fc2.bias; unexpected: blocks.0.attn.extra"),
        (folder / "ppd.pth", tmp_path / "encoder.pth", "layer_scale1"),
        (folder / "ppd.pth", None, "Depth-Anything-V2-Large-hf"),
    ):
        with pytest.raises(ValueError, match=re.escape(sentence)):
            run_convert([checkpoint, tmp_path / "out"], told and str(told))
        assert not (tmp_path / "out").exists()
