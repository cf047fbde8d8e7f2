"""Distillation of a tiny autoencoder for the parameter ``decoder``."""

import pytest
import torch
from diffusers import AutoencoderTiny
from safetensors.torch import save_file

from examples.training import train_tiny as module
from examples.training.train_tiny import (
    build_tiny,
    distillation_loss,
    draw_maps,
    main,
    perturbed,
    train_tiny,
)
from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_bundled_prior
from geodiff_plugin.bundled import open_pipeline
from geodiff_plugin.priors.loading import BUNDLED_FOLDER


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """One shard of slanted planes with a box in front of each."""
    folder = tmp_path_factory.mktemp("cache")
    (folder / "scenes").mkdir()
    y, x = torch.meshgrid(torch.arange(72.0), torch.arange(80.0), indexing="ij")
    depth = torch.stack([2.0 + 0.05 * (n + 1) * y + 0.01 * n * x for n in range(4)])[:, None]
    depth[..., 20:50, 30:60] = 1.5
    images = torch.zeros(4, 3, 72, 80, dtype=torch.uint8)
    save_file({"images": images, "depth": depth.half()}, folder / "scenes" / "000000.safetensors")
    return folder


@pytest.fixture(scope="module")
def teacher():
    return open_pipeline(BUNDLED_FOLDER).vae.eval().requires_grad_(False)


def maps_of(cache, count=4):
    disparity = module.normalise_disparity(module.read_shard(cache, 0)[1])
    return draw_maps(disparity, count, 64, torch.Generator().manual_seed(5))


def test_crops_are_grey_and_vary(cache):
    maps = maps_of(cache, 16)
    assert maps.shape == (16, 3, 64, 64)
    assert torch.equal(maps[:, 0], maps[:, 2])
    assert maps.abs().max() <= 1.2
    near = maps[..., 32, 40] - maps[..., 2, 2]
    assert (near > 0).any() and (near < 0).any()  # some of them are turned around


def test_a_crop_is_no_larger_than_its_image():
    maps = draw_maps(torch.rand(2, 1, 24, 40), 3, 64, torch.Generator().manual_seed(0))
    assert maps.shape == (3, 3, 24, 24)


def test_perturbed_latents_stay_near():
    codes = torch.zeros(8, 4, 6, 6)
    off = perturbed(codes, torch.Generator().manual_seed(0))
    assert 0.0 < off.std() < 0.2
    assert perturbed(torch.full((2, 4, 6, 6), 3.0), torch.Generator().manual_seed(0)).mean() == pytest.approx(
        3.0, abs=0.05
    )


def test_the_student_has_the_teachers_latent(teacher):
    tiny = build_tiny(teacher, width=8)
    x = torch.zeros(1, 3, 32, 48)
    codes = tiny.encode(x).latents
    assert codes.shape == teacher.encode(x).latent_dist.mode().shape
    assert tiny.decode(codes).sample.shape == x.shape
    count = sum(p.numel() for p in build_tiny(teacher).parameters())
    assert count < sum(p.numel() for p in teacher.parameters()) / 5


@pytest.mark.slow
def test_distillation_brings_the_student_to_its_teacher(cache, teacher):
    held_out = maps_of(cache)

    def loss_of(tiny):
        with torch.no_grad():
            return float(distillation_loss(tiny, teacher, held_out, torch.Generator().manual_seed(1)))

    torch.manual_seed(0)
    before = loss_of(build_tiny(teacher, 8))
    said = []
    after = loss_of(
        train_tiny(teacher, cache, seconds=60, width=8, batch=4, rate=1e-2, steps=60, notify=said.append)
    )
    assert after < 0.6 * before
    assert not said  # fewer steps than a line takes


def test_an_empty_cache_is_an_error(tmp_path, teacher):
    with pytest.raises(ValueError, match=r"cache must be a folder with rendered shards.*training\.data"):
        train_tiny(teacher, tmp_path, seconds=1)


@pytest.mark.slow
def test_what_the_command_writes_decodes_in_a_guided_call(cache, tmp_path, textured_plane):
    folder = tmp_path / "tiny"
    options = ["--prior", str(BUNDLED_FOLDER), "--cache", str(cache), "--out", str(folder)]
    main([*options, "--steps", "3", "--batch", "2", "--width", "8"])
    assert AutoencoderTiny.from_pretrained(folder).dtype == torch.float32  # read as any folder of one
    pair = textured_plane
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, decoder=str(folder))
    out = enable_geometry_guidance(load_bundled_prior())(pair.left, guidance=guidance)
    assert torch.isfinite(torch.as_tensor(out.prediction)).all()
