"""Marigold V2 as a prior: one step of a large transformer, made metric by a second view.

``geodiff convert marigold-v2`` creates the folder (docs/reference/priors.md). By default the script runs
offline on a tiny model with random weights, whose depth is meaningless:

    python examples/marigold_v2.py
    python examples/marigold_v2.py left.png right.png calib.txt --prior marigold-v2 --device cuda
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from diffusers import AutoencoderKLQwenImage, FlowMatchEulerDiscreteScheduler, QwenImageTransformer2DModel
from PIL import Image, ImageOps

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.priors.components import FixedPrompt
from geodiff_plugin.priors.marigold_v2 import MarigoldV2Pipeline

#: Configuration of a tiny transformer and autoencoder of Qwen-Image's classes, about 280 000 weights in
#: total.
TINY_TRANSFORMER = {
    "num_layers": 2,
    "attention_head_dim": 16,
    "num_attention_heads": 2,
    "joint_attention_dim": 16,
    "axes_dims_rope": (4, 6, 6),
}
TINY_VAE = {"base_dim": 4, "dim_mult": [1, 2, 4, 4], "num_res_blocks": 1}


def tiny_marigold_v2(seed: int = 0, space: str = "log") -> MarigoldV2Pipeline:
    """Build a tiny Marigold V2 with random weights, float32, at 64 px.

    Args:
        seed: seed of the weights.
        space: prediction space.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        transformer = QwenImageTransformer2DModel(**TINY_TRANSFORMER).eval()
        vae = AutoencoderKLQwenImage(**TINY_VAE).eval()
        prompt = FixedPrompt(5, 16)
        torch.nn.init.normal_(prompt.embedding)
        torch.nn.init.normal_(
            vae.decoder.conv_out.weight, std=0.3
        )  # the default initialisation gives a nearly flat map
    pipe = MarigoldV2Pipeline(
        transformer,
        vae,
        FlowMatchEulerDiscreteScheduler(),
        prompt,
        prediction_type=space,
        default_processing_resolution=64,
    )
    pipe.set_progress_bar_config(disable=True)
    return pipe


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("left", type=Path, nargs="?", default=DEMO_PAIR_FOLDER / "left.png")
    parser.add_argument("right", type=Path, nargs="?", default=DEMO_PAIR_FOLDER / "right.png")
    parser.add_argument("calib", type=Path, nargs="?", default=DEMO_PAIR_FOLDER / "calib.txt")
    parser.add_argument("--prior", type=Path, help="folder from `geodiff convert marigold-v2`")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("marigold_v2.npy"), help="the depth, metres")
    options = parser.parse_args(argv)

    left, right = (ImageOps.exif_transpose(Image.open(path)) for path in (options.left, options.right))
    guidance = GeometryGuidance.from_calibration(right, options.calib)

    with tempfile.TemporaryDirectory() as tiny:
        if options.prior is None:
            print("No --prior: using a tiny Marigold V2 with random weights, whose depth is meaningless")
            tiny_marigold_v2().save_pretrained(tiny)
        # The model was trained in bfloat16; a CPU is faster in float32.
        dtype = torch.float32 if options.device == "cpu" else torch.bfloat16
        pipe = load_prior(options.prior or tiny, device=options.device, dtype=dtype)
    print(f"affine in {pipe.config.prediction_type} depth")
    enable_geometry_guidance(pipe)

    started = time.perf_counter()
    out = pipe(left, guidance=guidance)
    depth_m = out.prediction[0, ..., 0]
    print(f"median {np.median(depth_m):.2f} m, {time.perf_counter() - started:.1f} s")
    for finding in out.findings:
        print(f"{finding.severity.value}: {finding}")
    np.save(options.out, depth_m)
    print(options.out)


if __name__ == "__main__":
    main()
