"""Zero-shot errors of the bundled prior: ``python -m examples.training.evaluate``.

Data flow: real pairs (left image, ground truth) and held-out rendered scenes -> aligned errors -> Markdown.
Paper: S5.1 (AbsRel, delta1); the plane and the constant are our baselines, which any prior must beat.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from diffusers import MarigoldDepthPipeline

from examples.training.data import held_out
from examples.training.validate import contact_sheet, predict, score_scenes
from geodiff_plugin.bundled import open_pipeline
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.metrics import align, evaluate_depth
from geodiff_plugin.priors import BUNDLED_FOLDER

__all__ = ["best_constant", "best_plane", "main", "score_pairs"]


def best_plane(depth_m: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Fit the least-squares plane ``a x + b y + c`` to the ground-truth depth.

    Args:
        depth_m: ``(H, W)`` metres.
        valid: ``(H, W)`` bool.

    Returns:
        ``(H, W)`` float64 metres.
    """
    y, x = np.mgrid[: depth_m.shape[0], : depth_m.shape[1]].astype(np.float64)
    basis = np.stack([x / depth_m.shape[1], y / depth_m.shape[0], np.ones_like(x)], axis=-1)
    weights = np.linalg.lstsq(basis[valid], depth_m[valid].astype(np.float64), rcond=None)[0]
    return np.maximum(basis @ weights, 1e-3)


def best_constant(depth_m: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return a map of the mean ground-truth depth, ``(H, W)`` float64 metres: the least-squares constant."""
    return np.full(depth_m.shape, float(depth_m[valid].astype(np.float64).mean()))


def score_pairs(
    pipeline: MarigoldDepthPipeline, root: Path, steps: int | None = None, resolution: int | None = None
) -> list[dict[str, str | float]]:
    """Compute AbsRel and delta1 from the left image alone, for every metric pair below a folder.

    Args:
        pipeline: the prior.
        root: data folder in the official layouts.
        steps: denoising steps; the pipeline's default for ``None``.
        resolution: processing resolution; the pipeline's default for ``None``.

    Returns:
        One row per pair: ``dataset``, ``name``, ``prior``, ``delta1``, ``plane``, ``constant``.
    """
    rows = []
    for sample in map(load, find_pairs(root)):
        depth, valid = np.asarray(sample.depth_m), np.asarray(sample.valid)
        image = torch.from_numpy(np.ascontiguousarray(sample.left)).permute(2, 0, 1)[None].float() / 255.0
        prediction = predict(pipeline, image, steps, resolution)[0]
        aligned = align(prediction, depth, valid, pipeline.config.prediction_type)
        found = evaluate_depth(aligned, depth, valid)
        rows.append(
            {
                "dataset": sample.dataset,
                "name": sample.name,
                "prior": found["abs_rel"],
                "delta1": found["delta1"],
                "plane": evaluate_depth(best_plane(depth, valid), depth, valid)["abs_rel"],
                "constant": evaluate_depth(best_constant(depth, valid), depth, valid)["abs_rel"],
            }
        )
    return rows


def _table(rows: list[dict[str, str | float]]) -> str:
    lines = [
        "| dataset | pair | prior | delta1 | plane | constant |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    keys = ("prior", "delta1", "plane", "constant")
    mean = {key: float(np.mean([row[key] for row in rows])) for key in keys}
    lines += [
        f"| {row['dataset']} | {row['name']} | " + " | ".join(f"{row[k]:.3f}" for k in keys) + " |"
        for row in [*rows, {"dataset": "mean", "name": f"{len(rows)} pairs"} | mean]
    ]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> None:
    """Command line; see ``--help``."""
    parser = argparse.ArgumentParser(prog="python -m examples.training.evaluate", description=__doc__)
    parser.add_argument(
        "--prior", type=Path, default=BUNDLED_FOLDER, help="pipeline folder; the bundled one by default"
    )
    parser.add_argument("--data", type=Path, help="folder of real pairs; none are scored without it")
    parser.add_argument("--scenes", type=int, default=200, help="held-out rendered scenes, 0 for none")
    parser.add_argument("--steps", type=int, nargs="*", help="denoising steps to try; the default if omitted")
    parser.add_argument("--resolution", type=int, nargs="*", help="processing resolutions to try")
    parser.add_argument("--sheet", type=Path, help="PNG of six held-out scenes to write")
    parser.add_argument("--threads", type=int, default=0, help="number of threads; 0: torch's default")
    options = parser.parse_args(argv)
    if options.threads:
        torch.set_num_threads(options.threads)
    pipeline = open_pipeline(options.prior)
    for resolution in options.resolution or [None]:
        for steps in options.steps or [None]:
            setting = [steps or pipeline.default_denoising_steps, resolution]
            setting[1] = pipeline.default_processing_resolution if resolution is None else resolution
            print(f"\nsteps {setting[0]}, resolution {setting[1]}")
            if options.data:
                print(_table(score_pairs(pipeline, options.data, steps, resolution)))
            if options.scenes:
                images, depth = held_out(options.scenes)
                abs_rel, delta1 = score_scenes(pipeline, images, depth, steps, resolution)
                print(f"{options.scenes} held-out scenes: AbsRel {abs_rel:.3f}, delta1 {delta1:.3f}")
    if options.sheet:
        images, depth = held_out(6)
        space = pipeline.config.prediction_type
        contact_sheet(images, depth, predict(pipeline, images), options.sheet, space, columns=1)


if __name__ == "__main__":
    main()
