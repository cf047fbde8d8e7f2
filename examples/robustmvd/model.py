"""The guided call in the form that the robustmvd benchmark asks of a model, with its three metrics.

    from rmvd import create_dataset, create_evaluation  # github.com/lmb-freiburg/robustmvd
    from examples.robustmvd.model import GeoDiffModel

    evaluation = create_evaluation("mvd", inputs=["images", "intrinsics", "poses"], eval_uncertainty=True)
    results = evaluation(dataset=create_dataset("eth3d", "mvd"), model=GeoDiffModel("bundled"))

Nothing of the benchmark is imported here: a model is anything with these three methods.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin.evaluation.metrics import ause, evaluate_depth

__all__ = ["GeoDiffModel", "benchmark_metrics"]

#: Relative error within which a pixel is an inlier in the benchmark's tables.
INLIER = 1.03


class GeoDiffModel:
    """A prior that is made metric by the source views.

    Args:
        prior: anything that ``load_prior`` takes.
        device: torch device.
        seed: of the initial noise.
        max_sources: source views that are used, the nearest of the list first.
        **knobs: of ``GeometryGuidance``.
    """

    name = "geodiff"

    def __init__(
        self, prior: str = "bundled", device: str = "cpu", seed: int = 0, max_sources: int = 4, **knobs: Any
    ) -> None:
        self.pipe = enable_geometry_guidance(load_prior(prior, device=device))
        self.pipe.set_progress_bar_config(disable=True)
        self.seed, self.max_sources, self.knobs = seed, max_sources, knobs

    def input_adapter(
        self,
        images: Sequence[np.ndarray],
        keyview_idx: Any,
        poses: Sequence[np.ndarray] | None = None,
        intrinsics: Sequence[np.ndarray] | None = None,
        depth_range: Any = None,
    ) -> dict[str, Any]:
        """A batch of one sample, as the benchmark's loader collates it, as arguments of ``__call__``.

        Args:
            images: of every view ``(1, 3, H, W)`` float in [0, 255].
            keyview_idx: index of the view that gets the depth, a number or an array of one.
            poses: of every view ``(1, 4, 4)``, which takes points of a common frame into that of the view.
            intrinsics: of every view ``(1, 3, 3)``, pixels.
            depth_range: not used: the views give the range.

        Raises:
            ValueError: no poses or no intrinsics; a batch of several samples.
        """
        if poses is None or intrinsics is None:
            raise ValueError('Evaluate with inputs=["images", "intrinsics", "poses"]: metres come from them.')
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
            # The pose of each source camera in the key camera's frame.
            "E": [to_key @ np.linalg.inv(np.asarray(poses[i][0], np.float64)) for i in chosen],
        }

    def __call__(self, views: list[np.ndarray], K: list[np.ndarray], E: list[np.ndarray]) -> Any:
        """The ``MetricDepthOutput`` of the guided call; without a source view there is no scale."""
        if not E:
            raise ValueError("A source view must be given: one view alone has no scale.")
        posed = list(zip(views, K, [np.eye(4), *E], strict=True))
        guidance = GeometryGuidance.from_views(posed, **self.knobs)
        seeded = torch.Generator(self.pipe.device).manual_seed(self.seed)
        return self.pipe(views[0], guidance=guidance, generator=seeded)

    def output_adapter(self, output: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Depth ``(1, 1, H, W)`` metres and ``1 - confidence`` as its uncertainty; the rest beside it."""
        depth_m = np.asarray(output.prediction).transpose(0, 3, 1, 2)
        pred = {"depth": depth_m, "depth_uncertainty": np.zeros_like(depth_m)}
        if output.confidence is not None:
            pred["depth_uncertainty"] = 1.0 - np.asarray(output.confidence).transpose(0, 3, 1, 2)
        return pred, {"verdict": output.verdict.sentence, "warnings": list(output.warnings)}


def benchmark_metrics(
    depth_m: np.ndarray, truth_m: np.ndarray, uncertainty: np.ndarray | None = None
) -> dict[str, float]:
    """The benchmark's numbers for one map, by this package's own evaluation.

    Args:
        depth_m: ``(H, W)`` metres.
        truth_m: ``(H, W)`` metres, 0 where unknown.
        uncertainty: ``(H, W)``, larger is less certain.

    Returns:
        ``absrel`` and ``inliers103`` in per cent, ``ause`` as a share of ``absrel``: the benchmark divides
        its sparsification curves by their start.
    """
    valid = truth_m > 0
    clipped = np.clip(depth_m, 0.1, 100.0)  # as it clips what it is given
    abs_rel = evaluate_depth(clipped, truth_m, valid)["abs_rel"]
    ratio = np.maximum(clipped[valid] / truth_m[valid], truth_m[valid] / clipped[valid])
    scores = {"absrel": 100 * abs_rel, "inliers103": 100 * float(np.mean(ratio < INLIER))}
    if uncertainty is not None:
        scores["ause"] = ause(clipped, truth_m, valid, uncertainty) / abs_rel
    return scores
