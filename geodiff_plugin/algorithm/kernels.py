"""Triton kernel of the pyramid solver; its references are ``solve_field`` and ``solve_robust`` of ``solver``.

One launch makes all of it: the passes and their rounds of reweighting, the coarser grids, and the
conjugate-gradient steps on each. Between these stages all programs of the launch wait for each other, so all
of them must be on the device at the same time: it is launched as a cooperative grid, which CUDA refuses where
they do not fit, and never with more programs than the bound on registers admits. What some program has
written in the launch is read past the first cache (``.cg``), which other multiprocessors do not update.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.algorithm import solver
from geodiff_plugin.algorithm.solver import FieldSystem, RobustField, RobustSystem

#: Pixels of a tile.
TILE = 1024
#: Pixels of a grid that one program solves by itself: it waits for no other.
ALONE = 1024
#: Warps of a program.
WARPS = 8
#: Registers of a thread at most, and programs that a multiprocessor of 65,536 registers then holds.
MOST_REGISTERS = 224
RESIDENT = 65_536 // (MOST_REGISTERS * 32 * WARPS)
#: The first iterate is zero.
FROM_ZEROS = tl.constexpr(0)
#: It is the field that the last round has left on the same grid.
FROM_FIELD = tl.constexpr(1)
#: It is the field of the next coarser grid.
FROM_COARSER = tl.constexpr(2)
#: Arrays of a field's size that the steps work with.
WORK_ARRAYS = tl.constexpr(6)
#: Sums that they keep of every tile.
SUMS = tl.constexpr(3)
#: Partial sums that are added at a time.
GATHERED = tl.constexpr(256)
#: As ``tiny`` of the reference: a channel that has converged stays where it is.
TINY = tl.constexpr(1e-20)

_TENSORS = ["data", "weight", "across", "down", "start", "noise", "error", "smoothness", "inertia"]
_WRITTEN = ["field", "support", "weights", "scratch", "arrivals"]
_SIZES = ["height", "width", "batch", "parts", "levels"]
_COUNTS = ["most", "passes", "rounds", "first_steps", "steps", "given", "local", "error_kind"]


@triton.jit
def _meet(arrivals, expected, alone):
    """Wait until all programs have arrived ``expected / programs`` times, and see what they have stored.

    A program that is ``alone`` waits for its own threads only.
    """
    tl.debug_barrier()
    if alone == 0:
        tl.atomic_add(arrivals, 1, sem="release", scope="gpu")
        while tl.atomic_add(arrivals, 0, sem="acquire", scope="gpu") < expected:
            pass
        tl.debug_barrier()


@triton.jit
def _size(height, width, level):
    """Height and width of a level of the pyramid, of which 0 is the finest."""
    return (height + (1 << level) - 1) >> level, (width + (1 << level) - 1) >> level


@triton.jit
def _pixels_before(height, width, level):
    """Pixels of all finer levels."""
    pixels = 0
    for finer in range(level):
        rows, columns = _size(height, width, finer)
        pixels += rows * columns
    return pixels


@triton.jit
def _store_links(
    across, down, smoothness, system, shared, sample, p, height, width, batch, local, ROBUST: tl.constexpr
):
    """The links of the finest grid, to the right and down, of every pixel; 0 where it has no neighbour."""
    n, inside, y = height * width, p < height * width, p // width
    right, lower = inside & (p - y * width < width - 1), p < n - width
    to_right = tl.load(across + shared * (n - height) + p - y, right, 0.0)
    to_lower = tl.load(down + shared * (n - width) + p, lower, 0.0)
    if ROBUST:  # of a smoothness per pixel the lower one of both ends
        here = tl.load(smoothness + p * local, inside, 0.0)
        to_right *= tl.minimum(here, tl.load(smoothness + (p + 1) * local, right, 0.0))
        to_lower *= tl.minimum(here, tl.load(smoothness + (p + width) * local, lower, 0.0))
    at = system + (batch + sample) * n + p
    tl.store(at, to_right, inside)
    tl.store(at + batch * n, to_lower, inside)


@triton.jit
def _left_over(data, field, x, shared, sample, held, p, n):
    """The field of the last round, that of the passes before, and what both leave of the data."""
    inside = p < n
    u = tl.load(x + sample * held * n + p, inside, 0.0, cache_modifier=".cg")
    done = tl.load(field + sample * n + p, inside, 0.0, cache_modifier=".cg")
    return u, done, u - (tl.load(data + shared * n + p, inside, 0.0) - done)


@triton.jit
def _cauchy_weight(weight, noise, error, reach, error_kind, left_over, shared, sample, p, n):
    """The weight of observations in the next round.

    ``error_kind`` is 0 where there is no ``error``, 1 where it has a value per sample, 2 where per pixel.
    """
    deviation = tl.load(noise + shared * n + p, p < n, 1.0)
    of_pixel = error_kind // 2
    of_fitted = tl.load(error + shared * (1 + (n - 1) * of_pixel) + p * of_pixel, p < n, 0.0)
    of_fitted = tl.where(error_kind > 0, of_fitted, 0.0)
    ratio = left_over / (reach * tl.sqrt(deviation * deviation + of_fitted * of_fitted))
    return tl.load(weight + sample * n + p, p < n, 0.0) / (1.0 + ratio * ratio)


@triton.jit
def _robust_tile(
    data, weight, noise, error, reach, error_kind, inertia, field, system, shared, sample, p, part, turn, n,
    batch, channels, most, local,
):  # fmt: skip
    """Weight and pull of a round of a pass; a pass begins with what the ones before have left of the data."""
    inside, own = p < n, sample * n + p
    weights, done = tl.load(weight + own, inside, 0.0), tl.zeros_like(p).to(tl.float32)
    if part + turn > 0:
        # Only the last pass has a second channel, and it has begun only after its first round.
        held = tl.where(turn > 0, channels, 1)
        x = system + (3 + most) * batch * n
        u, done, left_over = _left_over(data, field, x, shared, sample, held, p, n)
        weights = _cauchy_weight(weight, noise, error, reach, error_kind, left_over, shared, sample, p, n)
        done += tl.where(turn > 0, 0.0, u)
    if turn == 0:
        tl.store(field + own, done, inside)
    tl.store(system + own, weights + tl.load(inertia + p * local, inside, 0.0), inside)
    pull = system + (3 * batch + sample * channels) * n + p
    tl.store(pull, weights * (tl.load(data + shared * n + p, inside, 0.0) - done), inside)
    if channels > 1:
        tl.store(pull + n, weights, inside)


@triton.jit
def _given_tile(data, weight, start, system, sample, p, n, batch, channels, given):
    """Weight and pull that are given, and the first iterate, if it is."""
    inside = p < n
    tl.store(system + sample * n + p, tl.load(weight + sample * n + p, inside, 0.0), inside)
    for channel in range(channels):
        at = (sample * channels + channel) * n + p
        pull = system + 3 * batch * n + at
        tl.store(pull, tl.load(data + at, inside, 0.0), inside)
        if given > 0:
            tl.store(pull + channels * batch * n, tl.load(start + at, inside, 0.0), inside)


@triton.jit
def _cell_sum(fine, y, x, height, width, inside, rows: tl.constexpr, columns: tl.constexpr):
    """Sums of values at pixels, of those below and beside them, and of both."""
    at = fine + y * width + x
    total = tl.load(at, inside & (y < height) & (x < width), 0.0, cache_modifier=".cg")
    if rows == 2:
        below = inside & (y + 1 < height) & (x < width)
        total += tl.load(at + width, below, 0.0, cache_modifier=".cg")
    if columns == 2:
        beside = inside & (y < height) & (x + 1 < width)
        total += tl.load(at + 1, beside, 0.0, cache_modifier=".cg")
    if rows * columns == 4:
        both = inside & (y + 1 < height) & (x + 1 < width)
        total += tl.load(at + width + 1, both, 0.0, cache_modifier=".cg")
    return total


@triton.jit
def _coarsen_tile(fine, coarse, sample, cell, height, width, batch, channels):
    """``FieldSystem.coarser``: a tile of the coarse grid."""
    rows, columns = (height + 1) // 2, (width + 1) // 2
    n, coarse_n = height * width, rows * columns
    inside, y, x = cell < coarse_n, 2 * (cell // columns), 2 * (cell % columns)
    at, of_sample = coarse + sample * coarse_n + cell, fine + sample * n
    tl.store(at, _cell_sum(of_sample, y, x, height, width, inside, 2, 2), inside)
    # From a coarse column to the next: the fine link behind column x + 1, in both rows of the cell.
    linked = _cell_sum(of_sample + batch * n, y, x + 1, height, width, inside, 2, 1)
    tl.store(at + batch * coarse_n, 0.5 * linked, inside)
    linked = _cell_sum(of_sample + 2 * batch * n, y + 1, x, height, width, inside, 1, 2)
    tl.store(at + 2 * batch * coarse_n, 0.5 * linked, inside)
    for channel in range(sample * channels, (sample + 1) * channels):
        pull = _cell_sum(fine + (3 * batch + channel) * n, y, x, height, width, inside, 2, 2)
        tl.store(coarse + (3 * batch + channel) * coarse_n + cell, pull, inside)


@triton.jit
def _total(partial, count):
    """The sum of one number a tile: in one order, whatever program asks."""
    k = tl.arange(0, GATHERED)
    total = tl.zeros([GATHERED], tl.float32)
    for first in range(0, count, GATHERED):
        total += tl.load(partial + first + k, first + k < count, 0.0, cache_modifier=".cg")
    return tl.sum(total, 0)


@triton.jit
def _enlarged(coarse, y, x, inside, height, width):
    """A coarse field of a size at twice the resolution, bilinear, as ``F.interpolate`` does it."""
    row = tl.maximum((y.to(tl.float32) + 0.5) * 0.5 - 0.5, 0.0)
    column = tl.maximum((x.to(tl.float32) + 0.5) * 0.5 - 0.5, 0.0)
    y0, x0 = row.to(tl.int32), column.to(tl.int32)
    down, right = row - y0.to(tl.float32), column - x0.to(tl.float32)
    beside = tl.minimum(x0 + 1, width - 1) - x0
    value = tl.zeros_like(row)
    for lower in range(2):
        at = coarse + tl.minimum(y0 + lower, height - 1) * width + x0
        of_row = (1.0 - right) * tl.load(at, inside, 0.0, cache_modifier=".cg")
        of_row += right * tl.load(at + beside, inside, 0.0, cache_modifier=".cg")
        value += tl.where(lower > 0, down, 1.0 - down) * of_row
    return value


@triton.jit
def _row_of_matrix(system, p, n, width, stride):
    """The system at pixels: its diagonal, and the links to the left, to the right, up and down.

    What is left of the first column is the last column of the row above, whose link to the right is 0.
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
    """Values of a field at pixels, 0 outside of it."""
    return tl.load(values + p, (p >= 0) & (p < n), 0.0, cache_modifier=".cg")


