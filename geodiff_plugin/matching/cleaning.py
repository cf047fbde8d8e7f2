"""Removes JPEG blocks and sensor noise from images before they are matched.

The filter is hard thresholding of a shifted 8 x 8 DCT (Coifman and Donoho 1995, "Translation-invariant
de-noising"). The quantisation table is K.1 of ITU-T T.81.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._internal.kernels import launch_bound
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
# Coefficients that are kept even by strong compression.
_KEPT = ((0, 1), (1, 0), (2, 0), (1, 1), (0, 2), (0, 3), (1, 2), (2, 1), (3, 0))
# Minimum number of these coefficients that agree on the scale of the table.
_MIN_AGREEING = 5
# Relative tolerance of this agreement.
_TOLERANCE = 0.3
# Maximum quantisation step that is tried.
_MAX_STEP = 100
# Maximum number of blocks that are read, which bounds the time.
_MAX_BLOCKS = 2048
# Minimum number of values that are multiples of a step.
_MIN_VALUES = 32
# Minimum mean cosine of the values as multiples of a step.
_MIN_COSINE = 0.5
# Largest step between two pixels, grey levels, that can be a block edge rather than scene content.
_MAX_BLOCK_EDGE = 8.0
# Fraction of blocks, the flattest ones, whose finest coefficients measure the noise.
_FLATTEST = 0.1
# The finest coefficients of a block.
_FINE = tuple((i, j) for i in range(_BLOCK // 2, _BLOCK) for j in range(_BLOCK // 2, _BLOCK))
# Correction factor for selecting the flattest blocks, for normally distributed noise.
_NOISE_OF_FLATTEST = 1.0 / 0.77
# Noise below the first number of grey levels does not affect matching and may be fine texture; noise above
# the second is removed completely.
_NOISE_RANGE = (1.7, 2.8)
# Threshold of the coefficients, in quantisation steps. On rendered pairs the number of wrong matches is
# equally low from half to twice this value.
_STEPS = 1.2
# Threshold of the coefficients, in noise standard deviations; equally insensitive between half and twice this
# value.
_DEVIATIONS = 3.6
# 16 of the 64 block offsets, with every row and column twice.
_SHIFTS = tuple((i, (3 * i + k) % _BLOCK) for i in range(_BLOCK) for k in (0, _BLOCK // 2))
# An image with more than this many times the pixels of the matching grid is cleaned enough by downscaling;
# 1280 x 960 still benefits from cleaning.
_MAX_PIXEL_RATIO = 6.0


@cache
def _basis() -> np.ndarray:
    """Return the orthonormal DCT-II basis, ``(frequency, pixel)``."""
    n = np.arange(_BLOCK)
    waves = np.cos(math.pi * (2 * n[None] + 1) * n[:, None] / (2 * _BLOCK)) * math.sqrt(2 / _BLOCK)
    waves[0] /= math.sqrt(2)
    return waves


@cache
def _coefficients(places: tuple[tuple[int, int], ...]) -> np.ndarray:
    """Return the weights ``(64, n)`` of a block's pixels for the coefficients at (row, column)."""
    waves = [np.outer(_basis()[row], _basis()[column]).ravel() for row, column in places]
    return np.stack(waves, axis=1).astype(np.float32)


def _transformed(blocks: Tensor, basis: Tensor) -> Tensor:
    """Compute ``basis @ block @ basis.T`` of every block of ``(h, 8, w, 8)``, as a few large products."""
    return (basis @ (blocks.reshape(-1, _BLOCK) @ basis.T).view(len(blocks), _BLOCK, -1)).view(blocks.shape)


def _steps_at_edges(levels: Tensor, axis: int, valid: Tensor | None) -> Tensor:
    """Average the step to the pixel below (axis 0) or to the right (1), by position modulo 8, ``(N, 8)``.

    Only steps between two pixels that are ``valid (1, H, W)`` bool count; ``None`` for all.
    """
    steps = levels.diff(dim=axis + 1).abs().clamp_max(_MAX_BLOCK_EDGE)
    if valid is None:
        return _by_position(steps.mean(2 - axis)).mean(1)
    length = valid.shape[axis + 1] - 1
    known = valid.narrow(axis + 1, 0, length) & valid.narrow(axis + 1, 1, length)
    total, count = (_by_position(each.sum(2 - axis)).sum(1) for each in (steps * known, known))
    return total / count.clamp_min(1)


