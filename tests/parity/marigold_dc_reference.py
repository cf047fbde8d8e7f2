"""Run Marigold-DC's own code on a tiny Marigold with named weights, and keep slices of what it completes.

From the root of this repository, with the environment of the tests::

    python -m tests.parity.marigold_dc_reference --authors DIR --out tests/parity/fixtures/marigold_dc.npz

``DIR`` is a checkout of github.com/prs-eth/Marigold-DC (written with commit 77fa032). The configurations
below are what the parity test builds our pipeline from. Their code is imported, not copied.
"""

from pathlib import Path
from typing import Any

import numpy as np
from diffusers import DDIMScheduler, MarigoldDepthPipeline

from tests.parity import authors
from tests.parity.named_weights import draw, fill
from tests.tiny import make_text_encoder, make_tokenizer, make_unet, make_vae, quiet

#: Marigold v1-0's, with the spacing that their script sets.
SCHEDULER = authors.SCHEDULER | {"timestep_spacing": "trailing"}
#: case -> ((H, W), processing resolution, steps, ensemble members)
CASES = {
    "one": ((48, 64), 0, 1, 1),
    "four": ((48, 64), 0, 4, 1),
    "resized": ((61, 91), 64, 3, 1),  # padded and resized on the way in, cropped and resized on the way out
    "ensemble": ((48, 64), 0, 2, 3),
    "two resized": ((61, 91), 64, 2, 2),  # the median is taken at the image's size, of two the lower
    "three resized": ((61, 91), 64, 2, 3),
}
SEED = 2024


def build(pipeline: type[MarigoldDepthPipeline]) -> Any:
    """The tiny Marigold, as an instance of that class."""
    vae = fill(make_vae(), "vae.")
    vae.decoder.conv_out.weight.data *= 3.0  # leaves [-1, 1] in places: theirs clips, and so must ours
    text = fill(make_text_encoder(), "text_encoder.", lambda name: name.removeprefix("text_model."))
    parts = fill(make_unet(), "unet."), vae, DDIMScheduler(**SCHEDULER), text, make_tokenizer()
    return quiet(pipeline(*parts, prediction_type="depth"))


def image_u8(case: str) -> np.ndarray:
    """``(H, W, 3)`` uint8."""
    return authors.image(f"marigold_dc/{case}/image", CASES[case][0])


def sparse_depth(case: str) -> np.ndarray:
    """``(H, W)`` float32 metres, about 1.5 to 6, known at one pixel in 25, else 0."""
    size = CASES[case][0]
    depth_m = 3.0 * np.exp(0.3 * draw(f"marigold_dc/{case}/depth", size))
    return np.where(draw(f"marigold_dc/{case}/known", size) > 1.75, depth_m, 0).astype(np.float32)


def keep(x: np.ndarray) -> np.ndarray:
    """The part of a map that is kept: every fourth row and column, ``(H, W)``."""
    return x[::4, ::4]


def run_authors(folder: Path) -> dict[str, np.ndarray]:
    """The slices of every case."""
    from marigold_dc import MarigoldDepthCompletionPipeline
    from PIL import Image

    pipe, found = build(MarigoldDepthCompletionPipeline), {}
    for case, (_, resolution, steps, members) in CASES.items():
        depth_m = pipe(Image.fromarray(image_u8(case)), sparse_depth(case), steps, members, resolution, SEED)
        found[case] = keep(depth_m)
    return found


if __name__ == "__main__":
    authors.write_fixture(run_authors)
