"""Triton kernel for the pyramid solver; its references are ``solver.solve_field`` and ``solve_robust``.

A single launch runs everything: all passes with their reweighting rounds, the coarser grids, and the
conjugate-gradient steps on each grid. Between these stages all programs synchronize, so all of them must be
resident at the same time. The kernel is therefore launched as a cooperative grid, which CUDA rejects if it
does not fit, and never with more programs than the register bound allows. Data written by another program
during the launch is read with ``.cg``, bypassing the L1 cache, which is not coherent between multiprocessors.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._internal.kernels import launched_on
from geodiff_plugin.algorithm.constants import COARSEST_SIDE, COARSEST_STEPS
from geodiff_plugin.algorithm.systems import FieldSystem, RobustField, RobustSystem
from geodiff_plugin.geometry import image_size

#: Pixels per tile.
TILE = 1024
#: Maximum number of pixels of a grid that one program solves by itself, without synchronization.
ALONE = 1024
#: Warps per program.
WARPS = 8
#: Maximum number of registers per thread, and programs that fit a multiprocessor with 65,536 registers.
MAX_REGISTERS = 224
RESIDENT = 65_536 // (MAX_REGISTERS * 32 * WARPS)
#: The initial iterate is zero.
FROM_ZEROS = tl.constexpr(0)
#: The initial iterate is the field of the previous round on the same grid.
FROM_FIELD = tl.constexpr(1)
#: The initial iterate is the field of the next coarser grid.
FROM_COARSER = tl.constexpr(2)
#: Values of the standard deviation of the fitted map: none, one per sample, or one per pixel.
NO_ERROR = tl.constexpr(0)
PER_SAMPLE = tl.constexpr(1)
PER_PIXEL = tl.constexpr(2)
#: Number of work arrays of a field's size, and the places of those after the residual. The directions of even
#: and odd steps are next to each other.
WORK_ARRAYS = tl.constexpr(6)
PRECONDITIONED = tl.constexpr(1)
PRODUCT = tl.constexpr(2)
INVERSE_DIAGONAL = tl.constexpr(3)
DIRECTIONS = tl.constexpr(4)
#: Number of partial sums per tile.
SUMS = tl.constexpr(3)
#: Number of partial sums added per iteration.
GATHERED = tl.constexpr(256)
#: ``tiny`` of the reference: keeps a converged channel unchanged.
TINY = tl.constexpr(1e-20)

_TENSORS = ["data", "weight", "across", "down", "start", "noise", "error", "smoothness", "tikhonov"]
_WRITTEN = ["field", "support", "weights", "scratch", "arrivals"]
_SIZES = ["height", "width", "batch", "parts", "levels"]
_COUNTS = ["max_channels", "passes", "rounds", "first_steps", "steps", "given", "local", "error_kind"]


@triton.jit
def _synchronize(arrivals, expected, alone):
    """Wait until all programs have arrived ``expected / programs`` times and their writes are visible.

    A program that is ``alone`` only synchronizes its own threads.
    """
    tl.debug_barrier()
    if alone == 0:
        tl.atomic_add(arrivals, 1, sem="release", scope="gpu")
        while tl.atomic_add(arrivals, 0, sem="acquire", scope="gpu") < expected:
            pass
        tl.debug_barrier()


@triton.jit
def _size(height, width, level):
    """Return height and width of a pyramid level; level 0 is the finest."""
    return (height + (1 << level) - 1) >> level, (width + (1 << level) - 1) >> level


@triton.jit
def _pixels_before(height, width, level):
    """Count the pixels of all finer levels."""
    pixels = 0
    for finer in range(level):
        rows, columns = _size(height, width, finer)
        pixels += rows * columns
    return pixels


@triton.jit
def _store_affinities(
    across, down, smoothness, system, shared, sample, p, height, width, batch, local, ROBUST: tl.constexpr
):
    """Store the finest grid's affinities of every pixel to the right and down; 0 without a neighbour."""
    n, inside, y = height * width, p < height * width, p // width
    right, lower = inside & (p - y * width < width - 1), p < n - width
    to_right = tl.load(across + shared * (n - height) + p - y, right, 0.0)
    to_lower = tl.load(down + shared * (n - width) + p, lower, 0.0)
    if ROBUST:  # between two smoothness values the lower one applies
        here = tl.load(smoothness + p * local, inside, 0.0)
        to_right *= tl.minimum(here, tl.load(smoothness + (p + 1) * local, right, 0.0))
        to_lower *= tl.minimum(here, tl.load(smoothness + (p + width) * local, lower, 0.0))
    at = system + (batch + sample) * n + p
    tl.store(at, to_right, inside)
    tl.store(at + batch * n, to_lower, inside)


