"""Metric depth from a diffusion prior and a second view, without training, as a plugin for diffusers.

>>> pipe = enable_geometry_guidance(load_prior("bundled"))
>>> out = pipe(left, guidance=GeometryGuidance(right, K, E))
>>> depth_m = out.prediction  # (1, H, W, 1), metres

The method follows GeoDiff (arXiv 2510.18291). Read the code along the path of one image, in three phases:
``evidence`` (what the views show, before the first guided step), ``algorithm`` (what guidance does at each
denoising step), ``result`` (depth at the image's size, its confidence and its verdict). ``runtime`` runs them
in a call of the pipeline. Below them lie ``types``, ``geometry``, ``config``, ``matching``, ``pose`` and
``scale``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from geodiff_plugin._internal.lazy import declared, importer

if TYPE_CHECKING:  # what type checkers and editors see; at run time names are imported on first use
    from geodiff_plugin._internal.checks import InputError as InputError
    from geodiff_plugin.bundled import load_bundled_prior as load_bundled_prior
    from geodiff_plugin.capture.frames import Capture as Capture
    from geodiff_plugin.config import GuidanceConfig as GuidanceConfig
    from geodiff_plugin.evidence.guidance import GeometryGuidance as GeometryGuidance
    from geodiff_plugin.formats import read_calibration as read_calibration
    from geodiff_plugin.priors import PRIORS as PRIORS
    from geodiff_plugin.priors import load_prior as load_prior
    from geodiff_plugin.result.output import MetricDepthOutput as MetricDepthOutput
    from geodiff_plugin.runtime.guided_call import GuidedMarigoldDepthPipeline as GuidedMarigoldDepthPipeline
    from geodiff_plugin.runtime.guided_call import disable_geometry_guidance as disable_geometry_guidance
    from geodiff_plugin.runtime.guided_call import enable_geometry_guidance as enable_geometry_guidance
    from geodiff_plugin.streaming.loop import LiveFrame as LiveFrame
    from geodiff_plugin.streaming.loop import live as live
    from geodiff_plugin.streaming.sources import StereoFrame as StereoFrame
    from geodiff_plugin.types import Rig as Rig

__version__ = "0.1.0"

_MODULE_OF = declared(__name__)
__all__ = sorted(_MODULE_OF)
__getattr__ = importer(__name__, _MODULE_OF)


def __dir__() -> list[str]:
    return sorted(__all__)
