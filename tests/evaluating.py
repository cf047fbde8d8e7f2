"""Runs methods on samples as the commands of the evaluation do."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
from PIL import Image
from typer.testing import CliRunner

from geodiff_plugin.cli.eval import eval_app
from geodiff_plugin.evaluation.experiment import measure_cells, method_cells
from geodiff_plugin.formats import write_pfm

SHIFT, SIZE = 8, (48, 144)


def run(refs, methods, settings, out, *, skip_broken=False, **keywords):
    """Records of every method on every sample; keywords as of ``method_cells``."""
    options = SimpleNamespace(out=Path(out), quiet=True, skip_broken=skip_broken)
    return measure_cells(method_cells(refs, methods, settings, Path(out), **keywords), options)


def write_scenes(root, *names):
    """Scenes in Middlebury's layout: a textured wall with 8 px of disparity, 1.25 m away."""
    for seed, name in enumerate(names):
        scene = root / name
        scene.mkdir(parents=True)
        wide = np.random.default_rng(seed).integers(0, 256, (SIZE[0], 160, 3), dtype=np.uint8)
        for k, start in enumerate((0, SHIFT)):
            Image.fromarray(wide[:, start : start + SIZE[1]]).save(scene / f"im{k}.png")
        write_pfm(scene / "disp0.pfm", np.full(SIZE, SHIFT, np.float32))
        camera, size = "[100 0 72; 0 100 24; 0 0 1]", "width=144\nheight=48\nndisp=16\n"
        (scene / "calib.txt").write_text(f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline=100\n{size}")
    return root


def invoke(*words):
    """What ``geodiff eval`` prints."""
    return CliRunner().invoke(eval_app, [str(word) for word in words], catch_exceptions=False).stdout