def _by_position(lines: Tensor) -> Tensor:
    """Reshape values of rows or columns ``(N, n)`` to ``(N, n // 8, 8)``."""
    return lines[:, : lines.shape[1] // _BLOCK * _BLOCK].view(len(lines), -1, _BLOCK)


def _whole_blocks(images: Tensor) -> Tensor:
    """Return the pixels ``(N, n, 64)`` of all blocks of images ``(N, H, W)``."""
    rows, columns = (side // _BLOCK for side in images.shape[1:])
    whole = images[:, : rows * _BLOCK, : columns * _BLOCK].reshape(-1, rows, _BLOCK, columns, _BLOCK)
    return whole.transpose(2, 3).reshape(len(images), rows * columns, -1)


def _noise_energy(levels: Tensor, valid: Tensor | None) -> Tensor:
    """Compute the energy ``(N, 1)`` of the finest coefficients of the flattest blocks of valid pixels."""
    blocks = _whole_blocks(levels)
    if valid is not None:
        blocks = blocks[:, _whole_blocks(valid)[0].all(-1)]
    if not blocks.shape[1]:
        return levels.new_zeros(len(levels), 1)
    fine = blocks @ to_device_of(levels, _coefficients(_FINE))
    energy = fine.square().mean(-1).sort(dim=1).values
    at = _FLATTEST * (energy.shape[1] - 1)
    before, after = (energy[:, n, None] for n in (math.floor(at), math.ceil(at)))
    return torch.lerp(before, after, at - math.floor(at))


class Flaws(NamedTuple):
    """Compression and noise of an image."""

    jpeg_scale: float  # quantisation steps as a multiple of table K.1: 1 at quality 50, .4 at 80
    noise: float  # standard deviation, levels of 255


def find_flaws(levels: Tensor, valid: Tensor | None = None) -> list[Flaws]:
    """Measure compression and noise of images ``(N, H, W)``, grey levels up to 255.

    The scale is 0 if no trace of compression remains, as after resampling. Only blocks of ``valid (1, H, W)``
    bool pixels of a single image count, because other pixels are smooth; ``None`` for all. Synchronizes with
    the device twice.
    """
    steps = [_steps_at_edges(levels, axis, valid) for axis in (0, 1)]
    found = torch.cat([*steps, _noise_energy(levels, valid)], dim=1)
    numbers = found.cpu().numpy()
    # Offset of the block grid, 0 to 7, which depends on how the image was cropped.
    begins = [(numbers[:, at : at + _BLOCK].argmax(1) + 1) % _BLOCK for at in (0, _BLOCK)]
    scales = _jpeg_scales(levels, np.stack(begins, axis=1), valid)
    noises = np.sqrt(numbers[:, -1]) * _NOISE_OF_FLATTEST
    return [Flaws(scale, float(noise)) for scale, noise in zip(scales, noises, strict=True)]


def _jpeg_scales(levels: Tensor, begins: np.ndarray, valid: Tensor | None = None) -> list[float]:
    """Return ``Flaws.jpeg_scale`` of every image, with blocks offset by ``begins (N, 2)``, row and column.

    For each of some coefficients the largest step is chosen of which its values are multiples.
    """
    blocks = _some_blocks(levels, begins, valid)
    value = (blocks @ to_device_of(levels, _coefficients(_KEPT))).abs()[..., None]  # (N, n, kept, 1)
    step = np.arange(2, _MAX_STEP, dtype=np.float32)
    least, waves = to_device_of(levels, np.stack([0.6 * step, 2 * math.pi / step]).astype(np.float32))
    counts = value > least  # 0 is a multiple of every step
    sums = torch.stack([counts.sum(1), (value * waves).cos_().mul_(counts).sum(1)])  # (2, N, kept, steps)
    number, fit = sums.cpu().numpy()
    multiple = (fit > _MIN_COSINE * number.clip(1)) & (number >= _MIN_VALUES)
    largest = (step * multiple).max(-1)
    return [_scale(of_image) for of_image in largest / [_LUMA_STEPS[_BLOCK * i + j] for i, j in _KEPT]]


def _some_blocks(levels: Tensor, begins: np.ndarray, valid: Tensor | None = None) -> Tensor:
    """Return the pixels ``(N, n, 64)`` of at most ``_MAX_BLOCKS`` blocks; 0 if an image has fewer."""
    rows, columns = ((np.array(levels.shape[1:]) - begins) // _BLOCK).T[..., None]
    number = rows * columns
    if valid is not None:
        (row, column), *_ = begins.tolist()
        whole = np.flatnonzero(_whole_blocks(valid[:, row:, column:])[0].all(-1).cpu().numpy())
        number = np.array([[len(whole)]])
    every = np.maximum(1, -(-number // _MAX_BLOCKS))
    block = np.arange((-(-number // every)).max()) * every
    exists = block < number
    if valid is not None:
        block = whole[block]
    row, column = (begins[:, axis, None] + _BLOCK * at for axis, at in enumerate(np.divmod(block, columns)))
    table = np.stack([np.where(exists, row, 0), np.where(exists, column, 0), exists])
    row_at, column_at, there = to_device_of(levels, table)
    image = to_device_of(levels, np.arange(len(levels)))[:, None]
    windows = levels.unfold(1, _BLOCK, 1).unfold(2, _BLOCK, 1)
    return windows[image, row_at, column_at].flatten(2) * there[..., None]


def _scale(scales: np.ndarray) -> float:
    """Return the scale of the table that the coefficients agree on; 0 if too few agree."""
    found = np.sort(scales[scales > 0])
    if len(found) < _MIN_AGREEING:
        return 0.0
    middle = float(found[(len(found) - 1) // 2])
    return middle if (np.abs(found / middle - 1.0) < _TOLERANCE).sum() >= _MIN_AGREEING else 0.0


def _threshold(flaws: Flaws) -> np.ndarray | None:
    """Return the threshold ``(8, 8)`` of coefficients; ``None`` if nothing is to be removed."""
    low, high = _NOISE_RANGE
    noise = flaws.noise * min(max((flaws.noise - low) / (high - low), 0.0), 1.0)
    if not flaws.jpeg_scale and not noise:
        return None
    table = np.array(_LUMA_STEPS).reshape(_BLOCK, _BLOCK)
    threshold = np.hypot(_STEPS * flaws.jpeg_scale * table, _DEVIATIONS * noise)
    threshold[0, 0] = 0.0  # always keep the mean of a block
    return threshold.astype(np.float32)


@torch.no_grad()
def clean(
    images: Sequence[Tensor], grid_pixels: int, masks: Sequence[Tensor | None] | None = None
) -> list[Tensor]:
    """Remove compression blocks and sensor noise from images ``(3, H, W)``, or grey ones.

    Block edges are at the same columns of both images, so that weak texture would match at shifts of 8
    pixels; noise hides it. Images without flaws, or with more than six times ``grid_pixels``, the pixels of
    the matching grid, are returned unchanged. Images of one size are analysed together, those with ``masks``
    of valid pixels ``(H, W)`` bool alone.
    """
    cleaned = list(images)
    most = _MAX_PIXEL_RATIO * grid_pixels
    together = defaultdict[tuple[torch.Size, int | None], list[int]](list)
    for number, image in enumerate(images):
        if image.shape[-2] * image.shape[-1] <= most:
            alone = number if masks is not None and masks[number] is not None else None
            together[image.shape, alone].append(number)
    for (_, alone), numbers in together.items():
        mask = None if masks is None or alone is None else masks[alone]
        levels = grey(torch.stack([images[number] for number in numbers]))[:, 0] * 255.0
        all_flaws = find_flaws(levels, None if mask is None else mask[None].to(levels.device))
        for number, of_image, flaws in zip(numbers, levels, all_flaws, strict=True):
            threshold = _threshold(flaws)
            if threshold is not None:
                change = (_without(of_image, threshold) - of_image) / 255.0
                cleaned[number] = (images[number] + change).clamp(0.0, 1.0)
    return cleaned


def _without(levels: Tensor, threshold: np.ndarray) -> Tensor:
    """Remove coefficients below ``threshold (8, 8)`` from grey levels ``(H, W)``, averaged over offsets."""
    basis, least = (to_device_of(levels, each.astype(np.float32)) for each in (_basis(), threshold))
    padded_height, padded_width = (
        side + (-side) % _BLOCK + _BLOCK for side in levels.shape
    )  # whole blocks, plus one
    sides = _BLOCK, padded_width - levels.shape[1], _BLOCK, padded_height - levels.shape[0]
    wide = F.pad(levels[None, None], sides, mode="reflect")[0, 0]
    if launch_bound(levels):  # all offsets at once
        down, across = to_device_of(levels, np.array(_SHIFTS).T)
        return _thresholded(wide, levels.shape, down, across, basis, least).sum(0) / len(_SHIFTS)
    total = torch.zeros_like(levels)
    for row, column in _SHIFTS:
        total += _thresholded(wide, levels.shape, row, column, basis, least)
    return total / len(_SHIFTS)


def _thresholded(
    wide: Tensor, size: tuple[int, ...], down: Any, across: Any, basis: Tensor, threshold: Tensor
) -> Tensor:
    """Remove small coefficients from an image of ``size (H, W)``, in blocks that begin at (down, across).

    ``wide`` is the image padded by one block on every side to whole blocks. Offsets ``(n,)`` give ``(n, H,
    W)``.
    """
    padded_height, padded_width = (side - _BLOCK for side in wide.shape)
    windows = wide.as_strided((_BLOCK, _BLOCK, padded_height, padded_width), (*wide.stride(), *wide.stride()))
    blocks = windows[down, across].reshape(-1, _BLOCK, padded_width // _BLOCK, _BLOCK)
    coefficients = _transformed(blocks, basis)
    kept = coefficients * (coefficients.abs() >= threshold[:, None])
    kept = _transformed(kept, basis.T).view(-1, padded_height, padded_width)
    strides = padded_height * padded_width, padded_width, 1, padded_width, 1
    back = kept.as_strided((len(kept), _BLOCK + 1, _BLOCK + 1, *size), strides)
    index = 0 if isinstance(down, int) else torch.arange(len(kept), device=wide.device)
    return back[index, _BLOCK - down, _BLOCK - across]
