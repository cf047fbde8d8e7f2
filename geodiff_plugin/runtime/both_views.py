"""``guide_both_views``: depth of both views, each with the other's confident depth as known points.

Data flow: left, right, K, E -> guided depth of both -> sure points into the other frame -> guided again.
Paper: none; it leaves a left-right term out (docs/reference/paper-map.md).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.formats import as_image_01
from geodiff_plugin.geometry import NEAREST_M, project, transform, unproject
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.guidance.posing import cleaned_views, pose_views
from geodiff_plugin.types import MetricDepthOutput, Rig

__all__ = ["guide_both_views"]


def guide_both_views(
    pipe: Any,
    left: Any,
    right: Any,
    K: Any,
    E: Any,
    *,
    min_confidence: float = 0.8,
    knobs: dict[str, Any] | None = None,
    **call: Any,
) -> tuple[MetricDepthOutput, MetricDepthOutput]:
    """Metric depth of the left and of the right view, consistent with each other.

    Four guided calls: each view by itself, then each with known points where the other view is confident and
    it is not: a surface that is oblique in one view may be frontal, and therefore certain, in the other.

    Args:
        pipe: with guidance enabled.
        left: left image.
        right: right image.
        K: as in ``GeometryGuidance``, for one pair.
        E: likewise.
        min_confidence: of the points that are handed over, [0, 1].
        knobs: hyperparameters of ``GeometryGuidance``.
        **call: arguments of the pipeline's call; a ``generator`` goes on through the four calls.

    Returns:
        Output of the left view and output of the right one, each at its own image's size.

    Raises:
        ValueError: a preset without confidence (``refine=False``, or no matches); ``points`` or ``previous``
            among the knobs.
    """
    check_number(min_confidence, "min_confidence", 0.0, 1.0)
    knobs = knobs or {}
    for name in sorted({"points", "previous"} & set(knobs)):
        bad_value(f"knobs[{name!r}]", "left out", "given", "It belongs to one view, and here are two.")
    rig, knobs = _refined_rig(GeometryGuidance(right, K, E, **knobs), left), {**knobs, "pose": "given"}
    back = Rig(rig.K_right, rig.K_left, np.linalg.inv(rig.E))
    views = ((left, right, rig), (right, left, back))
    # Rendered points need the images' own pixels: confidence and depth come at the input's resolution.
    options = {**call, "match_input_resolution": True, "output_type": "pt", "return_dict": True}
    first = [pipe(own, guidance=_guidance(other, r, knobs), **options) for own, other, r in views]
    confident = [
        _confident_points(out, r, min_confidence) for out, (_, _, r) in zip(first, views, strict=True)
    ]
    options["output_type"] = call.get("output_type", "np")
    second = []
    for (own, other, r), points, alone in zip(views, reversed(confident), first, strict=True):
        news = _news(points, r, alone, min_confidence)
        guidance = _guidance(other, r, knobs, news if len(news) else None)
        guidance.points_measured = False
        second.append(pipe(own, guidance=guidance, **options))
    return second[0], second[1]


def _refined_rig(guidance: GeometryGuidance, left: Any) -> Rig:
    """The rig with the pose that the four calls share, refined once where the knob says so.

    The right image stays as it is: it gets depth too.
    """
    rights, K_left, _ = guidance.inputs[0].on(torch.device("cpu"))
    left_01, rights = cleaned_views(as_image_01(left, "left"), rights, guidance.config)
    found = pose_views(left_01, rights, K_left, guidance.config, guidance.unit)
    return replace(guidance.rigs[0], E=found.report.E[0])


def _guidance(other: Any, rig: Rig, knobs: dict[str, Any], points: Tensor | None = None) -> GeometryGuidance:
    return GeometryGuidance(other, (rig.K_left, rig.K_right), rig.E, points=points, **knobs)


def _confidence(output: MetricDepthOutput) -> Tensor:
    """``(1, 1, H, W)`` of an output in torch."""
    if output.confidence is None:
        cure = "Keep refine=True and a weight for matches."
        bad_value("knobs", "of a preset that knows how sure it is", "one without confidence", cure)
    return cast(Tensor, output.confidence)


def _confident_points(output: MetricDepthOutput, rig: Rig, min_confidence: float) -> Tensor:
    """Points ``(N, 3)`` of a view's depth in the other view's frame, in E's lengths; the confident ones."""
    # A metric prior may have turned it into metres: T is in the lengths of the guidance.
    confidence, depth_m = _confidence(output), cast(Tensor, output.prediction).float() / output.rescaled
    K = torch.as_tensor(rig.K_left, dtype=torch.float32, device=depth_m.device)[None]
    T = torch.as_tensor(rig.T_right_from_left, dtype=torch.float32, device=K.device)[None]
    points = transform(unproject(depth_m, K), T)  # (1, H, W, 3)
    return points[confidence[:, 0] >= min_confidence]


def _news(points: Tensor, rig: Rig, alone: MetricDepthOutput, min_confidence: float) -> Tensor:
    """Those of the other view's points that fall on pixels of which this view is not sure by itself.

    A point that its own surface hides from here falls on one that this view knows, and is left out.
    """
    K = torch.as_tensor(rig.K_left, dtype=torch.float32, device=points.device)[None]
    uv, z = (x[0, 0] for x in project(points[None, None], K))
    confidence = _confidence(alone)[0, 0]
    height, width = confidence.shape
    column, row = uv.round().long().unbind(1)
    inside = (z > NEAREST_M) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    unsure = confidence[row.clamp(0, height - 1), column.clamp(0, width - 1)] < min_confidence
    return points[inside & unsure]
