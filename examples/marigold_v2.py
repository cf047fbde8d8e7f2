"""Marigold V2 as a prior: one step of a large transformer, made metric by a second view.

``geodiff convert marigold-v2`` makes the folder (docs/reference/priors.md). Without one it runs offline on
a tiny folder with random weights, which shows the path and no depth worth having:

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
from PIL import Image, ImageOps

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.cli.tiny_marigold_v2 import tiny_marigold_v2


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
            print("no --prior: a tiny Marigold V2 with random weights, which knows nothing of depth")
            tiny_marigold_v2().save_pretrained(tiny)
        # They trained in bfloat16; a CPU is faster in float32.
        dtype = torch.float32 if options.device == "cpu" else torch.bfloat16
        pipe = load_prior(options.prior or tiny, device=options.device, dtype=dtype)
    print(f"affine in {pipe.config.prediction_type} depth, LoRA {pipe.config.lora}")
    enable_geometry_guidance(pipe)

    started = time.perf_counter()
    out = pipe(left, guidance=guidance)
    depth_m = out.prediction[0, ..., 0]
    print(f"median {np.median(depth_m):.2f} m, {time.perf_counter() - started:.1f} s")
    for sentence in out.warnings:
        print(f"warning: {sentence}")
    np.save(options.out, depth_m)
    print(options.out)


if __name__ == "__main__":
    main()
