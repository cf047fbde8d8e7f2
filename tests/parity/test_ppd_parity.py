"""Pixel-Perfect Depth: ``geodiff convert`` and our pipeline against the authors' own code, same weights."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from geodiff_plugin.cli.results import run_convert
from geodiff_plugin.priors import find_prior
from geodiff_plugin.priors.ppd import AreaImageProcessor, PixelDiT, sampling_timesteps, semantic_tokens
from tests.parity import ppd_reference as reference
from tests.parity.named_weights import named_state

TOLERANCE = {"rtol": 0, "atol": 1e-4}
#: Depth Anything's names of its encoder's weights -> those of transformers, but for ``qkv``, three there.
ENCODER_NAMES = (
    (r"^(cls_token|mask_token)$", r"embeddings.\1"),
    (r"^pos_embed$", "embeddings.position_embeddings"),
    (r"^patch_embed\.proj\.", "embeddings.patch_embeddings.projection."),
    (r"^norm\.", "layernorm."),
    (r"^blocks\.", "encoder.layer."),
    (r"\.attn\.proj\.", ".attention.output.dense."),
    (r"\.attn\.qkv\.", ".attention.attention.qkv."),
    (r"\.ls([12])\.gamma$", r".layer_scale\1.lambda1"),
)


@pytest.fixture(scope="module")
def theirs():
    with np.load(Path(__file__).parent / "fixtures" / "ppd.npz") as file:
        return dict(file)


def checkpoint_of_theirs() -> dict[str, torch.Tensor]:
    shapes = PixelDiT(**reference.DIT).state_dict()
    return named_state({f"dit.{name}": tuple(value.shape) for name, value in shapes.items()})


def save_encoder(folder: Path, shapes: dict[str, tuple[int, ...]]) -> None:
    """The weights of ``depth_anything_v2_vitl.pth`` under the names that they have in transformers."""
    head = {"head.projects.0.bias": torch.zeros(3)}  # in the file, and no part of the encoder
    state: dict[str, torch.Tensor] = {}
    for name, value in named_state(shapes).items():
        name = name.removeprefix("pretrained.")
        for pattern, replacement in ENCODER_NAMES:
            name = re.sub(pattern, replacement, name)
        parts = (
            zip(("query", "key", "value"), value.chunk(3), strict=True) if "qkv" in name else [("", value)]
        )
        state |= {f"backbone.{name.replace('qkv', part)}": third.contiguous() for part, third in parts}
    sizes, width = reference.SEMANTICS, state["backbone.embeddings.cls_token"].shape[-1]
    backbone = {"hidden_size": width, "patch_size": 14, "image_size": sizes["img_size"]}
    backbone |= {"num_attention_heads": width // 64, "num_hidden_layers": sizes["depth"], "mlp_ratio": 1}
    folder.mkdir()
    save_file(state | head, folder / "model.safetensors")
    (folder / "config.json").write_text(json.dumps({"backbone_config": backbone}))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """From their checkpoint and an encoder, by their names, through the command."""
    folder = tmp_path_factory.mktemp("ppd")
    torch.save(checkpoint_of_theirs(), folder / "ppd.pth")
    save_encoder(folder / "da2", reference.semantic_shapes())
    run_convert([folder / "ppd.pth", folder / "converted"], str(folder / "da2"))
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
    tokens = semantic_tokens(pipe.semantic_encoder, reference.image())
    np.testing.assert_allclose(tokens[:, :, ::64], theirs["semantics"], **TOLERANCE)
    condition = {"image": reference.image() - 0.5, "semantics": tokens}
    velocity = pipe.denoise(reference.noise(), torch.tensor(float(reference.MIDDLE)), condition)
    np.testing.assert_allclose(reference.corners(velocity), theirs["velocity"], **TOLERANCE)
    assert theirs["velocity"].std() > 0.5  # their initialisation would answer 0 everywhere
    call = {"num_inference_steps": reference.STEPS, "processing_resolution": 0, "latents": reference.noise()}
    out = pipe(reference.image(), **call, output_type="pt", output_latent=True)
    for map_01 in (out.prediction, pipe.decode(out.latent)):
        np.testing.assert_allclose(reference.corners(map_01), theirs["final"], **TOLERANCE)


@pytest.mark.parametrize("count", reference.COUNTS)
def test_timesteps_equal_the_authors(pipe, theirs, count):
    assert sampling_timesteps(count) == theirs[f"timesteps_{count}"].tolist()
    pipe.set_timesteps(count, torch.device("cpu"))
    assert pipe.scheduler.timesteps.tolist() == sampling_timesteps(count)
    assert len(sampling_timesteps(29)) == 29  # theirs are 30, the last one -1


@pytest.mark.parametrize("kind", reference.PHOTOS)
def test_resizing_equals_the_authors_but_for_their_rounding(theirs, kind):
    processor = AreaImageProcessor(vae_scale_factor=16)
    resized, padding, size = processor.preprocess(Image.fromarray(reference.photo(kind)), 1024)
    assert padding == (0, 0) and tuple(size) == reference.PHOTOS[kind]
    assert tuple(resized.shape[-2:]) == tuple(theirs[f"{kind}_size"])
    np.testing.assert_allclose(resized[:, :, ::97, ::97] / 2 + 0.5, theirs[kind], rtol=0, atol=1.01 / 255)


def test_weights_that_do_not_fit_are_listed(folder, tmp_path):
    broken = checkpoint_of_theirs()
    broken["dit.blocks.0.attn.extra"] = broken.pop("dit.blocks.1.mlp.fc2.bias")
    torch.save(broken, tmp_path / "ppd.pth")
    encoder = folder / "da2"
    small = {1024: 64, 3072: 192}
    shapes = {k: tuple(small.get(n, n) for n in v) for k, v in reference.semantic_shapes().items()}
    del shapes["pretrained.blocks.0.ls1.gamma"]
    save_encoder(tmp_path / "encoder", shapes)
    for checkpoint, reported, sentence in (
        (tmp_path / "ppd.pth", encoder, "missing: blocks.1.mlp.fc2.bias; unexpected: blocks.0.attn.extra"),
        (folder / "ppd.pth", tmp_path / "encoder", "layer_scale1"),
        (folder / "ppd.pth", None, "Depth-Anything-V2-Large-hf"),
    ):
        with pytest.raises(ValueError, match=re.escape(sentence)):
            run_convert([checkpoint, tmp_path / "out"], reported and str(reported))
        assert not (tmp_path / "out").exists()
