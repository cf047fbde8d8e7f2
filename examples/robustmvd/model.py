"""Wraps the guided call as a model of the robustmvd benchmark, with its three metrics.

    from rmvd import create_dataset, create_evaluation  # github.com/lmb-freiburg/robustmvd
    from examples.robustmvd.model import GeoDiffModel

    evaluation = create_evaluation("mvd", inputs=["images", "intrinsics", "poses"], eval_uncertainty=True)
    results = evaluation(dataset=create_dataset("eth3d", "mvd"), model=GeoDiffModel("bundled"))

Does not import the benchmark: a model is any object with these three methods.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.evaluation.metrics import ause, evaluate_depth

__all__ = ["GeoDiffModel", "benchmark_metrics"]


class GeoDiffModel:
    """A prior made metric by the source views.

    Args:
        prior: any name accepted by ``load_prior``.
        device: torch device.
        seed: seed of the initial noise.
        max_sources: maximum number of source views; those nearest in the list are used first.
        **parameters: parameters of ``GeometryGuidance``.
    """

    name = "geodiff"

    def __init__(
        self,
        prior: str = "bundled",
        device: str = "cpu",
        seed: int = 0,
        max_sources: int = 4,
        **parameters: Any,
    ) -> None:
        self.pipe = enable_geometry_guidance(load_prior(prior, device=device))
        self.pipe.set_progress_bar_config(disable=True)
        self.seed, self.max_sources, self.parameters = seed, max_sources, parameters

    def input_adapter(
        self,
        images: Sequence[np.ndarray],
        keyview_idx: Any,
        poses: Sequence[np.ndarray] | None = None,
        intrinsics: Sequence[np.ndarray] | None = None,
        depth_range: Any = None,
    ) -> dict[str, Any]:
        """Convert a batch of one sample from the benchmark's loader to arguments of ``__call__``.

        Args:
            images: one per view, ``(1, 3, H, W)`` float in [0, 255].
            keyview_idx: index of the key view, a number or an array of one.
            poses: one per view, ``(1, 4, 4)`` world-to-camera.
            intrinsics: one per view, ``(1, 3, 3)`` pixels.
            depth_range: unused; the range is estimated from the views.

        Raises:
            ValueError: missing poses or intrinsics, or a batch of several samples.
        """
        if poses is None or intrinsics is None:
            raise ValueError(
                'Metric depth needs poses and intrinsics. Pass inputs=["images", "intrinsics", "poses"].'
            )
        if any(len(image) != 1 for image in images):
            raise ValueError(f"Evaluate one sample at a time; got a batch of {len(images[0])}.")
        key = int(np.asarray(keyview_idx).reshape(-1)[0])
        order = sorted((i for i in range(len(images)) if i != key), key=lambda i: abs(i - key))
        chosen = order[: self.max_sources]
        to_key = np.asarray(poses[key][0], np.float64)
        rows = [np.asarray(images[i][0]).transpose(1, 2, 0) for i in (key, *chosen)]
        return {
            "views": [np.clip(row, 0, 255).round().astype(np.uint8) for row in rows],
            "K": [np.asarray(intrinsics[i][0], np.float64) for i in (key, *chosen)],
            # pose of each source camera in the key camera's frame
            "E": [to_key @ np.linalg.inv(np.asarray(poses[i][0], np.float64)) for i in chosen],
        }

    def __call__(self, views: list[np.ndarray], K: list[np.ndarray], E: list[np.ndarray]) -> Any:
        """Run the guided call; needs a source view for the scale."""
        if not E:
            raise ValueError("At least one source view is needed; a single view has no metric scale.")
        posed = list(zip(views, K, [np.eye(4), *E], strict=True))
        guidance = GeometryGuidance.from_views(posed, **self.parameters)
        seeded = torch.Generator(self.pipe.device).manual_seed(self.seed)
        return self.pipe(views[0], guidance=guidance, generator=seeded)

    def output_adapter(self, output: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return depth ``(1, 1, H, W)`` metres, ``1 - confidence`` as uncertainty, and auxiliary output."""
        depth_m = np.asarray(output.prediction).transpose(0, 3, 1, 2)
        pred = {"depth": depth_m, "depth_uncertainty": np.zeros_like(depth_m)}
        if output.confidence is not None:
            pred["depth_uncertainty"] = 1.0 - np.asarray(output.confidence).transpose(0, 3, 1, 2)
        return pred, {"verdict": output.verdict.status, "findings": list(output.findings)}


def benchmark_metrics(
    depth_m: np.ndarray, ground_truth_m: np.ndarray, uncertainty: np.ndarray | None = None
) -> dict[str, float]:
    """Compute the benchmark's metrics of one map with this package's evaluation.

    Args:
        depth_m: ``(H, W)`` metres.
        ground_truth_m: ``(H, W)`` metres, 0 where unknown.
        uncertainty: ``(H, W)``, larger is less certain.

    Returns:
        ``absrel`` and ``inliers103`` in per cent, ``ause`` relative to ``absrel``: the benchmark normalises
        its sparsification curves by their first value.
    """
    valid = ground_truth_m > 0
    clipped = np.clip(depth_m, 0.1, 100.0)  # the benchmark clips predictions too
    measured = evaluate_depth(clipped, ground_truth_m, valid)
    abs_rel = measured["abs_rel"]
    scores = {"absrel": 100 * abs_rel, "inliers103": 100 * measured["inliers"]}
    if uncertainty is not None:
        scores["ause"] = ause(clipped, ground_truth_m, valid, uncertainty) / abs_rel
    return scores