@triton.jit
def _start_tile(x, coarse_x, origin, p, n, height, width):
    """The first iterate of a tile, if it is not there yet."""
    value = tl.zeros_like(p).to(tl.float32)
    if origin == FROM_COARSER:
        value = _enlarged(coarse_x, p // width, p % width, p < n, (height + 1) // 2, (width + 1) // 2)
    if origin != FROM_FIELD:
        tl.store(x + p, value, p < n)


@triton.jit
def _residual_tile(system, pull, x, work, now, p, n, width, stride, area):
    """The first residual of a tile, preconditioned as well, the inverse of the diagonal, and their sum."""
    inside = p < n
    diagonal, to_left, to_right, to_upper, to_lower = _row_of_matrix(system, p, n, width, stride)
    rest = _value_at(pull, p, n) - diagonal * _value_at(x, p, n)
    rest += to_left * _value_at(x, p - 1, n)
    rest += to_right * _value_at(x, p + 1, n)
    rest += to_upper * _value_at(x, p - width, n)
    rest += to_lower * _value_at(x, p + width, n)
    tl.store(work + p, rest, inside)
    tl.store(work + area + p, rest / diagonal, inside)
    tl.store(work + 3 * area + p, 1.0 / diagonal, inside)
    tl.store(now, tl.sum(tl.where(inside, rest * rest / diagonal, 0.0), 0))


@triton.jit
def _parts_of_direction(work, area, p, n, step):
    """What the new direction at pixels is made of: the preconditioned residual, and the direction before."""
    inside = (p >= 0) & (p < n)
    here = tl.load(work + area + p, inside, 0.0, cache_modifier=".cg")
    old = work + (5 - step % 2) * area
    return here, tl.load(old + p, inside & (step > 0), 0.0, cache_modifier=".cg")


@triton.jit
def _direction_tile(system, work, partial, step, tile, tiles, count, p, n, width, stride, area):
    """The direction of a step in a tile, its image under the matrix, and the sum of their product.

    All pixels are read before the sums. Threads wait for each other at a sum, and would wait for memory again
    after it.
    """
    inside = p < n
    diagonal, to_left, to_right, to_upper, to_lower = _row_of_matrix(system, p, n, width, stride)
    # The direction of the step before is read by other programs while the new one is written.
    here, before = _parts_of_direction(work, area, p, n, step)
    left, left_before = _parts_of_direction(work, area, p - 1, n, step)
    right, right_before = _parts_of_direction(work, area, p + 1, n, step)
    upper, upper_before = _parts_of_direction(work, area, p - width, n, step)
    lower, lower_before = _parts_of_direction(work, area, p + width, n, step)
    share = _total(partial + (step % 2) * count, tiles)
    share /= tl.maximum(_total(partial + ((step + 1) % 2) * count, tiles), TINY)
    share = tl.where(step > 0, share, 0.0)  # there is no step before the first
    here += share * before
    value = diagonal * here
    value -= to_left * (left + share * left_before)
    value -= to_right * (right + share * right_before)
    value -= to_upper * (upper + share * upper_before)
    value -= to_lower * (lower + share * lower_before)
    tl.store(work + (4 + step % 2) * area + p, here, inside)
    tl.store(work + 2 * area + p, value, inside)
    tl.store(partial + 2 * count + tile, tl.sum(tl.where(inside, here * value, 0.0), 0))


@triton.jit
def _update_tile(x, work, partial, step, tile, tiles, count, p, n, area):
    """Iterate and residual of a tile after the step along its direction, and the residual's sum.

    Pixels are read before the sums, as by ``_direction_tile``.
    """
    inside = p < n
    moved, direction = _value_at(x, p, n), _value_at(work + (4 + step % 2) * area, p, n)
    rest, image = _value_at(work, p, n), _value_at(work + 2 * area, p, n)
    inverse = _value_at(work + 3 * area, p, n)
    length = _total(partial + (step % 2) * count, tiles)
    length /= tl.maximum(_total(partial + 2 * count, tiles), TINY)
    moved += length * direction
    tl.store(x + p, moved, inside)
    rest -= length * image
    z = rest * inverse
    tl.store(work + p, rest, inside)
    tl.store(work + area + p, z, inside)
    tl.store(partial + ((step + 1) % 2) * count + tile, tl.sum(tl.where(inside, rest * z, 0.0), 0))


@triton.jit
def _conjugate_gradients(
    system, work, arrivals, expected, origin, steps, height, width, batch, channels, most,
    TILE: tl.constexpr, ALONE: tl.constexpr,
):  # fmt: skip
    """All steps on one grid, whose field is then seen by all programs; the arrivals expected after them.

    The programs share the tiles of every field, or, where a field is small, the fields, and meet at the end.
    ``work`` holds residual, preconditioned residual, image of the direction, inverse of the diagonal, and the
    directions of even and of odd steps; then one sum a tile: the residual's of even and of odd steps, and
    that of a direction with its image.
    """
    programs, n, fields = tl.num_programs(0), height * width, batch * channels
    tiles, stride, area, alone = tl.cdiv(n, TILE), batch * n, n * fields, (n <= ALONE).to(tl.int32)
    first = tl.where(alone > 0, tl.program_id(0), 0)
    apart = tl.where(alone > 0, programs, 1)  # from a field of this program to its next one
    begin, every = (tl.program_id(0) - first) * TILE, (programs + 1 - apart) * TILE
    arriving = (1 - alone) * programs
    pull, x = system + 3 * stride, system + (3 + most) * stride
    coarse_x = x + most * stride + (3 + most) * batch * ((height + 1) // 2) * ((width + 1) // 2)
    partial = work + WORK_ARRAYS * area
    for field in range(first, fields, apart):
        coarse = coarse_x + field * ((height + 1) // 2) * ((width + 1) // 2)
        for at in range(begin, n, every):
            p = at + tl.arange(0, TILE)
            _start_tile(x + field * n, coarse, origin, p, n, height, width)
    expected += arriving
    _meet(arrivals, expected, alone)
    for field in range(first, fields, apart):
        of_sample, own = system + (field // channels) * n, field * n
        for at in range(begin, n, every):
            p, now = at + tl.arange(0, TILE), partial + field * tiles + at // TILE
            _residual_tile(of_sample, pull + own, x + own, work + own, now, p, n, width, stride, area)
    for step in range(steps):
        expected += arriving
        _meet(arrivals, expected, alone)
        for field in range(first, fields, apart):
            of_sample, sums = system + (field // channels) * n, partial + field * tiles
            for at in range(begin, n, every):
                _direction_tile(
                    of_sample, work + field * n, sums, step, at // TILE, tiles, fields * tiles,
                    at + tl.arange(0, TILE), n, width, stride, area,
                )  # fmt: skip
        expected += arriving
        _meet(arrivals, expected, alone)
        for field in range(first, fields, apart):
            own, sums = field * n, partial + field * tiles
            for at in range(begin, n, every):
                p = at + tl.arange(0, TILE)
                _update_tile(x + own, work + own, sums, step, at // TILE, tiles, fields * tiles, p, n, area)
    expected += programs
    _meet(arrivals, expected, 0)
    return expected


@triton.jit
def _coarsen(scratch, arrivals, expected, height, width, batch, channels, stored, levels, TILE: tl.constexpr):
    """The systems of all coarser grids; the arrivals expected after them."""
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
        _meet(arrivals, expected, 0)
    return expected


@triton.jit
def _finish_tile(
    data, weight, noise, error, reach, error_kind, x, field, support, weights, shared, sample, p, n, most,
    ROBUST: tl.constexpr,
):  # fmt: skip
    """What a launch returns."""
    inside, own = p < n, sample * n + p
    if ROBUST:
        u, done, left_over = _left_over(data, field, x, shared, sample, most, p, n)
        found = _cauchy_weight(weight, noise, error, reach, error_kind, left_over, shared, sample, p, n)
        tl.store(weights + own, found, inside)
        tl.store(field + own, done + u, inside)
        if most > 1:
            decided = tl.load(x + (sample * most + 1) * n + p, inside, 0.0, cache_modifier=".cg")
            tl.store(support + own, decided, inside)
    else:
        for channel in range(sample * most, (sample + 1) * most):
            u = tl.load(x + channel * n + p, inside, 0.0, cache_modifier=".cg")
            tl.store(field + channel * n + p, u, inside)


@triton.jit(do_not_specialize=_SIZES + _COUNTS, do_not_specialize_on_alignment=_TENSORS + _WRITTEN)
def solve_kernel(
    data, weight, across, down, start, noise, error, smoothness, inertia,
    field, support, weights, scratch, arrivals, reach,
    height, width, batch, parts, levels, most, passes, rounds, first_steps, steps, given, local, error_kind,
    ROBUST: tl.constexpr, TILE: tl.constexpr, ALONE: tl.constexpr,
):  # fmt: skip
    """All passes of ``solve_robust``, or ``solve_field``, whose ``weight`` and pull ``data`` are given.

    ``scratch`` has of every level, the finest first, weight, links across and down, pull and field, and then
    what ``_conjugate_gradients`` works with. Parts of fewer samples than the ``batch`` hold for the rest in
    turn. Every sample has ``most`` fields, one in all passes but the last.
    """
    first, programs, n = tl.program_id(0), tl.num_programs(0), height * width
    tiles, stored, expected = tl.cdiv(n, TILE), (3 + 2 * most) * batch, 0
    work = scratch + stored * _pixels_before(height, width, levels)
    for turn in range(passes * rounds):
        part, again = turn // rounds, turn % rounds
        channels = tl.where(part < passes - 1, 1, most)
        for tile in range(first, tiles * batch, programs):
            sample, p = tile // tiles, (tile % tiles) * TILE + tl.arange(0, TILE)
            shared = sample % parts
            of_pass = (part * parts + shared) * (1 + (n - 1) * local)
            _store_links(
                across, down, smoothness + of_pass, scratch, shared, sample, p, height, width, batch, local,
                ROBUST,
            )  # fmt: skip
            if ROBUST:
                _robust_tile(
                    data, weight, noise, error, reach, error_kind, inertia + of_pass, field, scratch, shared,
                    sample, p, part, again, n, batch, channels, most, local,
                )  # fmt: skip
            else:
                _given_tile(data, weight, start, scratch, sample, p, n, batch, channels, given)
        expected += programs
        _meet(arrivals, expected, 0)
        fresh = (again + given) == 0
        top = tl.where(fresh, levels, 1)
        expected = _coarsen(scratch, arrivals, expected, height, width, batch, channels, stored, top, TILE)
        for above in range(top):
            rows, columns = _size(height, width, top - 1 - above)
            system = scratch + stored * _pixels_before(height, width, top - 1 - above)
            coarsest = fresh & (above == 0)
            origin = tl.where(above > 0, FROM_COARSER, tl.where(coarsest, FROM_ZEROS, FROM_FIELD))
            expected = _conjugate_gradients(
                system, work, arrivals, expected, origin, tl.where(coarsest, first_steps, steps), rows,
                columns, batch, channels, most, TILE, ALONE,
            )  # fmt: skip
    x = scratch + (3 + most) * batch * n
    for tile in range(first, tiles * batch, programs):
        sample, p = tile // tiles, (tile % tiles) * TILE + tl.arange(0, TILE)
        shared = sample % parts
        _finish_tile(
            data, weight, noise, error, reach, error_kind, x, field, support, weights, shared, sample, p, n,
            most, ROBUST,
        )  # fmt: skip


@functools.cache
def _most_programs(device: torch.device) -> int:
    """Programs that a device holds at the same time; in the interpreter one runs."""
    if device.type != "cuda":
        return 1
    return RESIDENT * torch.cuda.get_device_properties(device).multi_processor_count


class _Read(NamedTuple):
    """What a launch reads; a part that it does not need is any tensor."""

    data: Tensor  # (parts, 1, H, W), or the pull (B, C, H, W)
    weight: Tensor  # (B, 1, H, W)
    across: Tensor  # (parts, 1, H, W - 1)
    down: Tensor  # (parts, 1, H - 1, W)
    start: Tensor  # as the field
    noise: Tensor  # (parts, 1, H, W)
    error: Tensor  # (parts, 1, 1, 1), or (parts, 1, H, W)
    smoothness: Tensor  # (passes, parts, 1, H, W), or of pixels (1, 1)
    inertia: Tensor  # as smoothness


class _Counts(NamedTuple):
    """What a launch does."""

    channels: int
    passes: int
    rounds: int
    first_steps: int
    steps: int
    given: bool  # whether ``start`` is
    local: bool  # whether there is a smoothness per pixel
    error_kind: int = 0  # as ``_cauchy_weight`` has it


def _sizes(height: int, width: int, levels: bool) -> list[tuple[int, int]]:
    """Height and width of the grids of a pyramid, the finest first; of that one alone if not ``levels``."""
    sizes = [(height, width)]
    while levels and min(sizes[-1]) > solver.COARSEST_SIDE:
        sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
    return sizes


def _scratch_size(batch: int, fields: int, pixels: Sequence[int]) -> int:
    """Values that a launch works in, for grids of so many pixels."""
    stored = (3 * batch + 2 * fields) * sum(pixels)
    return stored + fields * (WORK_ARRAYS.value * pixels[0] + SUMS.value * triton.cdiv(pixels[0], TILE))


def _launch(
    read: _Read, written: tuple[Tensor, Tensor, Tensor], counts: _Counts, reach: float | None = None
) -> None:
    """``solve_kernel`` into field, support and weights; without ``reach`` it is not robust: field only."""
    batch, _, height, width = read.weight.shape
    pixels = [rows * columns for rows, columns in _sizes(height, width, not counts.given)]
    fields = batch * counts.channels
    tiles = triton.cdiv(pixels[0], TILE) * fields
    scratch = read.data.new_empty(_scratch_size(batch, fields, pixels))
    arrivals = torch.zeros(1, dtype=torch.int32, device=scratch.device)
    launched_on(scratch, solve_kernel[(min(tiles, _most_programs(scratch.device)),)])(
        *read, *written, scratch, arrivals, 1.0 if reach is None else reach,
        height, width, batch, len(read.across), len(pixels), *map(int, counts),
        ROBUST=reach is not None, TILE=TILE, ALONE=ALONE,
        num_warps=WARPS, maxnreg=MOST_REGISTERS, launch_cooperative_grid=True,
    )  # fmt: skip


def _of_batch(part: Tensor, samples: int, axis: int = 0) -> Tensor:
    """A part of a system, contiguous, of so many samples."""
    if part.shape[axis] != samples:
        part = part.expand(*part.shape[:axis], samples, *part.shape[axis + 1 :])
    return part.contiguous()


def solve_field(system: FieldSystem, steps: int, start: Tensor | None) -> Tensor:
    """``solver.solve_field`` by the kernel: the same steps on the same grids."""
    pull = system.pull.contiguous()
    (batch, channels), field = pull.shape[:2], torch.empty_like(pull)
    weight, across, down = (
        _of_batch(system.weight, batch),
        system.across.contiguous(),
        system.down.contiguous(),
    )
    first = pull if start is None else start.contiguous()
    counts = _Counts(channels, 1, 1, solver.COARSEST_STEPS, steps, start is not None, local=False)
    unused = pull
    read = _Read(pull, weight, across, down, first, unused, unused, unused, unused)
    _launch(read, (field, unused, unused), counts)
    return field


def solve_robust(system: RobustSystem, rounds: int, steps: int, with_support: bool) -> RobustField:
    """``solver.solve_robust`` by the kernel."""
    data, trusted = system.data.contiguous(), system.trusted.contiguous()
    parts, (across, down) = len(data), (_of_batch(link, len(data)) for link in system.links)
    field, weights, *supports = trusted.new_empty(2 + with_support, *trusted.shape).unbind()
    support = supports[0] if with_support else None
    stiffness, inertia = (_of_batch(part, parts, axis=1) for part in (system.smoothness, system.inertia))
    noise, error, error_kind = system.noise.contiguous(), data, 0
    if system.error is not None:
        error = _of_batch(system.error, parts)
        error_kind = 1 if error.shape[-2:] == (1, 1) else 2
    read = _Read(data, trusted, across, down, data, noise, error, stiffness, inertia)
    local, channels = stiffness.shape[-2:] != (1, 1), 1 + with_support
    counts = _Counts(channels, len(stiffness), rounds, solver.COARSEST_STEPS, steps, False, local, error_kind)
    _launch(read, (field, weights if support is None else support, weights), counts, system.reach)
    return RobustField(field, weights, support)
