"""Removal of JPEG blocks and sensor noise from photographs before they are compared.

The filter is hard thresholding of a shifted 8 x 8 DCT (Coifman and Donoho 1995, "Translation-invariant
de-noising"); the quantisation table is K.1 of ITU-T T.81.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._kernels import launch_bound
from geodiff_plugin.geometry import to_device_of
from geodiff_plugin.matching.census import grey

_BLOCK = 8
_LUMA_STEPS = (
    *(16, 11, 10, 16, 24, 40, 51, 61),
    *(12, 12, 14, 19, 26, 58, 60, 55),
    *(14, 13, 16, 24, 40, 57, 69, 56),
    *(14, 17, 22, 29, 51, 87, 80, 62),
    *(18, 22, 37, 56, 68, 109, 103, 77),
    *(24, 35, 55, 64, 81, 104, 113, 92),
    *(49, 64, 78, 87, 103, 121, 120, 101),
    *(72, 92, 95, 98, 112, 100, 103, 99),
)
# Coefficients that even strong compression keeps.
_KEPT = ((0, 1), (1, 0), (2, 0), (1, 1), (0, 2), (0, 3), (1, 2), (2, 1), (3, 0))
# How many of them must agree on the scale of the table.
_LEAST_VOTES = 5
# How nearly they must agree.
_ALIKE = 0.3
# Upper bound on the quantisation steps that are tried.
_MOST_STEP = 100
# Upper bound on the blocks that are read, which bounds the time.
_MOST_BLOCKS = 2048
# A step counts if at least so many values are multiples of it.
_LEAST_VALUES = 32
# How closely they must be multiples of it (mean cosine).
_LEAST_FIT = 0.5
# A step of more grey levels than this between two pixels is the scene's, not the edge of a block.
_MOST_BLOCK_EDGE = 8.0
# Noise is read from the finest coefficients of the flattest blocks, of which this is the share.
_FLATTEST = 0.1
# These contain less of it than the others: the factor is that of normally distributed noise.
_NOISE_OF_FLATTEST = 1.0 / 0.77
# Noise below the first number of grey levels does not disturb the matching and may be fine texture; noise
# above the second is removed in full.
_NOISE_RANGE = (1.7, 2.8)
# Coefficients below this number of steps are removed. On rendered pairs wrong matches are equally few from
# half to twice this number.
_STEPS = 1.2
# So are those below this number of noise deviations; the same holds of it.
_DEVIATIONS = 3.6
# 16 of the 64 positions of the blocks, every row and column twice.
_SHIFTS = tuple((i, (3 * i + k) % _BLOCK) for i in range(_BLOCK) for k in (0, _BLOCK // 2))
# A picture with more than so many times the pixels of the matching grid is cleaned enough by shrinking;
# 1280 x 960 still gains from cleaning.
_SHRUNK = 6.0


def _basis(like: Tensor) -> Tensor:
    """Orthonormal DCT-II, ``(frequency, pixel)``."""
    n = torch.arange(_BLOCK, device="cpu", dtype=like.dtype)
    waves = torch.cos(math.pi * (2 * n[None] + 1) * n[:, None] / (2 * _BLOCK)) * math.sqrt(2 / _BLOCK)
    waves[0] /= math.sqrt(2)
    return to_device_of(like, waves)


def _to_blocks(levels: Tensor, basis: Tensor) -> Tensor:
    """Coefficients ``(h, w, 8, 8)`` of the whole blocks of ``(H, W)``."""
    rows, columns = (side // _BLOCK for side in levels.shape)
    whole = levels[: rows * _BLOCK, : columns * _BLOCK]
    return _transformed(whole.reshape(rows, _BLOCK, columns, _BLOCK), basis).transpose(1, 2)


def _transformed(blocks: Tensor, basis: Tensor) -> Tensor:
    """``basis @ block @ basis.T`` of every block of ``(h, 8, w, 8)``, as few large products."""
    return (basis @ (blocks.reshape(-1, _BLOCK) @ basis.T).view(len(blocks), _BLOCK, -1)).view(blocks.shape)


def _table(like: Tensor) -> Tensor:
    return to_device_of(like, torch.tensor(_LUMA_STEPS, dtype=like.dtype, device="cpu")).view(_BLOCK, _BLOCK)


def _first_edge(levels: Tensor, axis: int) -> Tensor:
    """Where the blocks begin, ``()`` 0 to 7: a crop begins within one."""
    steps = levels.diff(dim=axis).abs().clamp_max(_MOST_BLOCK_EDGE).mean(1 - axis)
    whole = steps[: steps.shape[0] // _BLOCK * _BLOCK].view(-1, _BLOCK).mean(0)
    return (whole.argmax() + 1) % _BLOCK


def _jpeg_scale(levels: Tensor, basis: Tensor) -> float:
    """The largest steps of which the coefficients of a picture are multiples; its blocks begin at (0, 0)."""
    blocks = _to_blocks(levels, basis).reshape(-1, _BLOCK, _BLOCK)
    blocks = blocks[:: math.ceil(len(blocks) / _MOST_BLOCKS)]
    places = torch.tensor([_BLOCK * row + column for row, column in _KEPT], device="cpu")
    value = blocks.flatten(1)[:, to_device_of(blocks, places)].abs()[..., None]
    step = torch.arange(2, _MOST_STEP, device=levels.device, dtype=levels.dtype)
    counts = value > 0.6 * step  # 0 is a multiple of everything
    number = counts.sum(0)
    fit = (torch.cos(2 * math.pi * value / step) * counts).sum(0) / number.clamp_min(1)
    largest = (step * ((fit > _LEAST_FIT) & (number >= _LEAST_VALUES))).amax(-1).cpu()
    scales = [scale for scale in (largest / _table(largest).flatten()[places]).tolist() if scale > 0]
    if len(scales) < _LEAST_VOTES:
        return 0.0
    middle = sorted(scales)[(len(scales) - 1) // 2]
    agree = sum(abs(scale / middle - 1.0) < _ALIKE for scale in scales)
    return middle if agree >= _LEAST_VOTES else 0.0


def _noise_energy(levels: Tensor, basis: Tensor) -> Tensor:
    """``()`` energy of the finest coefficients of the flattest blocks."""
    fine = _to_blocks(levels, basis)[..., _BLOCK // 2 :, _BLOCK // 2 :]
    return torch.quantile(fine.square().mean((-1, -2)).flatten(), _FLATTEST)


def find_flaws(image_01: Tensor) -> tuple[float, float]:
    """How coarsely a photograph was compressed, and how noisy it is (standard deviation, levels of 255).

    The former is the steps of the JPEG quantisation as a multiple of table K.1: 1 at a quality of 50, .4 at
    80; 0 where no trace of compression remains, as after resampling. A device is waited for twice.
    """
    levels = grey(image_01)[0] * 255.0
    return _flaws(levels, _basis(levels))


def _flaws(levels: Tensor, basis: Tensor) -> tuple[float, float]:
    """``find_flaws`` of grey levels ``(H, W)``."""
    edges = [_first_edge(levels, axis).to(levels) for axis in (0, 1)]
    top, left, energy = torch.stack([*edges, _noise_energy(levels, basis)]).tolist()
    scale = _jpeg_scale(levels[int(top) :, int(left) :], basis)
    return scale, math.sqrt(energy) * _NOISE_OF_FLATTEST


def _threshold(jpeg_scale: float, noise: float, like: Tensor) -> Tensor | None:
    """Size ``(8, 8)`` below which coefficients are removed; ``None`` where nothing is to be removed."""
    low, high = _NOISE_RANGE
    noise *= min(max((noise - low) / (high - low), 0.0), 1.0)
    if not jpeg_scale and not noise:
        return None
    threshold = torch.hypot(_STEPS * jpeg_scale * _table(like), like.new_full((), _DEVIATIONS * noise))
    threshold[0, 0] = 0.0  # the mean of a block is always kept
    return threshold


@torch.no_grad()
def clean(image_01: Tensor, grid_pixels: int) -> Tensor:
    """A photograph without the blocks of its compression and without sensor noise.

    Blocks stand at the same columns of both images, so that faint texture matches at shifts of 8 pixels;
    noise hides it. What is not flawed, or has more than six times ``grid_pixels``, those of the grid that it
    is compared on, is returned as it is.
    """
    if image_01.shape[-2] * image_01.shape[-1] > _SHRUNK * grid_pixels:
        return image_01
    levels = grey(image_01)[0] * 255.0
    basis = _basis(levels)
    threshold = _threshold(*_flaws(levels, basis), levels)
    if threshold is None:
        return image_01
    tall, broad = (side + (-side) % _BLOCK + _BLOCK for side in levels.shape)  # whole blocks, and one more
    sides = _BLOCK, broad - levels.shape[1], _BLOCK, tall - levels.shape[0]
    wide = F.pad(levels[None, None], sides, mode="reflect")[0, 0]
    if launch_bound(levels):  # all at once
        down, across = to_device_of(levels, torch.tensor(_SHIFTS, device="cpu").T)
        total = _thresholded(wide, levels.shape, down, across, basis, threshold).sum(0)
    else:
        total = torch.zeros_like(levels)
        for row, column in _SHIFTS:
            total += _thresholded(wide, levels.shape, row, column, basis, threshold)
    return (image_01 + (total / len(_SHIFTS) - levels) / 255.0).clamp(0.0, 1.0)


def _thresholded(
    wide: Tensor, size: tuple[int, ...], down: Any, across: Any, basis: Tensor, threshold: Tensor
) -> Tensor:
    """A picture of ``size (H, W)`` without its small coefficients, in blocks that begin at (down, across).

    ``wide`` is the picture with a block more on every side, and whole blocks. Indices ``(n,)`` give ``(n, H,
    W)``.
    """
    tall, broad = (side - _BLOCK for side in wide.shape)
    windows = wide.as_strided((_BLOCK, _BLOCK, tall, broad), (*wide.stride(), *wide.stride()))
    blocks = windows[down, across].reshape(-1, _BLOCK, broad // _BLOCK, _BLOCK)
    coefficients = _transformed(blocks, basis)
    kept = coefficients * (coefficients.abs() >= threshold[:, None])
    kept = _transformed(kept, basis.T).view(-1, tall, broad)
    strides = tall * broad, broad, 1, broad, 1
    back = kept.as_strided((len(kept), _BLOCK + 1, _BLOCK + 1, *size), strides)
    which = 0 if isinstance(down, int) else torch.arange(len(kept), device=wide.device)
    return back[which, _BLOCK - down, _BLOCK - across]
