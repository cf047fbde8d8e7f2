"""Metric depth from a diffusion prior and a second view, without training, as a plugin for diffusers.

>>> pipe = enable_geometry_guidance(load_prior("bundled"))
>>> out = pipe(left, guidance=GeometryGuidance(right, K, E))
>>> depth_m = out.prediction  # (1, H, W, 1), metres

The method follows GeoDiff (arXiv 2510.18291). Read the code along the path of one image: ``types``,
``geometry``, ``config``, ``matching``, ``scale``, ``algorithm``, ``guidance``, ``priors``,
``runtime``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors see; at run time names are imported on first use
    from geodiff_plugin._checks import InputError
    from geodiff_plugin.bundled import load_bundled_prior
    from geodiff_plugin.capture.capture import Capture
    from geodiff_plugin.config import GuidanceConfig
    from geodiff_plugin.formats.reading import read_calibration
    from geodiff_plugin.guidance.guidance import GeometryGuidance
    from geodiff_plugin.priors import PRIORS, load_prior
    from geodiff_plugin.runtime.pipeline import (
        GuidedMarigoldDepthPipeline,
        disable_geometry_guidance,
        enable_geometry_guidance,
    )
    from geodiff_plugin.types import MetricDepthOutput, Rig

__version__ = "0.1.0"

__all__ = [
    "PRIORS",
    "Capture",
    "GeometryGuidance",
    "GuidanceConfig",
    "GuidedMarigoldDepthPipeline",
    "InputError",
    "MetricDepthOutput",
    "Rig",
    "disable_geometry_guidance",
    "enable_geometry_guidance",
    "load_bundled_prior",
    "load_prior",
    "read_calibration",
]

#: Public name -> module, imported on first use so that ``import geodiff_plugin`` stays quick.
_MODULE_OF = {
    "Capture": "geodiff_plugin.capture.capture",
    "GeometryGuidance": "geodiff_plugin.guidance.guidance",
    "GuidanceConfig": "geodiff_plugin.config",
    "GuidedMarigoldDepthPipeline": "geodiff_plugin.runtime.pipeline",
    "InputError": "geodiff_plugin._checks",
    "MetricDepthOutput": "geodiff_plugin.types",
    "PRIORS": "geodiff_plugin.priors",
    "Rig": "geodiff_plugin.types",
    "disable_geometry_guidance": "geodiff_plugin.runtime.pipeline",
    "enable_geometry_guidance": "geodiff_plugin.runtime.pipeline",
    "load_bundled_prior": "geodiff_plugin.bundled",
    "load_prior": "geodiff_plugin.priors",
    "read_calibration": "geodiff_plugin.formats.reading",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
