"""Run Lotus' own code on tiny networks with named weights, and keep slices of what it computes.

``docs/appendix/parity.md`` describes the environment. Then, from the root of this repository::

    python -m tests.parity.lotus_reference --authors Lotus --out tests/parity/fixtures/lotus.npz

The parity test builds our pipeline from the configurations below; a torch function stands in for torchvision.
"""

import tempfile
from pathlib import Path

import numpy as np
import torch

from tests.parity import authors
from tests.parity.authors import TEXT_1 as TEXT
from tests.parity.authors import VAE
from tests.parity.named_weights import draw, fill

UNET = authors.UNET | {"class_embed_type": "projection", "projection_class_embeddings_input_dim": 4}
#: case -> (input channels of the U-Net, image size, processing resolution)
CASES = {
    "g": (8, (48, 64), 0),
    "g_odd": (8, (53, 70), 0),  # neither side a multiple of 8: whole cells only, stretched at the end
    "g_resized": (8, (60, 98), 64),  # the longer side comes out as 63: 98 * (64 / 98) falls short of 64
    "d": (4, (48, 64), 0),
    "d_resized": (4, (60, 80), 64),
}


def loud(vae):
    """That VAE with a last layer that leaves [-1, 1] in places, where it matters who clips what."""
    vae.decoder.conv_out.weight.data *= 4.0
    return vae


def image_u8(case: str) -> np.ndarray:
    """``(H, W, 3)`` uint8."""
    return authors.image(f"lotus/{case}/image", CASES[case][1])


def drawn(case: str, what: str, shape: tuple[int, ...]) -> np.ndarray:
    """``"noise"`` of the start or ``"posterior"`` draw, of that shape."""
    return draw(f"lotus/{case}/{what}", shape)


def keep(x: np.ndarray) -> np.ndarray:
    """The part of a map that is kept: every fifth row and column, ``(..., H, W)``."""
    return x[..., ::5, ::5]


def run_case(case: str) -> dict[str, np.ndarray]:
    """One call as in ``infer.py``: inputs and outputs of the network, unclipped decode, final output."""
    from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
    from diffusers.models.autoencoders import vae as vae_module
    from pipeline import LotusDPipeline, LotusGPipeline
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    channels, _, resolution = CASES[case]
    with tempfile.TemporaryDirectory() as folder:
        tokenizer = CLIPTokenizer(*authors.write_tokenizer(folder, "a"), model_max_length=77)
    text_encoder = CLIPTextModel(CLIPTextConfig(**TEXT))
    pipe = {8: LotusGPipeline, 4: LotusDPipeline}[channels](
        unet=fill(UNet2DConditionModel(**UNET, in_channels=channels), "unet."),
        vae=loud(fill(AutoencoderKL(**VAE), "vae.")),
        text_encoder=fill(text_encoder, "text_encoder.", lambda name: name.removeprefix("text_model.")),
        tokenizer=tokenizer,
        scheduler=DDIMScheduler(steps_offset=1, clip_sample=False),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipe.set_progress_bar_config(disable=True)

    reported, outputs, decoded = {}, [], []

    def spy(module, arguments, options, output):
        reported["input"], reported["prompt"] = arguments[0], options["encoder_hidden_states"]
        outputs.append(output[0])

    pipe.unet.register_forward_hook(spy, with_kwargs=True)
    own_decode = pipe.vae.decode

    def decode(*arguments, **options):
        decoded.append(own_decode(*arguments, **options))
        return decoded[-1]

    pipe.vae.decode = decode
    vae_module.randn_tensor = lambda shape, **_: torch.from_numpy(drawn(case, "posterior", tuple(shape)))

    image = torch.tensor(image_u8(case).astype(np.float32)).permute(2, 0, 1)[None] / 127.5 - 1.0
    task = torch.tensor([1, 0]).float()[None]
    start = {}
    if channels == 8:
        edge = max(image.shape[-2:])
        sides = [int(side * (resolution / edge)) if resolution else side for side in image.shape[-2:]]
        noise = drawn(case, "noise", (1, 4, sides[0] // 8, sides[1] // 8))
        start = {"latents": torch.from_numpy(noise), "num_inference_steps": 1}
    final = pipe(
        rgb_in=image,
        prompt="",
        output_type="np",
        timesteps=[999],
        task_emb=torch.cat([torch.sin(task), torch.cos(task)], dim=-1),
        processing_res=resolution,
        **start,
    ).images[0]
    return {
        "image_latent": reported["input"][0, :4].numpy(),
        "prompt": reported["prompt"][0].numpy(),
        "network_output": outputs[0][0].numpy(),
        "unclipped": keep((decoded[0][0].mean(dim=1)[0] / 2 + 0.5).numpy()),
        "final": keep(final.mean(axis=-1)),
    }


def run_authors(folder: Path) -> dict[str, np.ndarray]:
    """The slices of every case."""
    authors.install(authors.TORCHVISION | {"tensorboard": {}, "matplotlib": {}})
    return {f"{case}/{name}": x for case in CASES for name, x in run_case(case).items()}


if __name__ == "__main__":
    authors.write_fixture(run_authors)
