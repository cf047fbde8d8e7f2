"""A depth map from any other model as a prior: one step without a network; the map is the estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.checks import bad_type, bad_value
from geodiff_plugin.algorithm.edges import sharpen_edges
from geodiff_plugin.algorithm.solver import solve_field
from geodiff_plugin.algorithm.systems import FieldSystem
from geodiff_plugin.geometry import image_size
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import Condition, DirectMapPipeline, Generators
from geodiff_plugin.priors.transformers_depth import range_of
from geodiff_plugin.scale.space import SPACES

#: Layout of ``load_prior("map")``, which needs no folder.
MAP_LAYOUT = Layout(Path(__file__).with_suffix(""), "map")
#: Weight of a known pixel relative to the affinities to its neighbours when holes are filled.
KNOWN_WEIGHT = 100.0
#: Conjugate-gradient steps of the fill per grid of the pyramid.
FILL_STEPS = 20
#: Known fraction above which a pixel of a resized map keeps the map's value.
ALL_KNOWN = 0.999
#: Smallest depth relative to the median above which zeros of a map are holes. Depth in 256 levels is below.
ZERO_GAP = 0.05
#: Image pixels per map pixel above which edges are sharpened after upsampling.
MIN_UPSAMPLING = 1.5
#: Offset that turns a map in [0, 1] into a substitute for inverse depth, in which edges are relative steps.
OFFSET = 0.25
#: Product of the log aspect ratios below which map and image have opposite orientations.
MIN_LOG_PRODUCT = -0.01


class DepthMapPipeline(DirectMapPipeline):
    """Takes ``depth_map=`` in the call instead of a network; guidance changes the map itself.

    ``processing_resolution`` is the longer side of the guided map, 0 for the image's own size.
    """

    takes_map = True

    def __init__(
        self,
        scheduler: DirectScheduler,
        prediction_type: str = "depth",
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 0,
    ) -> None:
        super().__init__()
        self._device = torch.device("cpu")  # no weights that define a device
        defaults = prediction_type, default_denoising_steps, default_processing_resolution
        self.register_prior({"scheduler": scheduler}, *defaults, image_processor=1)

    @property
    def device(self) -> torch.device:
        """Device on which calls run."""
        return self._device

    def to(self, *args: Any, **kwargs: Any) -> DepthMapPipeline:
        """Move as in ``DiffusionPipeline.to``; maps stay in float32."""
        for target in (*args, *kwargs.values()):
            if isinstance(target, (str, int, torch.device)):
                self._device = torch.device(target)
        return self

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Recognise a pipeline that consists of a ``DirectScheduler`` only."""
        parts = [name for name, value in layout.index.items() if isinstance(value, list)]
        return parts == ["scheduler"] and layout.index["scheduler"][1] == DirectScheduler.__name__

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> DepthMapPipeline:
        """Create a pipeline without weights; ``"map"`` contains depth unless ``space`` states otherwise."""
        if layout == MAP_LAYOUT:
            return cls(DirectScheduler(timestep=0), space or "depth")
        return super().load(layout, dtype, space)

    def prepare_condition(
        self,
        image: Tensor,
        ensemble_size: int,
        batch_size: int,
        generator: Generators,
        depth_map: np.ndarray | Tensor | Sequence[np.ndarray | Tensor] | None = None,
    ) -> Condition:
        """Resample the maps to the image's grid, from 0 to about 1, with holes filled smoothly.

        ``depth_map`` has one map ``(h, w)`` per image, of any size and unit, that covers the same view, as an
        array ``(N, h, w)`` or a list; non-finite where unknown, or 0 in a depth map that is far above 0
        elsewhere.
        """
        maps = _as_list(depth_map, self.space)
        if len(maps) != len(image):
            bad_value("depth_map", f"one map (h, w) for each of {len(image)} images", f"{len(maps)}")
        size = image_size(image)
        prepared, ranges = [], []
        for (values, low), view in zip(maps, image.float().split(1), strict=True):
            sides = values.shape[-1] / values.shape[-2], size[1] / size[0]
            if math.log(sides[0]) * math.log(sides[1]) < MIN_LOG_PRODUCT:
                got = "{1}x{0} pixels".format(*values.shape[-2:])
                bad_value(
                    "depth_map", f"{size[1]}x{size[0]} pixels, like the image", got, "Is it transposed?"
                )
            filled, known, span = _filled(values.to(view.device))
            ranges.append(_metres(self.space, low, low + float(span)))
            inside = F.interpolate(known.float(), size, mode="bilinear", antialias=True) > ALL_KNOWN
            prepared.append((_resized(filled, view / 2 + 0.5), inside))
        relative, known = (
            torch.cat(part).repeat_interleave(ensemble_size, dim=0) for part in zip(*prepared, strict=True)
        )
        self.valid = None if bool(known.all()) else known
        has_metres = any(near > 0 for near, _ in ranges)
        ends_m = relative.new_tensor(ranges).repeat_interleave(ensemble_size, dim=0)
        self.metric_range = ends_m if has_metres else None
        return {"image_latent": relative}


