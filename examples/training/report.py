"""Reports of a training run: losses, held-out errors, a contact sheet, the current prior.

Data flow: averaged weights -> pipeline folder, ``log.jsonl``, ``contact.png`` in the run's folder.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

import torch
from diffusers import MarigoldDepthPipeline
from safetensors.torch import load_file, save_file

from examples.training.data import held_out
from examples.training.models import save_prior
from examples.training.state import Average, Progress
from examples.training.validate import contact_sheet, predict, score_scenes

__all__ = ["Reporter"]

_SHEET = 12


class Reporter:
    """Validates and saves at intervals.

    Args:
        options: from ``train.parse``.
        pipeline: holds the trained VAE and a U-Net that receives the averaged weights.
    """

    def __init__(self, options: argparse.Namespace, pipeline: MarigoldDepthPipeline) -> None:
        self._options, self._pipeline = options, pipeline
        self._next = None
        self.mean_loss = float("nan")

    def loss(self, loss: torch.Tensor) -> None:
        """Add a training loss to the running mean."""
        value = float(loss.detach())
        self.mean_loss = value if self.mean_loss != self.mean_loss else 0.99 * self.mean_loss + 0.01 * value

    def due(self, progress: Progress) -> bool:
        """Return whether a report is due; never at the start."""
        every = 60 * self._options.validate_minutes
        if self._next is None:
            self._next = progress.seconds + every
        return progress.seconds >= self._next

    def report(
        self, progress: Progress, average: Average, divisor: int, last: bool = False
    ) -> dict[str, float]:
        """Score the averaged weights, write them and the contact sheet.

        Args:
            progress: counters for the log.
            average: weights to evaluate.
            divisor: smallest divisor of the stage; scenes are processed at its largest training size.
            last: also try several steps.

        Returns:
            The line written to ``log.jsonl``.
        """
        out = self._options.out
        average.copy_to(self._pipeline.unet)
        images, depth = self._scenes()
        resolution = max(images.shape[-2:]) // divisor
        line = asdict(progress) | {"loss": self.mean_loss}
        for steps in (1, 2, 4) if last else (1,):
            scores = score_scenes(self._pipeline, images, depth, steps, resolution)
            line[f"abs_rel_{steps}"], line[f"delta1_{steps}"] = scores
        self._pipeline.register_to_config(default_processing_resolution=resolution)
        save_prior(self._pipeline, out / "prior")
        with (out / "log.jsonl").open("a") as log:
            log.write(json.dumps({key: round(value, 5) for key, value in line.items()}) + "\n")
        shown = slice(0, _SHEET)
        predictions = predict(self._pipeline, images[shown], 1, resolution)
        space = self._pipeline.config.prediction_type
        contact_sheet(images[shown], depth[shown], predictions, out / "contact.png", space)
        self._next = progress.seconds + 60 * self._options.validate_minutes
        return line

    def _scenes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Held-out scenes, rendered once and stored in the run's folder."""
        count = self._options.validation_scenes
        path = self._options.out / f"held_out_{count}.safetensors"
        if not path.exists():
            images, depth = held_out(count)
            save_file({"images": images.contiguous(), "depth": depth.contiguous()}, path)
        kept = load_file(path)
        return kept["images"], kept["depth"]
