"""The paper's ablation that learns scale and shift and leaves the latents alone.

Data flow: ``StereoSample`` -> pipeline guided in two numbers -> metres.
Paper: S5.3, Table 4.
"""

from __future__ import annotations

from typing import Any

from geodiff_plugin.evaluation.baselines._guidance import guided_method
from geodiff_plugin.guidance.guidance import GeometryGuidance

__all__ = ["SCALE_SHIFT_ONLY"]


def _preset(right: Any, K: Any, E: Any) -> GeometryGuidance:
    return GeometryGuidance(right, K, E, optimize_latents=False, refine=False)


SCALE_SHIFT_ONLY = guided_method(
    "scale-shift-only", "scale, shift", "the default preset on scale and shift only", _preset
)
