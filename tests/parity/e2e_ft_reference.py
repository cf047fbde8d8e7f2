"""Run the authors' own code of E2E-FT on tiny networks with named weights; keep slices of what it computes.

``docs/appendix/parity.md`` describes the environment. Then, from the root of this repository::

    python -m tests.parity.e2e_ft_reference --authors diffusion-e2e-ft/Marigold \
        --out tests/parity/fixtures/e2e_ft.npz

The parity test builds our pipeline from the configurations below; two functions stand in for torchvision.
"""

import string
import tempfile
from pathlib import Path

import numpy as np

from tests.parity import authors
from tests.parity.authors import TEXT, VAE

UNET = authors.UNET | {"in_channels": 8}
SCHEDULER = authors.SCHEDULER | {"timestep_spacing": "trailing"}
SIZE = (48, 64)


def image_u8() -> np.ndarray:
    """``(H, W, 3)`` uint8."""
    return authors.image("e2e-ft/image", SIZE)


def run_authors(folder: Path) -> dict[str, np.ndarray]:
    """Network output, latent, unclipped decode and final map of their pipeline."""
    authors.install(authors.TORCHVISION)
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from marigold.marigold_pipeline import MarigoldPipeline
    from PIL import Image
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    from tests.parity.named_weights import fill

    text_encoder = CLIPTextModel(CLIPTextConfig(**TEXT))
    with tempfile.TemporaryDirectory() as name:
        tokenizer = CLIPTokenizer(*authors.write_tokenizer(name, string.ascii_lowercase))
    pipe = MarigoldPipeline(
        unet=fill(UNet2DConditionModel(**UNET), "unet."),
        vae=fill(AutoencoderKL(**VAE), "vae."),
        scheduler=DDIMScheduler(**SCHEDULER),
        text_encoder=fill(text_encoder, "text_encoder.", lambda name: name.removeprefix("text_model.")),
        tokenizer=tokenizer,
    )
    outputs, decoded, own = [], [], pipe.decode_depth
    pipe.unet.register_forward_hook(lambda module, args, out: outputs.append(out.sample))

    def spy(latent):
        decoded.append((latent.clone(), own(latent).clone()))
        return decoded[-1][1].clone()

    pipe.decode_depth = spy
    out = pipe(
        Image.fromarray(image_u8()),
        denoising_steps=1,
        ensemble_size=1,
        processing_res=0,
        match_input_res=False,
        batch_size=1,
        color_map=None,
        show_progress_bar=False,
        noise="zeros",
    )
    latent, unclipped = decoded[0]
    return {
        "network_output": outputs[0].numpy(),
        "latent": latent.numpy(),
        "unclipped": unclipped[0, 0].numpy()[::4, ::4],  # about [-1, 1]
        "depth": out.depth_np[::4, ::4],  # min-max of the clipped map
    }


if __name__ == "__main__":
    authors.write_fixture(run_authors)
