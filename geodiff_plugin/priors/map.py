"""A depth map from any other model as a prior: one step, no network, the map is the estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._checks import bad_type, bad_value
from geodiff_plugin.algorithm.edges import sharpen_edges
from geodiff_plugin.algorithm.solver import FieldSystem, solve_field
from geodiff_plugin.geometry import image_size
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import Condition, DirectMapPipeline, Generators
from geodiff_plugin.priors.transformers_depth import range_of

#: What ``load_prior("map")`` loads: no folder is there, and none is needed.
MAP_LAYOUT = Layout(Path(__file__).with_suffix(""), "map")
#: Weight of a known pixel against its links to its neighbours, where holes are filled.
FIRM = 100.0
#: Conjugate-gradient steps of the fill, for every grid of the pyramid.
FILL_STEPS = 20
#: Where a resized map mixes in less than this of a hole, its value is the map's.
ALL_KNOWN = 0.999
#: Image pixels to a pixel of the map from which its edges are made steep again after enlargement.
ENLARGED = 1.5
#: Offset that makes a map in [0, 1] a stand-in for inverse depth, in which edges are relative steps.
OFFSET = 0.25
#: Product of the logs of width over height below which a wide map belongs to no tall image.
UPRIGHT = -0.01


class DepthMapPipeline(DirectMapPipeline):
    """Takes ``depth_map=`` in the call in place of a network; what guidance moves is the map itself.

    ``processing_resolution`` is the longer side of the map that is guided, 0 for the image's own.
    """

    def __init__(
        self,
        scheduler: DirectScheduler,
        prediction_type: str = "depth",
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 0,
    ) -> None:
        super().__init__()
        self._place = torch.device("cpu")  # there are no weights that would tell
        defaults = prediction_type, default_denoising_steps, default_processing_resolution
        self.register_prior({"scheduler": scheduler}, *defaults, image_processor=1)

    @property
    def device(self) -> torch.device:
        """Where calls run."""
        return self._place

    def to(self, *args: Any, **kwargs: Any) -> DepthMapPipeline:
        """As ``DiffusionPipeline.to``; maps stay in float32."""
        for target in (*args, *kwargs.values()):
            if isinstance(target, (str, int, torch.device)):
                self._place = torch.device(target)
        return self

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """A pipeline that consists of a ``DirectScheduler`` alone."""
        parts = [name for name, value in layout.index.items() if isinstance(value, list)]
        return parts == ["scheduler"] and layout.index["scheduler"][1] == DirectScheduler.__name__

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> DepthMapPipeline:
        """A pipeline without weights; of ``"map"`` the values are depth unless ``space`` says otherwise."""
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
        """The maps on the image's grid, from 0 to about 1, holes filled smoothly.

        ``depth_map`` has for every image a map ``(h, w)`` of any size and unit that covers the same view, in
        an array ``(N, h, w)`` or a list; not finite where nothing is known.
        """
        maps = _as_list(depth_map)
        if len(maps) != len(image):
            bad_value("depth_map", f"one map (h, w) for each of {len(image)} images", f"{len(maps)}")
        size, prepared = image_size(image), []
        for values, view in zip(maps, image.float().split(1), strict=True):
            sides = values.shape[-1] / values.shape[-2], size[1] / size[0]
            if math.log(sides[0]) * math.log(sides[1]) < UPRIGHT:
                got = "{1}x{0} pixels".format(*values.shape[-2:])
                bad_value("depth_map", f"of the image's {size[1]}x{size[0]} pixels", got, "Is it transposed?")
            filled, known = _filled(values.to(view.device))
            inside = F.interpolate(known.float(), size, mode="bilinear", antialias=True) > ALL_KNOWN
            prepared.append((_resized(filled, view / 2 + 0.5), inside))
        relative, known = (
            torch.cat(part).repeat_interleave(ensemble_size, dim=0) for part in zip(*prepared, strict=True)
        )
        self.valid = None if bool(known.all()) else known
        return {"image_latent": relative}


def _as_list(given: Any) -> list[Tensor]:
    """``depth_map`` as maps ``(1, 1, h, w)`` float32 from 0, NaN where unknown."""
    if given is None:
        cure = "pipe(left, depth_map=array, guidance=...), or --prior-map FILE."
        bad_value("depth_map", "given with the prior 'map'", "nothing", cure)
    if isinstance(given, (np.ndarray, Tensor)):
        given = given[..., 0] if given.ndim == 3 and given.shape[-1] == 1 else given  # (H, W, 1)
        given = [given] if given.ndim == 2 else list(given)
    if not isinstance(given, (list, tuple)) or not all(isinstance(m, (np.ndarray, Tensor)) for m in given):
        bad_type("depth_map", "an array (h, w) or (N, h, w), or a list of arrays (h, w)", given)
    return [_from_zero(each) for each in given]


def _from_zero(given: np.ndarray | Tensor) -> Tensor:
    """One map less its least value, ``(1, 1, h, w)`` float32, NaN where unknown."""
    values = torch.as_tensor(np.ascontiguousarray(given) if isinstance(given, np.ndarray) else given)
    if values.ndim != 2 or min(values.shape) < 2 or values.is_complex():
        bad_value("depth_map", "a map (h, w) of 2 x 2 pixels or more", f"shape {tuple(values.shape)}")
    # Not float64 for all: Apple's GPUs lack it, and of two float32 the difference is as exact in float32.
    values = values if values.dtype in (torch.float32, torch.float64) else values.float()
    inside = values.isfinite()
    if not inside.any() or values[inside].min() == values[inside].max():
        cure = "Not finite means unknown; a map must tell near from far somewhere."
        bad_value("depth_map", "a map with two different finite values", "none", cure)
    low = values[inside].min()  # before float32, which would round a small range far from 0
    return torch.where(inside, values - low, values.new_tensor(torch.nan)).float()[None, None]


def _filled(values: Tensor) -> tuple[Tensor, Tensor]:
    """A map with its least value at 0 and its 98 % quantile at 1, holes filled, and where it is known."""
    known = values.isfinite()
    low, high = range_of(values[known][None, None, None])
    if high <= low:  # nearly all of it is flat
        high = values[known].max()[None]
    values = torch.where(known, (values - low) / (high - low), torch.zeros_like(values))
    if bool(known.all()):
        return values, known
    weight, links = FIRM * known.float(), torch.ones_like(values)
    system = FieldSystem(weight, weight * values, links[..., 1:], links[..., 1:, :])
    return torch.where(known, values, solve_field(system, FILL_STEPS)), known


def _resized(values: Tensor, left_01: Tensor) -> Tensor:
    """A map ``(1, 1, h, w)`` at the size of its image, its edges steep again after enlargement."""
    size = image_size(left_01)
    if image_size(values) == size:
        return values
    resized = F.interpolate(values, size, mode="bilinear", antialias=True)
    ratio = max(new / old for new, old in zip(size, image_size(values), strict=True))
    if ratio < ENLARGED:
        return resized
    return 1.0 / sharpen_edges(1.0 / (resized + OFFSET), left_01, round(ratio)) - OFFSET
