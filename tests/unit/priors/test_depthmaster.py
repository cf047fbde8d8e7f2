"""DepthMaster's Fourier block against NumPy's transform, and where it stands in the network."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from geodiff_plugin.priors.depthmaster import TIMESTEP, DepthMasterPipeline, FourierBlock
from tests.contracts.tiny_priors import make_depthmaster


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def pipe():
    return make_depthmaster()


def convolved(layer: nn.Conv2d, x: np.ndarray) -> np.ndarray:
    """By sums over shifted copies, zeros beyond the border."""
    weight, bias = layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()
    radius, (height, width) = weight.shape[-1] // 2, x.shape[-2:]
    padded = np.pad(x, ((0, 0), (0, 0), (radius, radius), (radius, radius)))
    out = np.zeros((len(x), len(weight), height, width)) + bias[:, None, None]
    for i in range(weight.shape[2]):
        for j in range(weight.shape[3]):
            shifted = padded[:, :, i : i + height, j : j + width]
            out += np.einsum("oc,bchw->bohw", weight[:, :, i, j], shifted)
    return out


def silu(x):
    return x / (1 + np.exp(-x))


def block_in_numpy(block: FourierBlock, x: np.ndarray, groups: int) -> np.ndarray:
    parts = x.reshape(len(x), groups, -1)
    mean, var = parts.mean(-1, keepdims=True), parts.var(-1, keepdims=True)
    normed = ((parts - mean) / np.sqrt(var + block.norm.eps)).reshape(x.shape)
    gain, offset = (p.detach().double().numpy()[:, None, None] for p in (block.norm.weight, block.norm.bias))
    normed = normed * gain + offset
    start = silu(convolved(block.conv_f1, normed))
    spectrum = np.fft.rfft2(start, norm="ortho")
    magnitude = silu(convolved(block.conv_f2, np.abs(spectrum)))
    angle = silu(convolved(block.conv_f4, np.angle(spectrum)))
    back = np.fft.irfft2(magnitude * np.exp(1j * angle), s=start.shape[-2:], norm="ortho")
    in_frequency = convolved(block.conv_f3, back + start)
    in_space = convolved(block.conv_s2, silu(convolved(block.conv_s1, normed))) + normed
    return convolved(block.fuse, np.concatenate([in_space, in_frequency], axis=1))


@pytest.mark.parametrize(("size", "groups"), [((5, 7), 8), ((3, 9), 4)])
def test_the_block_is_its_formula(size, groups):
    """Of odd sides: of even ones some frequencies are real, and the angle of a negative one is pi or -pi."""
    block = FourierBlock(16, *([] if groups == 8 else [groups])).eval()
    for parameter in block.norm.parameters():
        nn.init.normal_(parameter)
    x = torch.randn(2, 16, *size)
    with torch.no_grad():
        found = block(x)
        wanted = block_in_numpy(block, x.double().numpy(), groups)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-4)
        half = block.bfloat16()(x.bfloat16())
    assert half.dtype == torch.bfloat16 and half.shape == x.shape
    assert np.corrcoef(half.float().flatten(), wanted.ravel())[0, 1] > 0.99


def test_weights_of_the_block_have_the_shapes_of_the_published_ones():
    shapes = {name: tuple(value.shape) for name, value in FourierBlock(16).state_dict().items()}
    wide = dict.fromkeys(("conv_f1", "conv_f2", "conv_f4", "conv_s1", "conv_s2"), (16, 16, 3, 3))
    wanted = wide | {"conv_f3": (16, 16, 1, 1), "fuse": (16, 32, 1, 1), "norm": (16,)}
    assert {
        name.removesuffix(".weight"): s for name, s in shapes.items() if name.endswith("weight")
    } == wanted
    assert all(shape == (16,) for name, shape in shapes.items() if name.endswith("bias"))


def test_the_block_is_between_the_middle_of_the_network_and_its_second_half(pipe):
    seen = {}
    hooks = [
        pipe.unet.fftblock.register_forward_hook(lambda m, given, out: seen.update(given=given[0], out=out)),
        pipe.unet.up_blocks[0].register_forward_pre_hook(
            lambda m, args, given: seen.update(up=args[0] if args else given["hidden_states"]),
            with_kwargs=True,
        ),
        pipe.unet.mid_block.resnets[-1].register_forward_hook(lambda m, given, out: seen.update(middle=out)),
    ]
    width = pipe.unet.config.cross_attention_dim
    with torch.no_grad():
        condition = {"image_latent": torch.randn(2, 4, 8, 8), "prompt": torch.randn(2, 2, width)}
        pipe.denoise(torch.zeros(2, 4, 8, 8), torch.tensor(1), condition)
    for hook in hooks:
        hook.remove()
    assert torch.equal(seen["given"], seen["middle"]) and torch.equal(seen["up"], seen["out"])
    assert not torch.equal(seen["middle"], seen["out"])


def test_the_network_sees_the_image_alone_at_the_timestep_that_it_knows(pipe):
    seen = []
    answer = torch.rand(2, 4, 3, 3)
    stand_in = SimpleNamespace(run_unet=lambda *given: seen.append(given) or answer)
    condition = {"image_latent": torch.rand(2, 4, 3, 3), "prompt": None}
    assert DepthMasterPipeline.denoise(stand_in, torch.rand(2, 4, 3, 3), "t", condition) is answer
    assert seen == [(condition["image_latent"], "t", condition)]
    pipe.set_timesteps(1, torch.device("cpu"))
    assert pipe.scheduler.timesteps.tolist() == [TIMESTEP] == [1] and "scheduler" not in pipe.components
    condition = pipe.prepare_condition(torch.rand(2, 3, 64, 64), 3, 2, None)
    assert condition["image_latent"].shape == (6, 4, 8, 8)
    assert torch.equal(condition["prompt"], pipe.prompt_embedding(condition["image_latent"]))
    assert torch.equal(condition["image_latent"][0], condition["image_latent"][2])
    assert not pipe.prepare_latents(condition, torch.Generator()).any()
