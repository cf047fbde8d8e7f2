"""Run the authors' own code of E2E-FT on tiny networks with named weights; keep slices of what it computes.

``docs/how-to/parity.md`` tells how to make the environment; then, from the root of this repository::

    python -m tests.parity.e2e_ft_reference --authors diffusion-e2e-ft/Marigold \
        --out tests/parity/fixtures/e2e_ft.npz

The configurations below are what the parity test builds our pipeline from. Their code is imported, not
copied; torchvision, which it imports for two functions, is replaced by what they do.
"""

import argparse
import sys
import tempfile
from enum import Enum
from pathlib import Path

import numpy as np

from tests.parity import stub_modules, tiny_configs
from tests.parity.geowizard_reference import TEXT, VAE, write_tokenizer

UNET = tiny_configs.UNET | {"in_channels": 8}
SCHEDULER = tiny_configs.SCHEDULER | {"timestep_spacing": "trailing"}
SIZE = (48, 64)


def image_u8() -> np.ndarray:
    """``(H, W, 3)`` uint8."""
    from tests.parity.named_weights import draw

    return np.clip(draw("e2e-ft/image", (*SIZE, 3)) * 60 + 128, 0, 255).astype(np.uint8)


def _stand_in() -> None:
    import torch

    def pil_to_tensor(image):
        return torch.from_numpy(np.array(image)).permute(2, 0, 1)

    class InterpolationMode(Enum):
        BILINEAR, BICUBIC, NEAREST_EXACT = "bilinear", "bicubic", "nearest-exact"

    contents = {
        "torchvision": {},
        "torchvision.transforms": {"InterpolationMode": InterpolationMode},
        "torchvision.transforms.functional": {
            "InterpolationMode": InterpolationMode,
            "pil_to_tensor": pil_to_tensor,
            "resize": None,  # nothing is resized here
        },
    }
    stub_modules.install(contents)


def main() -> None:
    """Write the slices."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--authors", required=True, help="folder Marigold/ of their repository")
    parser.add_argument("--out", required=True)
    arguments = parser.parse_args()
    sys.path.insert(0, arguments.authors)
    _stand_in()
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from marigold.marigold_pipeline import MarigoldPipeline
    from PIL import Image
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    from tests.parity.named_weights import fill

    text_encoder = CLIPTextModel(CLIPTextConfig(**TEXT))
    with tempfile.TemporaryDirectory() as folder:
        write_tokenizer(Path(folder))
        tokenizer = CLIPTokenizer(f"{folder}/vocab.json", f"{folder}/merges.txt")
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
    kept = {
        "network_output": outputs[0].numpy(),
        "latent": latent.numpy(),
        "unclipped": unclipped[0, 0].numpy()[::4, ::4],  # about [-1, 1]
        "depth": out.depth_np[::4, ::4],  # min-max of the clipped map
    }
    np.savez_compressed(arguments.out, **{name: x.astype(np.float32) for name, x in kept.items()})


if __name__ == "__main__":
    main()
