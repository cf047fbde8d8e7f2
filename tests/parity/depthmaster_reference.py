r"""Run DepthMaster's own code on tiny networks with named weights, and keep slices of what it computes.

``docs/how-to/parity.md`` tells how to make the environment; then, from the root of this repository::

    python -m tests.parity.depthmaster_reference --authors DepthMaster \
        --out tests/parity/fixtures/depthmaster.npz

The configurations below are what the parity test builds our pipeline from. Their code is imported, not
copied; torchvision is replaced by the two functions that are called.
"""

import argparse
import functools
import sys
import types
from enum import Enum
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from tests.parity.named_weights import draw, fill

UNET = {
    "in_channels": 4,
    "out_channels": 4,
    "block_out_channels": (32, 64),
    "layers_per_block": 1,
    "down_block_types": ("CrossAttnDownBlock2D", "DownBlock2D"),
    "up_block_types": ("UpBlock2D", "CrossAttnUpBlock2D"),
    "cross_attention_dim": 16,
    "attention_head_dim": (2, 4),
    "use_linear_projection": True,
}
VAE = {
    "block_out_channels": (32,) * 4,
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "layers_per_block": 1,
}
SIZE = (48, 64)


def image_u8() -> np.ndarray:
    """``(H, W, 3)`` of noise."""
    return (128 + 50 * draw("image", (*SIZE, 3))).clip(0, 255).astype(np.uint8)


def prompt() -> torch.Tensor:
    """``(1, 2, 16)`` in place of the empty prompt."""
    return torch.from_numpy(draw("prompt", (1, 2, UNET["cross_attention_dim"])))


def stub_torchvision() -> None:
    """Modules of the names that the authors' code imports; nothing is resized at processing_res=0."""

    class InterpolationMode(Enum):
        BILINEAR, BICUBIC, NEAREST_EXACT = "bilinear", "bicubic", "nearest-exact"

    def resize(image, size, interpolation=None, antialias=True):
        if tuple(image.shape[-2:]) != tuple(size):
            raise NotImplementedError("the fixture is made at the image's own size")
        return image

    def pil_to_tensor(image):
        return torch.from_numpy(np.array(image)).permute(2, 0, 1)

    contents = {
        "torchvision": {},
        "torchvision.transforms": {"InterpolationMode": InterpolationMode},
        "torchvision.transforms.functional": {"pil_to_tensor": pil_to_tensor, "resize": resize},
    }
    for name, content in contents.items():
        module = types.ModuleType(name)
        module.__spec__ = ModuleSpec(name, None)  # diffusers looks for it
        module.__dict__.update(content)
        sys.modules[name] = module


def run_authors() -> dict[str, np.ndarray]:
    """Network output, unclipped decode and final map of their pipeline."""
    stub_torchvision()
    from depthmaster.depthmaster_pipeline import DepthMasterPipeline
    from depthmaster.modules import unet_2d_condition_s2 as theirs
    from diffusers import AutoencoderKL

    # Their block has 1280 channels unless told otherwise, more than this U-Net's middle.
    theirs.BlockFE = functools.partial(theirs.BlockFE, dim=UNET["block_out_channels"][-1])
    unet = fill(theirs.UNet2DConditionModel(**UNET), "unet.").eval()
    pipe = DepthMasterPipeline(unet, fill(AutoencoderKL(**VAE), "vae.").eval(), None, None)
    pipe.empty_text_embed = prompt()
    kept = {}
    unet.register_forward_hook(lambda module, inputs, output: kept.update(network=output.sample))
    decode = pipe.decode_depth
    pipe.decode_depth = lambda latent: kept.setdefault("decoded", decode(latent))
    output = pipe(Image.fromarray(image_u8()), processing_res=0, show_progress_bar=False, color_map=None)
    return {
        "network": kept["network"].numpy(),
        "decoded": kept["decoded"][0, 0, ::4, ::4].numpy(),
        "output": output.depth_np[::4, ::4],
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--authors", type=Path, required=True, help="checkout of indu1ge/DepthMaster")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    sys.path.insert(0, str(arguments.authors))
    kept = run_authors()
    np.savez_compressed(arguments.out, **kept)
    for name, value in kept.items():
        print(name, value.shape, float(value.min()), float(value.max()))


if __name__ == "__main__":
    main()
