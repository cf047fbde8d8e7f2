r"""Run DepthMaster's own code on tiny networks with named weights, and keep slices of what it computes.

``docs/appendix/parity.md`` describes the environment. Then, from the root of this repository::

    python -m tests.parity.depthmaster_reference --authors DepthMaster \
        --out tests/parity/fixtures/depthmaster.npz

The parity test builds our pipeline from the configurations below; two functions stand in for torchvision.
"""

import functools
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from tests.parity import authors
from tests.parity.named_weights import draw, fill

UNET = authors.UNET | {"in_channels": 4, "block_out_channels": (32, 64), "cross_attention_dim": 16}
UNET["norm_num_groups"] = 32
VAE = authors.WIDE_VAE
SIZE = (48, 64)


def image_u8() -> np.ndarray:
    """``(H, W, 3)`` of noise."""
    return authors.image("image", SIZE, 50.0)


def prompt() -> torch.Tensor:
    """``(1, 2, 16)`` in place of the empty prompt."""
    return torch.from_numpy(draw("prompt", (1, 2, UNET["cross_attention_dim"])))


def run_authors(folder: Path) -> dict[str, np.ndarray]:
    """Network output, unclipped decode and final map of their pipeline."""
    authors.install(authors.TORCHVISION)
    from depthmaster.depthmaster_pipeline import DepthMasterPipeline
    from depthmaster.modules import unet_2d_condition_s2 as theirs
    from diffusers import AutoencoderKL

    # Their block has 1280 channels by default, more than this U-Net's middle.
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


if __name__ == "__main__":
    authors.write_fixture(run_authors)
