"""Run Marigold-DC's own code on a tiny Marigold with named weights, and keep slices of what it completes.

From the root of this repository, with the environment of the tests::

    python -m tests.parity.marigold_dc_reference --authors DIR --out tests/parity/fixtures/marigold_dc.npz

``DIR`` is a checkout of github.com/prs-eth/Marigold-DC (written with commit 77fa032). The configurations
below are what the parity test builds our pipeline from. Their code is imported, not copied.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from diffusers import AutoencoderKL, DDIMScheduler, MarigoldDepthPipeline, UNet2DConditionModel
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

from tests.parity.named_weights import draw, fill

UNET = {
    "sample_size": 16,
    "in_channels": 8,
    "out_channels": 4,
    "block_out_channels": (8, 16),
    "layers_per_block": 1,
    "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
    "up_block_types": ("CrossAttnUpBlock2D", "UpBlock2D"),
    "cross_attention_dim": 8,
    "attention_head_dim": 4,
    "norm_num_groups": 4,
}
VAE = {
    "block_out_channels": (8, 16),
    "down_block_types": ("DownEncoderBlock2D",) * 2,
    "up_block_types": ("UpDecoderBlock2D",) * 2,
    "latent_channels": 4,
    "norm_num_groups": 4,
    "scaling_factor": 0.5,
}
TEXT = {
    "hidden_size": 8,
    "intermediate_size": 8,
    "num_attention_heads": 2,
    "num_hidden_layers": 1,
    "vocab_size": 4,
}
VOCABULARY = {"<|startoftext|>": 0, "<|endoftext|>": 1, "a</w>": 2, "a": 3}
#: Marigold v1-0's, with the spacing that their script sets.
SCHEDULER = {
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "prediction_type": "v_prediction",
    "timestep_spacing": "trailing",
    "clip_sample": False,
    "set_alpha_to_one": False,
    "steps_offset": 1,
}
#: case -> ((H, W), processing resolution, steps, ensemble members)
CASES = {
    "one": ((48, 64), 0, 1, 1),
    "four": ((48, 64), 0, 4, 1),
    "resized": ((61, 91), 64, 3, 1),  # padded and resized on the way in, cropped and resized on the way out
    "ensemble": ((48, 64), 0, 2, 3),
}
SEED = 2024


def build(pipeline: type[MarigoldDepthPipeline]) -> Any:
    """The tiny Marigold, as an instance of that class."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "vocab.json").write_text(json.dumps(VOCABULARY))
        (folder / "merges.txt").write_text("#version: 0.2\n")
        tokenizer = CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"), model_max_length=77)
    vae = fill(AutoencoderKL(**VAE), "vae.")
    vae.decoder.conv_out.weight.data *= 3.0  # leaves [-1, 1] in places: theirs clips, and so must ours
    text_encoder = CLIPTextModel(CLIPTextConfig(**TEXT))
    pipe = pipeline(
        unet=fill(UNet2DConditionModel(**UNET), "unet."),
        vae=vae,
        scheduler=DDIMScheduler(**SCHEDULER),
        text_encoder=fill(text_encoder, "text_encoder.", lambda name: name.removeprefix("text_model.")),
        tokenizer=tokenizer,
        prediction_type="depth",
    )
    pipe.set_progress_bar_config(disable=True)
    return pipe


def image_u8(case: str) -> np.ndarray:
    """``(H, W, 3)`` uint8."""
    return np.clip(draw(f"marigold_dc/{case}/image", (*CASES[case][0], 3)) * 60 + 128, 0, 255).astype(
        np.uint8
    )


def sparse_depth(case: str) -> np.ndarray:
    """``(H, W)`` float32 metres, about 1.5 to 6, known at one pixel in 25, else 0."""
    size = CASES[case][0]
    depth_m = 3.0 * np.exp(0.3 * draw(f"marigold_dc/{case}/depth", size))
    return np.where(draw(f"marigold_dc/{case}/known", size) > 1.75, depth_m, 0).astype(np.float32)


def keep(x: np.ndarray) -> np.ndarray:
    """The part of a map that is kept: every fourth row and column, ``(H, W)``."""
    return x[::4, ::4]


def main() -> None:
    """Write the slices of every case."""
    from PIL import Image

    parser = argparse.ArgumentParser()
    parser.add_argument("--authors", required=True, help="a checkout of their repository")
    parser.add_argument("--out", required=True)
    arguments = parser.parse_args()
    sys.path.insert(0, arguments.authors)
    from marigold_dc import MarigoldDepthCompletionPipeline

    pipe, found = build(MarigoldDepthCompletionPipeline), {}
    for case, (_, resolution, steps, members) in CASES.items():
        depth_m = pipe(Image.fromarray(image_u8(case)), sparse_depth(case), steps, members, resolution, SEED)
        found[case] = keep(depth_m).astype(np.float32)
    np.savez_compressed(arguments.out, **found)


if __name__ == "__main__":
    main()
