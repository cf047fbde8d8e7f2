"""Between latents and maps: padding, autoencoders, and what the scheduler's step is given after a move."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import AutoencoderTiny

from geodiff_plugin.algorithm.denoising import NoiseLevel, noise_from, z0_from
from geodiff_plugin.runtime import codec
from geodiff_plugin.runtime.codec import (
    PUBLISHED,
    LatentGrid,
    MapCodec,
    ProcessingGrid,
    StepEstimate,
    tiny_autoencoder,
)
from tests.tiny import make_vae


def drawn(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_a_map_is_padded_below_and_to_the_right_by_its_last_row_and_column():
    grid = ProcessingGrid((5, 9), (3, 2))
    assert grid.size == (8, 11)
    x = drawn(2, 1, 5, 9, seed=1)
    expected = np.pad(x.numpy(), ((0, 0), (0, 0), (0, 3), (0, 2)), mode="edge")
    np.testing.assert_array_equal(grid.padded(x), expected)
    assert torch.equal(grid.cropped(grid.padded(x)), x)
    # A decoder whose cells do not divide the grid covers a part of it.
    part = drawn(1, 1, 8, 10, seed=2)
    np.testing.assert_array_equal(grid.padded(part)[..., 10], part[..., 9])
    assert grid.padded(part).shape == (1, 1, 8, 11)
    whole = drawn(1, 1, 8, 11, seed=3)
    assert grid.padded(whole) is whole


@pytest.mark.parametrize(
    ("config", "channels", "cell"),
    [
        ({"latent_channels": 4, "block_out_channels": (128, 256, 512, 512)}, 4, 8),
        ({"latent_channels": 16, "decoder_block_out_channels": (64, 64), "block_out_channels": (1,)}, 16, 2),
        ({"z_dim": 16}, 16, None),
        ({"block_out_channels": (32,)}, None, 1),
    ],
)
def test_the_latent_of_an_autoencoder_is_read_from_its_config(config, channels, cell):
    found = LatentGrid.of(SimpleNamespace(config=config))
    assert found == (channels, cell) and str(found) == f"{channels} channels, {cell} px a cell"


@pytest.mark.parametrize(
    ("channels", "factor", "name"),
    [
        (4, 0.18215, "madebyollin/taesd"),
        (4, 0.13025, "madebyollin/taesdxl"),
        (16, 1.5305, "madebyollin/taesd3"),
        (16, 0.3611, "madebyollin/taef1"),
    ],
)
def test_each_published_tiny_autoencoder_is_found_by_latent_and_scaling_factor(
    monkeypatch, channels, factor, name
):
    """The scaling factors of Stable Diffusion 2, XL and 3 and of FLUX, all of 8 pixels a cell."""
    asked = []
    own = SimpleNamespace(config={"latent_channels": channels, "decoder_block_out_channels": (8,) * 4})
    monkeypatch.setattr(codec, "_loaded", lambda *arguments: asked.append(arguments) or own)
    stages = (8,) * 4

    def pipe(channels=channels, stages=stages, factor=factor):
        config = {"latent_channels": channels, "block_out_channels": stages, "scaling_factor": factor}
        return SimpleNamespace(
            vae=SimpleNamespace(config=config), dtype=torch.float16, _execution_device=torch.device("cuda:1")
        )

    assert tiny_autoencoder(pipe(), "tiny") is own
    assert asked == [(name, torch.float16, "cuda:1")]
    assert tiny_autoencoder(pipe(), "full") is None and len(asked) == 1
    for other in (pipe(channels=8), pipe(stages=(8,) * 3), pipe(factor=0.9)):
        with pytest.raises(
            ValueError,
            match=r"decoder must be 'full' with .*; got 'tiny'\. No tiny autoencoder is published for",
        ):
            tiny_autoencoder(other, "tiny")
    # One that the user names must be of the same latent.
    assert tiny_autoencoder(pipe(), "me/mine") is own and asked[-1][0] == "me/mine"
    with pytest.raises(
        ValueError,
        match=r"latent \(8 channels, 8 px a cell\); got \d+ channels, 8 px a cell, in 'me/mine'",
    ):
        tiny_autoencoder(pipe(channels=8), "me/mine")
    for without in (SimpleNamespace(), SimpleNamespace(vae=SimpleNamespace(config={"z_dim": 16}))):
        with pytest.raises(
            ValueError,
            match=r"'full' with SimpleNamespace; got 'me/mine'\. This prior has no single-image latent",
        ):
            tiny_autoencoder(without, "me/mine")
    assert len(PUBLISHED) == 4


def test_a_name_is_a_folder_or_a_hub_id_and_what_it_names_is_frozen(monkeypatch, tmp_path):
    asked = []

    def load(name, **options):
        asked.append((name, options))
        return make_vae().train()

    monkeypatch.setattr(AutoencoderTiny, "from_pretrained", load)
    codec._loaded.cache_clear()
    for name in ("owner/name", str(tmp_path)):
        made = codec._loaded(name, torch.float16, "cpu")
        assert not made.training and not any(weight.requires_grad for weight in made.parameters())
    of_half = {"dtype": torch.float16, "use_safetensors": True}
    assert asked == [("owner/name", of_half), (str(tmp_path), of_half)]
    for name in ("name", "a/b/c", "./b", "/b", "~/b"):
        with pytest.raises(
            ValueError,
            match=f"decoder must be .*an existing folder, or a Hugging Face model ID; got '{name}'",
        ):
            codec._loaded(name, torch.float16, "cpu")
    codec._loaded.cache_clear()


class Prior:
    """Decodes with whatever autoencoder the pipeline has: times its factor, in float64."""

    depth_channels = slice(1, 3)
    max_steps = None

    def __init__(self, pipe) -> None:
        self.pipe = pipe

    def decode(self, z0):
        return (self.pipe.vae * z0).double()

    def encode(self, x):
        if self.pipe.vae is None:
            raise RuntimeError("no autoencoder")
        return x / self.pipe.vae


def a_codec(tiny=None) -> MapCodec:
    pipe = SimpleNamespace(vae=3.0)
    return MapCodec(pipe, Prior(pipe), ProcessingGrid((4, 6), (2, 1)), tiny)


@pytest.mark.parametrize("tiny", [None, 5.0])
def test_the_tiny_autoencoder_stands_in_but_for_the_result(tiny):
    made, z0 = a_codec(tiny), drawn(2, 1, 6, 7, seed=1)
    factor = tiny or 3.0
    found = made.decode(z0)
    assert found.dtype == torch.float32 and found.shape == (2, 1, 4, 6)
    torch.testing.assert_close(found, factor * z0[..., :4, :6])
    torch.testing.assert_close(made.decode(z0, final=True), 3.0 * z0[..., :4, :6])
    x = drawn(2, 1, 4, 6, seed=2)
    torch.testing.assert_close(made.encode(x), made.grid.padded(x) / factor)
    small = z0[..., :5, :3]  # whole cells only: the rest of the grid is as at its end
    torch.testing.assert_close(
        made.decode(small)[..., 3:], (factor * small[..., :4, 2:]).expand(-1, -1, -1, 3)
    )
    assert made.pipe.vae == 3.0
    made.prior.decode = lambda z0: 1 / 0
    with pytest.raises(ZeroDivisionError):
        made.decode(z0)
    assert made.pipe.vae == 3.0


LEVEL = NoiseLevel(torch.tensor(0.6), torch.tensor(0.8), "v_prediction")


class Tap:
    """A network whose output is ``2 z + 1`` in the depth channels, and noise elsewhere."""

    def __init__(self, z_t: torch.Tensor) -> None:
        self.whole = drawn(*z_t.shape, seed=9)
        self.leaf = z_t[:, 1:3].float().requires_grad_()

    def output_at(self, latent):
        return torch.cat([self.whole[:, :1], 2.0 * latent + 1.0, self.whole[:, 3:]], 1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.float64])
def test_the_clean_latent_is_moved_and_noise_and_other_channels_stay(dtype):
    made, output, z_t = a_codec(), drawn(2, 5, 3, 4, seed=3).to(dtype), drawn(2, 5, 3, 4, seed=4).to(dtype)
    estimate = StepEstimate(made, LEVEL, output, z_t, None, True)
    wide = torch.float64 if dtype == torch.float64 else torch.float32
    of_depth = output[:, 1:3].to(wide), z_t[:, 1:3].to(wide)
    torch.testing.assert_close(estimate.latent, 0.6 * of_depth[1] - 0.8 * of_depth[0])
    torch.testing.assert_close(estimate.eps, 0.6 * of_depth[0] + 0.8 * of_depth[1])
    assert torch.equal(estimate.output, of_depth[0]) and estimate.latent.dtype == wide
    assert estimate.z0(estimate.latent) is estimate.latent
    offset = 0.1 * drawn(2, 2, 3, 4, seed=5).to(wide)
    inputs = estimate.step_inputs(offset, from_updated=False)
    assert inputs.offset is None and inputs.output.dtype == inputs.z_t.dtype == dtype
    for found, given in ((inputs.output, output), (inputs.z_t, z_t)):
        assert torch.equal(found[:, [0, 3, 4]], given[:, [0, 3, 4]])
    depth = inputs.output[:, 1:3].to(wide), inputs.z_t[:, 1:3].to(wide)
    near = {"atol": 5e-3 if dtype == torch.float16 else 1e-5, "rtol": 0}
    torch.testing.assert_close(z0_from(*depth, LEVEL), estimate.latent + offset, **near)
    torch.testing.assert_close(noise_from(*depth, LEVEL), estimate.eps, **near)


@pytest.mark.parametrize("from_updated", [True, False])
@pytest.mark.parametrize("max_steps", [None, 1, 4])
def test_the_noisy_latent_is_moved_before_or_after_the_step(from_updated, max_steps):
    """A prior of one step is asked again: its step returns the clean latent of the moved one."""
    made, output, z_t = a_codec(), drawn(2, 5, 3, 4, seed=3), drawn(2, 5, 3, 4, seed=4)
    made.prior.max_steps = max_steps
    tap = Tap(z_t)
    estimate = StepEstimate(made, LEVEL, output, z_t, tap, True)
    assert estimate.latent is tap.leaf
    moved = estimate.latent + 0.3
    torch.testing.assert_close(estimate.z0(moved), 0.6 * moved - 0.8 * (2.0 * moved + 1.0))
    offset = drawn(2, 2, 3, 4, seed=5)
    inputs = estimate.step_inputs(offset, from_updated)
    assert not any(each is not None and each.requires_grad for each in inputs)
    there = z_t.clone()
    there[:, 1:3] += offset
    if max_steps == 1 or from_updated:
        torch.testing.assert_close(inputs.z_t, there)
        assert inputs.offset is None
    else:
        assert inputs.z_t is z_t
        torch.testing.assert_close(z_t + inputs.offset, there)
    if max_steps == 1:
        torch.testing.assert_close(inputs.output, tap.output_at(there[:, 1:3]))
    else:
        assert inputs.output is output


@pytest.mark.parametrize(
    ("final", "read", "decoded_by"), [(True, False, 3.0), (True, True, 5.0), (False, False, 5.0)]
)
def test_a_final_map_is_the_priors_own_unless_the_latent_is_read(final, read, decoded_by):
    made, z = a_codec(5.0), drawn(2, 5, 6, 7, seed=6)
    estimate = StepEstimate(made, LEVEL, z, z, None, read)
    assert estimate.latent_is_read == read
    z0 = drawn(2, 1, 6, 7, seed=7)
    torch.testing.assert_close(estimate.decode(z0), 5.0 * z0[..., :4, :6])
    torch.testing.assert_close(estimate.decode(z0, final), decoded_by * z0[..., :4, :6])
    torch.testing.assert_close(estimate.encode(z0[..., :4, :6]), made.encode(z0[..., :4, :6]))
