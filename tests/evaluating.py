"""Samples for the commands of the evaluation, and their calls."""

import numpy as np
from click.testing import CliRunner
from PIL import Image

from geodiff_plugin.cli.eval import eval_app
from geodiff_plugin.formats import write_pfm


def write_scenes(root, *names):
    """Scenes in Middlebury's layout: a textured wall with 8 px of disparity, 1.25 m away."""
    for seed, name in enumerate(names):
        (root / name).mkdir(parents=True)
        wide = np.random.default_rng(seed).integers(0, 256, (48, 160, 3), dtype=np.uint8)
        for k, start in enumerate((0, 8)):
            Image.fromarray(wide[:, start : start + 144]).save(root / name / f"im{k}.png")
        write_pfm(root / name / "disp0.pfm", np.full((48, 144), 8, np.float32))
        cameras = "".join(f"cam{k}=[100 0 72; 0 100 24; 0 0 1]\n" for k in (0, 1))
        rest = "doffs=0\nbaseline=100\nwidth=144\nheight=48\nndisp=16\n"
        (root / name / "calib.txt").write_text(cameras + rest)
    return root


def invoke(*words):
    """What ``geodiff eval`` prints."""
    return CliRunner().invoke(eval_app, [str(word) for word in words], catch_exceptions=False).stdout
