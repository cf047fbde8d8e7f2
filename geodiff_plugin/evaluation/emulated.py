"""Emulated prior of chosen strength: a network that answers with the truth plus a controlled error.

The pipeline, its scheduler and its autoencoder are real. The network's clean estimate is
``(1 - follow) z0* + follow z0(z_t)``: ``z0*`` is the code of the erroneous truth, and ``z0(z_t)`` what its
input says, so that an edit of one step is seen by the next one, as a trained network would see it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from diffusers import ConfigMixin, ModelMixin
from diffusers.configuration_utils import register_to_config
from scipy import ndimage
from torch import Tensor

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.algorithm.denoising import output_from
from geodiff_plugin.bundled import load_bundled_prior
from geodiff_plugin.evaluation.baselines.base import PriorCache, Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evaluation.metrics import to_space
from geodiff_plugin.priors import find_adapter
from geodiff_plugin.runtime.noise_levels import noise_level
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance

__all__ = ["DENSE", "SPACES", "STRENGTHS", "EmulatedPrior", "EmulatedPriors", "Strength", "relative_map"]

SPACES = ("disparity", "depth", "log")
#: Share of pixels with truth from which a sample is dense: a prior is made of its truth.
DENSE = 0.5
#: What a prior calls 0 and 1: the quantiles of Marigold's training; the rest of the map lies beyond them.
ENDS = (0.02, 0.98)
#: Standard deviation of the smooth half of the error, and spacing of the segments of the other half, as
#: shares of the longer side; that of the blur.
SMOOTH, SEGMENTS, BLUR = 0.12, 0.16, 0.012


class Strength(NamedTuple):
    """How a prior errs.

    Attributes:
        error: mean absolute error of log depth, half of it smooth and half constant over segments.
        blur: whether the map is blurred.
        gamma: exponent of the relative map, 1 for none: an error that no scale and shift takes out.
    """

    error: float = 0.0
    blur: bool = False
    gamma: float = 1.0


STRENGTHS = {
    "exact": Strength(),
    "2%": Strength(0.02),
    "5%": Strength(0.05),
    "10%": Strength(0.10),
    "20%": Strength(0.20),
    "blur": Strength(0.01, blur=True),
    "gamma": Strength(gamma=1.6),
}


def relative_map(sample: StereoSample, strength: Strength, space: str, seed: int = 0) -> np.ndarray:
    """The map of a prior that errs in a given way, at the truth's resolution.

    Args:
        sample: with truth everywhere, or at least densely; holes take the nearest known depth.
        strength: how it errs.
        space: what the map is affine in, one of ``SPACES``.
        seed: of the error; the same one gives the same error whatever the space.

    Returns:
        ``(H, W)`` float64, 0 and 1 at the 2 % and 98 % quantiles, clipped there as trained maps are.
    """
    log_depth = np.log(_filled(sample.depth_m, sample.valid))
    rng = np.random.default_rng([seed, 47])
    log_depth = log_depth + strength.error * _error(log_depth, rng)
    values = to_space(np.exp(log_depth), space)
    if strength.blur:
        values = ndimage.gaussian_filter(values, BLUR * max(values.shape), mode="nearest")
    low, high = np.quantile(values, ENDS)
    return np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0) ** strength.gamma


def _filled(depth_m: np.ndarray, valid: np.ndarray) -> np.ndarray:
    if not valid.any():
        bad_value("sample", "one with truth", "no valid pixel")
    nearest = ndimage.distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return depth_m[tuple(nearest)].astype(np.float64)


def _error(log_depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A field of mean absolute value 1 and median 0: half smooth, half constant over segments.

    A segment is the part of a cell of the picture that lies at one of its depths: things err as wholes.
    """
    height, width = log_depth.shape
    side = max(height, width)
    smooth = ndimage.gaussian_filter(rng.normal(size=(height, width)), SMOOTH * side, mode="reflect")
    span = max(float(np.ptp(np.quantile(log_depth, ENDS))), 1e-3)
    seeds = max(4, round(height * width / (SEGMENTS * side) ** 2))
    centres = np.stack([rng.uniform(0, height, seeds), rng.uniform(0, width, seeds)], 1)
    depths = log_depth[tuple(centres.astype(int).T)]
    rows, columns = np.mgrid[:height, :width]
    best, label = np.full((height, width), np.inf), np.zeros((height, width), int)
    for k, ((row, column), depth) in enumerate(zip(centres, depths, strict=True)):
        away = ((rows - row) ** 2 + (columns - column) ** 2) / (SEGMENTS * side) ** 2
        away = away + (4.0 * (log_depth - depth) / span) ** 2
        closer = away < best
        best[closer], label[closer] = away[closer], k
    segments = rng.normal(size=seeds)[label]
    field = sum(part / max(float(part.std()), 1e-9) for part in (smooth, segments))
    field = field - np.median(field)
    return field / max(float(np.abs(field).mean()), 1e-9)