def _metres(space: str, low: float, high: float) -> tuple[float, float]:
    """Return the depths of a map's lowest and highest value, if it is in metres; NaN if it cannot be."""
    ends_m = SPACES[space].forward(torch.tensor([low, high], dtype=torch.float32), torch.ones(1))
    can_be_metres = (low > 0.0 or space == "log") and bool(((ends_m > 0) & ends_m.isfinite()).all())
    return (float(ends_m[0]), float(ends_m[1])) if can_be_metres else (math.nan, math.nan)


def _as_list(given: Any, space: str) -> list[tuple[Tensor, float]]:
    """Convert ``depth_map`` to maps ``(1, 1, h, w)`` float32 starting at 0, and their minima before that.

    They are NaN where unknown.
    """
    if given is None:
        hint = "Use pipe(left, depth_map=array, guidance=...), or --prior-map FILE."
        bad_value("depth_map", "passed to the prior 'map'", "nothing", hint)
    if isinstance(given, (np.ndarray, Tensor)):
        given = given[..., 0] if given.ndim == 3 and given.shape[-1] == 1 else given  # (H, W, 1)
        given = [given] if given.ndim == 2 else list(given)
    if not isinstance(given, (list, tuple)) or not all(isinstance(m, (np.ndarray, Tensor)) for m in given):
        bad_type("depth_map", "an array (h, w) or (N, h, w), or a list of arrays (h, w)", given)
    return [_from_zero(each, space) for each in given]


def _has_empty_zeros(known: Tensor) -> bool:
    """Whether the zeros of a depth map ``(N,)`` mean unknown, because all other depths are far above 0."""
    others = known[known != 0]
    return 0 < len(others) < len(known) and bool(others.min() > ZERO_GAP * others.median())


def _from_zero(given: np.ndarray | Tensor, space: str) -> tuple[Tensor, float]:
    """Return a map minus its minimum, ``(1, 1, h, w)`` float32, NaN where unknown, and the minimum."""
    values = torch.as_tensor(np.ascontiguousarray(given) if isinstance(given, np.ndarray) else given)
    if values.ndim != 2 or min(values.shape) < 2 or values.is_complex():
        bad_value("depth_map", "a map (h, w) of 2 x 2 pixels or more", f"shape {tuple(values.shape)}")
    # Not float64 for all: Apple GPUs lack it, and the difference of two float32 values is as exact in
    # float32.
    values = values if values.dtype in (torch.float32, torch.float64) else values.float()
    inside = values.isfinite()
    if space == "depth" and _has_empty_zeros(values[inside]):
        inside &= values != 0
    if not inside.any() or values[inside].min() == values[inside].max():
        hint = "Non-finite values mean unknown; a map needs at least two different depths."
        bad_value("depth_map", "a map with two different finite values", "none", hint)
    low = values[inside].min()  # before float32, which would round a small range far from 0
    from_zero = torch.where(inside, values - low, values.new_tensor(torch.nan)).float()[None, None]
    return from_zero, float(low)


def _filled(values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Scale a map's minimum to 0 and its 98 % quantile to 1, and fill its holes.

    Returns the map, where it is known, and the difference ``(1,)`` of quantile and minimum.
    """
    known = values.isfinite()
    low, high = range_of(values[known][None, None, None])
    if high <= low:  # nearly all of it is flat
        high = values[known].max()[None]
    span = high - low
    values = torch.where(known, (values - low) / span, torch.zeros_like(values))
    if bool(known.all()):
        return values, known, span
    weight = KNOWN_WEIGHT * known.float()
    affinities = torch.ones_like(values)
    system = FieldSystem(weight, weight * values, affinities[..., 1:], affinities[..., 1:, :])
    return torch.where(known, values, solve_field(system, FILL_STEPS)), known, span


def _resized(values: Tensor, left_01: Tensor) -> Tensor:
    """Resize a map ``(1, 1, h, w)`` to its image, with edges sharpened after upsampling."""
    size = image_size(left_01)
    if image_size(values) == size:
        return values
    resized = F.interpolate(values, size, mode="bilinear", antialias=True)
    ratio = max(new / old for new, old in zip(size, image_size(values), strict=True))
    if ratio < MIN_UPSAMPLING:
        return resized
    return 1.0 / sharpen_edges(1.0 / (resized + OFFSET), left_01, round(ratio)) - OFFSET
