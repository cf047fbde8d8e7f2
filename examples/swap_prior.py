"""Compare several priors on one pair, side by side with the same colour scale.

Only the name of the prior changes; the guidance is the same. By default the script runs offline with the
bundled prior only:

    python -m examples.swap_prior
    python -m examples.swap_prior left.png right.png calib.txt --prior bundled \
        --prior prs-eth/marigold-depth-v1-1 --prior jingheya/lotus-depth-g-v2-1-disparity \
        --prior depth-anything/Depth-Anything-V2-Small-hf
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageOps

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.plotting import colour_depth, depth_range, grid
from geodiff_plugin.priors import find_prior

#: Maximum number of images per row.
COLUMNS = 4


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("left", type=Path, nargs="?", default=DEMO_PAIR_FOLDER / "left.png")
    parser.add_argument("right", type=Path, nargs="?", default=DEMO_PAIR_FOLDER / "right.png")
    parser.add_argument("calib", type=Path, nargs="?", default=DEMO_PAIR_FOLDER / "calib.txt")
    parser.add_argument(
        "--prior", action="append", help="'bundled', a Hugging Face model ID or a folder; may be repeated"
    )
    parser.add_argument("--out", type=Path, default=Path("swap_prior.png"), help="output image")
    options = parser.parse_args(argv)

    left, right = (ImageOps.exif_transpose(Image.open(path)) for path in (options.left, options.right))
    guidance = GeometryGuidance.from_calibration(right, options.calib)

    maps, titles = [], []
    for name in options.prior or ["bundled"]:
        found = find_prior(name)
        print(f"{name}: {found.key}; {found.licence}")
        pipe = enable_geometry_guidance(found.load())  # the only lines that depend on the prior

        started = time.perf_counter()
        out = pipe(left, guidance=guidance, generator=torch.Generator("cpu").manual_seed(0))
        seconds = time.perf_counter() - started

        depth_m = out.prediction[0, ..., 0]
        print(f"  median {np.median(depth_m):.2f} m, {seconds:.1f} s")
        if maps:
            print(f"  {np.median(np.abs(depth_m / maps[0] - 1)):.1%} from the first prior's depth")
        for finding in out.findings:
            print(f"  {finding.severity.value}: {finding}")
        maps.append(depth_m)
        titles.append(f"{Path(name).name} ({found.key})")

    near, far = depth_range(np.concatenate(maps))  # one colour scale, so that maps are comparable
    images = [left, *(colour_depth(depth_m, near=near, far=far) for depth_m in maps)]
    rows = -(-len(images) // COLUMNS)
    sheet = grid(
        images, ["left image", *titles], columns=min(COLUMNS, len(images)), depth_ranges=[(near, far)] * rows
    )
    sheet.save(options.out)
    print(f"{options.out}")


if __name__ == "__main__":
    main()