class _Denoiser(ModelMixin, ConfigMixin):
    """Stands where the U-Net stands; ``code`` is what it answers with."""

    @register_to_config
    def __init__(self, follow: float = 0.3) -> None:
        super().__init__()
        self.unit = torch.nn.Parameter(torch.ones(()))
        self.scheduler: Any = None
        self.code: Tensor | None = None
        self._noise: Tensor | None = None
        self._last: Tensor | None = None

    def forward(self, sample: Tensor, timestep: Tensor, *args: Any, **kwargs: Any) -> tuple[Tensor]:
        assert self.code is not None  # set by ``EmulatedPrior.answer``
        z_t = sample[:, -self.code.shape[1] :].float()
        level = noise_level(self.scheduler, timestep)
        own = self.code.expand_as(z_t)
        starts = self._last is None or timestep >= self._last  # a schedule falls, so this one is new
        self._last = timestep
        z0 = own
        if not starts and self._noise is not None:
            implied = (z_t - level.sigma * self._noise) / level.alpha
            z0 = (1.0 - self.config.follow) * own + self.config.follow * implied
        self._noise = (z_t - level.alpha * z0) / level.sigma  # what its input holds beside that
        return (output_from(z0, self._noise, level)[0].to(sample.dtype),)


class EmulatedPrior:
    """The bundled pipeline with an emulated network, for one sample after another.

    Args:
        space: what its maps are affine in, one of ``SPACES``.
        follow: how far its later answers follow their input, [0, 1].

    Attributes:
        pipe: the stock pipeline; guidance is enabled as on any other.
    """

    def __init__(self, space: str = "disparity", follow: float = 0.3) -> None:
        check_choice(space, "space", SPACES)
        self.space, self.pipe = space, load_bundled_prior()
        self.pipe.register_to_config(prediction_type=space)
        self.pipe.unet = _Denoiser(follow)
        self.pipe.unet.scheduler = self.pipe.scheduler
        self.pipe.set_progress_bar_config(disable=True)

    @torch.no_grad()
    def answer(self, sample: StereoSample, strength: Strength, resolution: int, seed: int = 0) -> Tensor:
        """Let the network answer for a sample.

        Args:
            sample: whose left image will be asked for.
            strength: how the prior errs.
            resolution: ``processing_resolution`` of the calls to come.
            seed: of the error.

        Returns:
            ``(1, 1, H, W)`` the relative map at the image's resolution, before the autoencoder.
        """
        relative = torch.from_numpy(relative_map(sample, strength, self.space, seed))[None, None].float()
        image = torch.from_numpy(sample.left).permute(2, 0, 1)[None].float() / 255.0
        padded, padding, _ = self.pipe.image_processor.preprocess(image, resolution, "bilinear", "cpu")
        size = tuple(side - pad for side, pad in zip(padded.shape[-2:], padding, strict=True))
        small = F.interpolate(relative, size, mode="bilinear", antialias=True)
        small = F.pad(small, (0, padding[1], 0, padding[0]), mode="replicate")
        self.pipe.unet.code = find_adapter(self.pipe)(self.pipe).encode(small).float()
        return relative


class EmulatedPriors(PriorCache):
    """Hands an emulated prior, guided, to every method that asks for one."""

    def __init__(self, prior: EmulatedPrior) -> None:
        super().__init__()
        self._pipe = enable_geometry_guidance(prior.pipe)

    def get(self, settings: Settings) -> Any:
        """The emulated pipeline, whatever prior the settings name."""
        return self._pipe