@triton.jit
def _residual(data, field, x, shared, sample, held, p, n):
    """Load the field of the last round and of earlier passes, and compute the residual of their sum."""
    inside = p < n
    u = tl.load(x + sample * held * n + p, inside, 0.0, cache_modifier=".cg")
    previous = tl.load(field + sample * n + p, inside, 0.0, cache_modifier=".cg")
    return u, previous, u - (tl.load(data + shared * n + p, inside, 0.0) - previous)


@triton.jit
def _cauchy_weight(weight, noise, error, radius, error_kind, residual, shared, sample, p, n):
    """Compute the weight of observations in the next round; ``error_kind`` is ``PER_PIXEL`` or another."""
    deviation = tl.load(noise + shared * n + p, p < n, 1.0)
    of_pixel = (error_kind == PER_PIXEL).to(tl.int32)
    of_fitted = tl.load(error + shared * (1 + (n - 1) * of_pixel) + p * of_pixel, p < n, 0.0)
    of_fitted = tl.where(error_kind != NO_ERROR, of_fitted, 0.0)
    ratio = residual / (radius * tl.sqrt(deviation * deviation + of_fitted * of_fitted))
    return tl.load(weight + sample * n + p, p < n, 0.0) / (1.0 + ratio * ratio)


@triton.jit
def _robust_tile(
    data, weight, noise, error, radius, error_kind, tikhonov, field, system, shared, sample, p, part, turn, n,
    batch, channels, max_channels, local,
):  # fmt: skip
    """Compute weight and right-hand side of a round; each pass fits the residual of the earlier ones."""
    inside, own = p < n, sample * n + p
    weights, previous = tl.load(weight + own, inside, 0.0), tl.zeros_like(p).to(tl.float32)
    if part + turn > 0:
        # Only the last pass has a second channel, and only after its first round.
        held = tl.where(turn > 0, channels, 1)
        x = system + (3 + max_channels) * batch * n
        u, previous, residual = _residual(data, field, x, shared, sample, held, p, n)
        weights = _cauchy_weight(weight, noise, error, radius, error_kind, residual, shared, sample, p, n)
        previous += tl.where(turn > 0, 0.0, u)
    if turn == 0:
        tl.store(field + own, previous, inside)
    tl.store(system + own, weights + tl.load(tikhonov + p * local, inside, 0.0), inside)
    rhs = system + (3 * batch + sample * channels) * n + p
    tl.store(rhs, weights * (tl.load(data + shared * n + p, inside, 0.0) - previous), inside)
    if channels > 1:
        tl.store(rhs + n, weights, inside)


@triton.jit
def _given_tile(data, weight, start, system, sample, p, n, batch, channels, given):
    """Copy the given weight and right-hand side, and the initial iterate if given."""
    inside = p < n
    tl.store(system + sample * n + p, tl.load(weight + sample * n + p, inside, 0.0), inside)
    for channel in range(channels):
        at = (sample * channels + channel) * n + p
        rhs = system + 3 * batch * n + at
        tl.store(rhs, tl.load(data + at, inside, 0.0), inside)
        if given > 0:
            tl.store(rhs + channels * batch * n, tl.load(start + at, inside, 0.0), inside)


