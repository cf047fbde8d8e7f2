"""Validation of a prior: held-out scenes, aligned errors, a contact sheet.

Data flow: pipeline, images, depth -> AbsRel and delta1 after a least-squares fit -> numbers, PNG.
Paper: S5.1 (AbsRel, delta1); the alignment is Marigold's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from diffusers import MarigoldDepthPipeline
from PIL import Image

from examples.training.data import SCORED_M
from geodiff_plugin.evaluation.metrics import align, evaluate_depth

__all__ = ["contact_sheet", "predict", "score_scenes"]


@torch.no_grad()
def predict(
    pipeline: MarigoldDepthPipeline,
    images_01: torch.Tensor,
    steps: int | None = None,
    resolution: int | None = None,
) -> np.ndarray:
    """Relative depth ``(N, H, W)`` in [0, 1] of images ``(N, 3, H, W)`` in [0, 1], seed 0, ensemble 1."""
    maps = []
    for image in images_01:
        out = pipeline(
            image[None],
            num_inference_steps=steps,
            processing_resolution=resolution,
            generator=torch.Generator(pipeline.device).manual_seed(0),
        )
        maps.append(out.prediction[0, ..., 0])
    return np.stack(maps)


def score_scenes(
    pipeline: MarigoldDepthPipeline,
    images_01: torch.Tensor,
    depth_m: torch.Tensor,
    steps: int | None = None,
    resolution: int | None = None,
) -> tuple[float, float]:
    """Mean aligned AbsRel and delta1 over rendered scenes; sky and depths beyond ``SCORED_M`` are excluded.

    Args:
        pipeline: the prior.
        images_01: ``(N, 3, H, W)``.
        depth_m: ``(N, 1, H, W)`` metres, inf for sky.
        steps: denoising steps; the pipeline's default for ``None``.
        resolution: processing resolution; the pipeline's default for ``None``.

    Returns:
        AbsRel, delta1.
    """
    predictions = predict(pipeline, images_01, steps, resolution)
    scores = []
    for prediction, depth in zip(predictions, depth_m[:, 0].numpy(), strict=True):
        valid = depth < SCORED_M
        if valid.sum() > 100:
            aligned = align(prediction, depth, valid, pipeline.config.prediction_type)
            found = evaluate_depth(aligned, depth, valid)
            scores.append((found["abs_rel"], found["delta1"]))
    return tuple(float(value) for value in np.mean(scores, axis=0))


def contact_sheet(
    images_01: torch.Tensor,
    depth_m: torch.Tensor,
    predictions: np.ndarray,
    path: str | Path,
    space: str,
    columns: int = 3,
) -> None:
    """Write image, ground truth and prediction side by side as a PNG, with one colour scale per scene.

    Args:
        images_01: ``(N, 3, H, W)``.
        depth_m: ``(N, 1, H, W)`` metres, inf for sky.
        predictions: ``(N, H, W)`` relative depth.
        path: file to write atomically.
        space: prediction space, see ``alignment.align``.
        columns: scenes per row.
    """
    tiles = []
    for image, depth, prediction in zip(images_01, depth_m[:, 0].numpy(), predictions, strict=True):
        valid = depth < SCORED_M
        low, high = np.quantile(depth[valid], [0.02, 0.98]) if valid.any() else (0.0, 1.0)
        fitted = align(prediction, depth, valid, space) if valid.sum() > 1 else prediction
        maps = [np.where(valid, depth, high), fitted]
        images = [_colour((m - low) / max(high - low, 1e-6)) for m in maps]
        photo = (image.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        tiles.append(np.concatenate([photo, *images], axis=1))
    blank = np.full_like(tiles[0], 255)
    tiles += [blank] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[i : i + columns], axis=1) for i in range(0, len(tiles), columns)]
    path = Path(path)
    part = path.with_suffix(".part")
    Image.fromarray(np.concatenate(rows)).save(part, format="PNG", optimize=True)
    part.replace(path)


def _colour(unit: np.ndarray) -> np.ndarray:
    """Colour depth as diffusers does for Marigold, near red and far blue; ``(H, W, 3)`` uint8."""
    import matplotlib

    table = matplotlib.colormaps["Spectral"]
    return (table(np.clip(unit, 0.0, 1.0))[..., :3] * 255).round().astype(np.uint8)