@triton.jit
def _cell_sum(fine, y, x, height, width, inside, rows: tl.constexpr, columns: tl.constexpr):
    """Sum values over cells of ``rows`` x ``columns`` pixels with the given upper left pixel."""
    at = fine + y * width + x
    total = tl.load(at, inside & (y < height) & (x < width), 0.0, cache_modifier=".cg")
    if rows == 2:
        below = inside & (y + 1 < height) & (x < width)
        total += tl.load(at + width, below, 0.0, cache_modifier=".cg")
    if columns == 2:
        right_offset = inside & (y < height) & (x + 1 < width)
        total += tl.load(at + 1, right_offset, 0.0, cache_modifier=".cg")
    if rows * columns == 4:
        both = inside & (y + 1 < height) & (x + 1 < width)
        total += tl.load(at + width + 1, both, 0.0, cache_modifier=".cg")
    return total


@triton.jit
def _coarsen_tile(fine, coarse, sample, cell, height, width, batch, channels):
    """Compute ``FieldSystem.coarser`` for a tile of the coarse grid."""
    rows, columns = (height + 1) // 2, (width + 1) // 2
    n, coarse_n = height * width, rows * columns
    inside, y, x = cell < coarse_n, 2 * (cell // columns), 2 * (cell % columns)
    at, of_sample = coarse + sample * coarse_n + cell, fine + sample * n
    tl.store(at, _cell_sum(of_sample, y, x, height, width, inside, 2, 2), inside)
    # The affinity of a coarse column to the next is taken from fine column x + 1, in both rows of the cell.
    linked = _cell_sum(of_sample + batch * n, y, x + 1, height, width, inside, 2, 1)
    tl.store(at + batch * coarse_n, 0.5 * linked, inside)
    linked = _cell_sum(of_sample + 2 * batch * n, y + 1, x, height, width, inside, 1, 2)
    tl.store(at + 2 * batch * coarse_n, 0.5 * linked, inside)
    for channel in range(sample * channels, (sample + 1) * channels):
        rhs = _cell_sum(fine + (3 * batch + channel) * n, y, x, height, width, inside, 2, 2)
        tl.store(coarse + (3 * batch + channel) * coarse_n + cell, rhs, inside)


@triton.jit
def _total(partial, count):
    """Sum one number per tile, always in the same order."""
    k = tl.arange(0, GATHERED)
    total = tl.zeros([GATHERED], tl.float32)
    for first in range(0, count, GATHERED):
        total += tl.load(partial + first + k, first + k < count, 0.0, cache_modifier=".cg")
    return tl.sum(total, 0)


@triton.jit
def _upsampled(coarse, y, x, inside, height, width):
    """Upsample a coarse field by a factor of 2, bilinear as in ``F.interpolate``."""
    row = tl.maximum((y.to(tl.float32) + 0.5) * 0.5 - 0.5, 0.0)
    column = tl.maximum((x.to(tl.float32) + 0.5) * 0.5 - 0.5, 0.0)
    y0, x0 = row.to(tl.int32), column.to(tl.int32)
    down, right = row - y0.to(tl.float32), column - x0.to(tl.float32)
    right_offset = tl.minimum(x0 + 1, width - 1) - x0
    value = tl.zeros_like(row)
    for lower in range(2):
        at = coarse + tl.minimum(y0 + lower, height - 1) * width + x0
        of_row = (1.0 - right) * tl.load(at, inside, 0.0, cache_modifier=".cg")
        of_row += right * tl.load(at + right_offset, inside, 0.0, cache_modifier=".cg")
        value += tl.where(lower > 0, down, 1.0 - down) * of_row
    return value


@triton.jit
def _row_of_matrix(system, p, n, width, stride):
    """Load a matrix row per pixel: the diagonal, and the affinities to the left, right, up and down.

    The left neighbour of the first column is the last pixel of the row above, whose right affinity is 0.
    """
    inside = p < n
    across = system + stride + p
    down = across + stride
    to_left = tl.load(across - 1, inside & (p > 0), 0.0, cache_modifier=".cg")
    to_right = tl.load(across, inside, 0.0, cache_modifier=".cg")
    to_upper = tl.load(down - width, inside & (p >= width), 0.0, cache_modifier=".cg")
    to_lower = tl.load(down, inside, 0.0, cache_modifier=".cg")
    weight = tl.load(system + p, inside, 1.0, cache_modifier=".cg")
    return weight + (to_left + to_right + to_upper + to_lower), to_left, to_right, to_upper, to_lower


@triton.jit
def _value_at(values, p, n):
    """Load values of a field at pixels, 0 outside the field."""
    return tl.load(values + p, (p >= 0) & (p < n), 0.0, cache_modifier=".cg")


@triton.jit
def _start_tile(x, coarse_x, origin, p, n, height, width):
    """Store the initial iterate of a tile, unless it is already stored."""
    value = tl.zeros_like(p).to(tl.float32)
    if origin == FROM_COARSER:
        value = _upsampled(coarse_x, p // width, p % width, p < n, (height + 1) // 2, (width + 1) // 2)
    if origin != FROM_FIELD:
        tl.store(x + p, value, p < n)


@triton.jit
def _residual_tile(system, rhs, x, work, now, p, n, width, stride, area):
    """Compute a tile's initial residual, also preconditioned, the inverse diagonal, and their partial sum."""
    inside = p < n
    diagonal, to_left, to_right, to_upper, to_lower = _row_of_matrix(system, p, n, width, stride)
    rest = _value_at(rhs, p, n) - diagonal * _value_at(x, p, n)
    rest += to_left * _value_at(x, p - 1, n)
    rest += to_right * _value_at(x, p + 1, n)
    rest += to_upper * _value_at(x, p - width, n)
    rest += to_lower * _value_at(x, p + width, n)
    tl.store(work + p, rest, inside)
    tl.store(work + PRECONDITIONED * area + p, rest / diagonal, inside)
    tl.store(work + INVERSE_DIAGONAL * area + p, 1.0 / diagonal, inside)
    tl.store(now, tl.sum(tl.where(inside, rest * rest / diagonal, 0.0), 0))


@triton.jit
def _parts_of_direction(work, area, p, n, step):
    """Load the terms of the new direction at pixels: preconditioned residual and previous direction."""
    inside = (p >= 0) & (p < n)
    z = tl.load(work + PRECONDITIONED * area + p, inside, 0.0, cache_modifier=".cg")
    before = work + (DIRECTIONS + (step + 1) % 2) * area
    return z, tl.load(before + p, inside & (step > 0), 0.0, cache_modifier=".cg")


@triton.jit
def _direction_tile(system, work, partial, step, tile, tiles, count, p, n, width, stride, area):
    """Compute the direction ``d = z + beta d_before`` of a step in a tile, ``A d`` and partial ``d . A d``.

    ``z`` is the preconditioned residual. The neighbours' ``d`` is computed again here, so that programs need
    not synchronize between ``d`` and ``A d``. All pixels are loaded before the sums: a sum synchronizes the
    threads, and loads after it would stall again.
    """
    inside = p < n
    diagonal, to_left, to_right, to_upper, to_lower = _row_of_matrix(system, p, n, width, stride)
    # Other programs still read the previous direction while the new one is written.
    z, before = _parts_of_direction(work, area, p, n, step)
    z_left, before_left = _parts_of_direction(work, area, p - 1, n, step)
    z_right, before_right = _parts_of_direction(work, area, p + 1, n, step)
    z_upper, before_upper = _parts_of_direction(work, area, p - width, n, step)
    z_lower, before_lower = _parts_of_direction(work, area, p + width, n, step)
    beta = _total(partial + (step % 2) * count, tiles)
    # The first step has no previous direction, and the sums of the step before it were never written.
    beta /= tl.maximum(_total(partial + ((step + 1) % 2) * count, tl.where(step > 0, tiles, 0)), TINY)
    beta = tl.where(step > 0, beta, 0.0)
    direction = z + beta * before
    product = diagonal * direction
    product -= to_left * (z_left + beta * before_left)
    product -= to_right * (z_right + beta * before_right)
    product -= to_upper * (z_upper + beta * before_upper)
    product -= to_lower * (z_lower + beta * before_lower)
    tl.store(work + (DIRECTIONS + step % 2) * area + p, direction, inside)
    tl.store(work + PRODUCT * area + p, product, inside)
    tl.store(partial + 2 * count + tile, tl.sum(tl.where(inside, direction * product, 0.0), 0))


@triton.jit
def _update_tile(x, work, partial, step, tile, tiles, count, p, n, area):
    """Update iterate and residual of a tile along its direction, and the residual's partial sum.

    Pixels are loaded before the sums, as in ``_direction_tile``.
    """
    inside = p < n
    iterate = _value_at(x, p, n)
    direction = _value_at(work + (DIRECTIONS + step % 2) * area, p, n)
    rest = _value_at(work, p, n)
    product = _value_at(work + PRODUCT * area, p, n)
    inverse = _value_at(work + INVERSE_DIAGONAL * area, p, n)
    length = _total(partial + (step % 2) * count, tiles)
    length /= tl.maximum(_total(partial + 2 * count, tiles), TINY)
    iterate += length * direction
    tl.store(x + p, iterate, inside)
    rest -= length * product
    z = rest * inverse
    tl.store(work + p, rest, inside)
    tl.store(work + PRECONDITIONED * area + p, z, inside)
    tl.store(partial + ((step + 1) % 2) * count + tile, tl.sum(tl.where(inside, rest * z, 0.0), 0))


@triton.jit
def _conjugate_gradients(
    system, work, arrivals, expected, origin, steps, height, width, batch, channels, max_channels,
    TILE: tl.constexpr, ALONE: tl.constexpr,
):  # fmt: skip
    """Run all steps on one grid, synchronize, and return the arrivals expected afterwards.

    Programs share the tiles of every field or, if a field is small, the fields, and synchronize at the end.
    ``work`` holds the residual, the preconditioned residual, the matrix product of the direction, the inverse
    diagonal, and the directions of even and odd steps; then per tile the partial sums of the residual for
    even and odd steps, and of the direction with its matrix product.
    """
    programs, n, fields = tl.num_programs(0), height * width, batch * channels
    tiles, stride, area, alone = tl.cdiv(n, TILE), batch * n, n * fields, (n <= ALONE).to(tl.int32)
    first = tl.where(alone > 0, tl.program_id(0), 0)
    field_stride = tl.where(alone > 0, programs, 1)  # stride between the fields of this program
    begin, every = (tl.program_id(0) - first) * TILE, (programs + 1 - field_stride) * TILE
    per_stage = (1 - alone) * programs
    rhs, x = system + 3 * stride, system + (3 + max_channels) * stride
    coarse_x = (
        x + max_channels * stride + (3 + max_channels) * batch * ((height + 1) // 2) * ((width + 1) // 2)
    )
    partial = work + WORK_ARRAYS * area
    for field in range(first, fields, field_stride):
        coarse = coarse_x + field * ((height + 1) // 2) * ((width + 1) // 2)
        for at in range(begin, n, every):
            p = at + tl.arange(0, TILE)
            _start_tile(x + field * n, coarse, origin, p, n, height, width)
    expected += per_stage
    _synchronize(arrivals, expected, alone)
    for field in range(first, fields, field_stride):
        of_sample, own = system + (field // channels) * n, field * n
        for at in range(begin, n, every):
            p, now = at + tl.arange(0, TILE), partial + field * tiles + at // TILE
            _residual_tile(of_sample, rhs + own, x + own, work + own, now, p, n, width, stride, area)
    for step in range(steps):
        expected += per_stage
        _synchronize(arrivals, expected, alone)
        for field in range(first, fields, field_stride):
            of_sample, sums = system + (field // channels) * n, partial + field * tiles
            for at in range(begin, n, every):
                _direction_tile(
                    of_sample, work + field * n, sums, step, at // TILE, tiles, fields * tiles,
                    at + tl.arange(0, TILE), n, width, stride, area,
                )  # fmt: skip
        expected += per_stage
        _synchronize(arrivals, expected, alone)
        for field in range(first, fields, field_stride):
            own, sums = field * n, partial + field * tiles
            for at in range(begin, n, every):
                p = at + tl.arange(0, TILE)
                _update_tile(x + own, work + own, sums, step, at // TILE, tiles, fields * tiles, p, n, area)
    expected += programs
    _synchronize(arrivals, expected, 0)
    return expected


@triton.jit
def _coarsen(scratch, arrivals, expected, height, width, batch, channels, stored, levels, TILE: tl.constexpr):
    """Compute the systems of all coarser grids and return the arrivals expected afterwards."""
    first, programs = tl.program_id(0), tl.num_programs(0)
    for finer in range(levels - 1):
        rows, columns = _size(height, width, finer)
        fine = scratch + stored * _pixels_before(height, width, finer)
        coarse = fine + stored * rows * columns
        tiles = tl.cdiv(((rows + 1) // 2) * ((columns + 1) // 2), TILE)
        for tile in range(first, tiles * batch, programs):
            cell = (tile % tiles) * TILE + tl.arange(0, TILE)
            _coarsen_tile(fine, coarse, tile // tiles, cell, rows, columns, batch, channels)
        expected += programs
        _synchronize(arrivals, expected, 0)
    return expected


@triton.jit
def _finish_tile(
    data, weight, noise, error, radius, error_kind, x, field, support, weights, shared, sample, p, n,
    max_channels, ROBUST: tl.constexpr,
):  # fmt: skip
    """Store the results of a launch."""
    inside, own = p < n, sample * n + p
    if ROBUST:
        u, previous, residual = _residual(data, field, x, shared, sample, max_channels, p, n)
        found = _cauchy_weight(weight, noise, error, radius, error_kind, residual, shared, sample, p, n)
        tl.store(weights + own, found, inside)
        tl.store(field + own, previous + u, inside)
        if max_channels > 1:
            decided = tl.load(x + (sample * max_channels + 1) * n + p, inside, 0.0, cache_modifier=".cg")
            tl.store(support + own, decided, inside)
    else:
        for channel in range(sample * max_channels, (sample + 1) * max_channels):
            u = tl.load(x + channel * n + p, inside, 0.0, cache_modifier=".cg")
            tl.store(field + channel * n + p, u, inside)


@triton.jit(do_not_specialize=_SIZES + _COUNTS, do_not_specialize_on_alignment=_TENSORS + _WRITTEN)
def solve_kernel(
    data, weight, across, down, start, noise, error, smoothness, tikhonov,
    field, support, weights, scratch, arrivals, radius,
    height, width, batch, parts, levels, max_channels, passes, rounds, first_steps, steps, given,
    local, error_kind,
    ROBUST: tl.constexpr, TILE: tl.constexpr, ALONE: tl.constexpr,
):  # fmt: skip
    """Run all passes of ``solve_robust``, or ``solve_field`` with a given ``weight`` and ``data`` as rhs.

    ``scratch`` holds per level, finest first: weight, affinities across and down, right-hand side and field;
    then the work arrays of ``_conjugate_gradients``. Tensors with fewer samples than ``batch`` repeat
    cyclically. Every sample has ``max_channels`` fields in the last pass and one in the others.
    """
    first, programs, n = tl.program_id(0), tl.num_programs(0), height * width
    tiles, stored, expected = tl.cdiv(n, TILE), (3 + 2 * max_channels) * batch, 0
    work = scratch + stored * _pixels_before(height, width, levels)
    for turn in range(passes * rounds):
        part, again = turn // rounds, turn % rounds
        channels = tl.where(part < passes - 1, 1, max_channels)
        for tile in range(first, tiles * batch, programs):
            sample, p = tile // tiles, (tile % tiles) * TILE + tl.arange(0, TILE)
            shared = sample % parts
            of_pass = (part * parts + shared) * (1 + (n - 1) * local)
            _store_affinities(
                across, down, smoothness + of_pass, scratch, shared, sample, p, height, width, batch, local,
                ROBUST,
            )  # fmt: skip
            if ROBUST:
                _robust_tile(
                    data, weight, noise, error, radius, error_kind, tikhonov + of_pass, field, scratch,
                    shared, sample, p, part, again, n, batch, channels, max_channels, local,
                )  # fmt: skip
            else:
                _given_tile(data, weight, start, scratch, sample, p, n, batch, channels, given)
        expected += programs
        _synchronize(arrivals, expected, 0)
        from_zero = (again + given) == 0
        top = tl.where(from_zero, levels, 1)
        expected = _coarsen(scratch, arrivals, expected, height, width, batch, channels, stored, top, TILE)
        for above in range(top):
            rows, columns = _size(height, width, top - 1 - above)
            system = scratch + stored * _pixels_before(height, width, top - 1 - above)
            coarsest = from_zero & (above == 0)
            origin = tl.where(above > 0, FROM_COARSER, tl.where(coarsest, FROM_ZEROS, FROM_FIELD))
            expected = _conjugate_gradients(
                system, work, arrivals, expected, origin, tl.where(coarsest, first_steps, steps), rows,
                columns, batch, channels, max_channels, TILE, ALONE,
            )  # fmt: skip
    x = scratch + (3 + max_channels) * batch * n
    for tile in range(first, tiles * batch, programs):
        sample, p = tile // tiles, (tile % tiles) * TILE + tl.arange(0, TILE)
        shared = sample % parts
        _finish_tile(
            data, weight, noise, error, radius, error_kind, x, field, support, weights, shared, sample, p, n,
            max_channels, ROBUST,
        )  # fmt: skip


@functools.cache
def _max_programs(device: torch.device) -> int:
    """Return the number of programs that a device can run concurrently; 1 in the interpreter."""
    if device.type != "cuda":
        return 1
    return RESIDENT * torch.cuda.get_device_properties(device).multi_processor_count


class _Read(NamedTuple):
    """Inputs of a launch; an unused field holds any tensor."""

    data: Tensor  # (parts, 1, H, W), or the right-hand side (B, C, H, W)
    weight: Tensor  # (B, 1, H, W)
    across: Tensor  # (parts, 1, H, W - 1)
    down: Tensor  # (parts, 1, H - 1, W)
    start: Tensor  # shape of the field
    noise: Tensor  # (parts, 1, H, W)
    error: Tensor  # (parts, 1, 1, 1), or (parts, 1, H, W)
    smoothness: Tensor  # (passes, parts, 1, H, W), or with 1x1 pixels
    tikhonov: Tensor  # like smoothness


class _Counts(NamedTuple):
    """Loop counts and modes of a launch."""

    channels: int
    passes: int
    rounds: int
    first_steps: int
    steps: int
    given: bool  # whether ``start`` is given
    local: bool  # whether smoothness is given per pixel
    error_kind: int = NO_ERROR.value


def _sizes(height: int, width: int, levels: bool) -> list[tuple[int, int]]:
    """Return the grid sizes of a pyramid, finest first; only the finest if not ``levels``."""
    sizes = [(height, width)]
    while levels and min(sizes[-1]) > COARSEST_SIDE:
        sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
    return sizes


def _scratch_size(batch: int, fields: int, pixels: Sequence[int]) -> int:
    """Return the number of scratch values of a launch, for grids with the given pixel counts."""
    stored = (3 * batch + 2 * fields) * sum(pixels)
    return stored + fields * (WORK_ARRAYS.value * pixels[0] + SUMS.value * triton.cdiv(pixels[0], TILE))


def _launch(
    read: _Read, written: tuple[Tensor, Tensor, Tensor], counts: _Counts, radius: float | None = None
) -> None:
    """Run ``solve_kernel`` into field, data support and weights; without ``radius`` into the field only."""
    batch, _, height, width = read.weight.shape
    pixels = [rows * columns for rows, columns in _sizes(height, width, not counts.given)]
    fields = batch * counts.channels
    tiles = triton.cdiv(pixels[0], TILE) * fields
    scratch = read.data.new_empty(_scratch_size(batch, fields, pixels))
    arrivals = torch.zeros(1, dtype=torch.int32, device=scratch.device)
    launched_on(scratch, solve_kernel[(min(tiles, _max_programs(scratch.device)),)])(
        *read, *written, scratch, arrivals, 1.0 if radius is None else radius,
        height, width, batch, len(read.across), len(pixels), *map(int, counts),
        ROBUST=radius is not None, TILE=TILE, ALONE=ALONE,
        num_warps=WARPS, maxnreg=MAX_REGISTERS, launch_cooperative_grid=True,
    )  # fmt: skip


def _of_batch(part: Tensor, samples: int, axis: int = 0) -> Tensor:
    """Expand a part of a system to ``samples`` samples, contiguous."""
    if part.shape[axis] != samples:
        part = part.expand(*part.shape[:axis], samples, *part.shape[axis + 1 :])
    return part.contiguous()


def solve_field(system: FieldSystem, steps: int, start: Tensor | None = None) -> Tensor:
    """Run ``solver.solve_field`` with the kernel: the same steps on the same grids."""
    rhs = system.rhs.contiguous()
    batch, channels = rhs.shape[:2]
    field, unused = torch.empty_like(rhs), rhs
    read = _Read(
        data=rhs,
        weight=_of_batch(system.weight, batch),
        across=system.across.contiguous(),
        down=system.down.contiguous(),
        start=unused if start is None else start.contiguous(),
        noise=unused,
        error=unused,
        smoothness=unused,
        tikhonov=unused,
    )
    counts = _Counts(
        channels=channels,
        passes=1,
        rounds=1,
        first_steps=COARSEST_STEPS,
        steps=steps,
        given=start is not None,
        local=False,
    )
    _launch(read, (field, unused, unused), counts)
    return field


def solve_robust(system: RobustSystem, rounds: int, steps: int, *, with_support: bool = False) -> RobustField:
    """Run ``solver.solve_robust`` with the kernel."""
    data, trusted = system.data.contiguous(), system.trusted.contiguous()
    parts = len(data)
    across, down = (_of_batch(part, parts) for part in system.affinities)
    smoothness, tikhonov = (_of_batch(part, parts, axis=1) for part in (system.smoothness, system.tikhonov))
    error, error_kind = _error_input(system, unused=data)
    read = _Read(
        data=data,
        weight=trusted,
        across=across,
        down=down,
        start=data,  # unused
        noise=system.noise.contiguous(),
        error=error,
        smoothness=smoothness,
        tikhonov=tikhonov,
    )
    counts = _Counts(
        channels=2 if with_support else 1,
        passes=len(smoothness),
        rounds=rounds,
        first_steps=COARSEST_STEPS,
        steps=steps,
        given=False,
        local=image_size(smoothness) != (1, 1),
        error_kind=error_kind,
    )
    # One allocation for all results, as each is an operation on the host.
    results = trusted.new_empty(3 if with_support else 2, *trusted.shape).unbind()
    field, weights = results[:2]
    support = results[2] if with_support else None
    # The kernel writes the support only with two channels, so any tensor can take its place.
    written = field, weights if support is None else support, weights
    _launch(read, written, counts, system.radius)
    return RobustField(field, weights, support)


def _error_input(system: RobustSystem, unused: Tensor) -> tuple[Tensor, int]:
    """Return the standard deviation of the fitted map, or ``unused`` without one, and its kind."""
    if system.error is None:
        return unused, NO_ERROR.value
    error = _of_batch(system.error, len(system.data))
    kind = PER_SAMPLE if image_size(error) == (1, 1) else PER_PIXEL
    return error, kind.value
