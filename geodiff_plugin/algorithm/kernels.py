"""Triton kernel of the pyramid solver, whose reference is ``algorithm.solver.solve_field``.

One launch makes a coarser grid, and one makes all conjugate-gradient steps of a grid. Between the steps
all programs of the launch wait for each other, so all of them must be on the device at the same time: it is
launched as a cooperative grid, which CUDA refuses where they do not fit, and never with more programs than
the bound on registers admits.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from geodiff_plugin._kernels import launched_on
from geodiff_plugin.algorithm import solver
from geodiff_plugin.algorithm.solver import FieldSystem

#: Pixels of a tile, of grids of many tiles.
TILE = 512
#: Warps of a program that solves one of them.
WARPS = 8
#: Pixels of the one tile of a grid that a program solves by itself.
SINGLE_TILE = 1024
#: Warps of that program.
SINGLE_WARPS = 8
#: Registers of a thread at most, and programs that a multiprocessor of 65,536 registers then holds.
MOST_REGISTERS = 80
RESIDENT = 65_536 // (MOST_REGISTERS * 32 * WARPS)
#: Registers of a thread at most, of the one program that solves a grid by itself.
SINGLE_REGISTERS = 168
#: The first iterate is zero.
FROM_ZEROS = 0
#: It is a field of the same grid.
FROM_FIELD = 1
#: It is a field of the next coarser grid.
FROM_COARSER = 2
#: Arrays of a field's size that the kernel works with.
WORK_ARRAYS = 6
#: Sums that it keeps of every tile.
SUMS = 3
#: Counters and tensors begin at multiples of so many numbers: kernels are compiled for aligned addresses.
ALIGNED = 4
#: Partial sums that are added at a time.
GATHERED = tl.constexpr(256)
#: As ``tiny`` of the reference: a channel that has converged stays where it is.
TINY = tl.constexpr(1e-20)

_SIZES = ["height", "width", "coarse_height", "coarse_width", "channels", "fields", "steps", "origin"]


@triton.jit(do_not_specialize=_SIZES[:5])
def coarsen_kernel(
    weight, pull, across, down, weight_2, pull_2, across_2, down_2,
    height, width, coarse_height, coarse_width, channels,
    TILE: tl.constexpr,
):  # fmt: skip
    """``FieldSystem.coarser``: a program makes a tile of the coarse grid, of one channel."""
    cell = tl.program_id(0) * TILE + tl.arange(0, TILE)
    field = tl.program_id(1)
    sample = field // channels
    row, column = cell // coarse_width, cell % coarse_width
    y, x = 2 * row, 2 * column
    inside = cell < coarse_height * coarse_width
    below, beside = inside & (y + 1 < height), inside & (x + 1 < width)
    both = below & beside
    at = field * height * width + y * width + x
    total = tl.load(pull + at, inside, 0.0) + tl.load(pull + at + 1, beside, 0.0)
    total += tl.load(pull + at + width, below, 0.0) + tl.load(pull + at + width + 1, both, 0.0)
    tl.store(pull_2 + field * coarse_height * coarse_width + cell, total, inside)
    if field % channels == 0:  # weight and links are shared by the channels
        at = sample * height * width + y * width + x
        total = tl.load(weight + at, inside, 0.0) + tl.load(weight + at + 1, beside, 0.0)
        total += tl.load(weight + at + width, below, 0.0) + tl.load(weight + at + width + 1, both, 0.0)
        tl.store(weight_2 + sample * coarse_height * coarse_width + cell, total, inside)
        # From a coarse column to the next: the fine link behind column x + 1, in both rows of the cell.
        linked = inside & (column + 1 < coarse_width)
        at = sample * height * (width - 1) + y * (width - 1) + x + 1
        total = tl.load(across + at, linked, 0.0) + tl.load(across + at + width - 1, linked & below, 0.0)
        at = sample * coarse_height * (coarse_width - 1) + row * (coarse_width - 1) + column
        tl.store(across_2 + at, 0.5 * total, linked)
        linked = inside & (row + 1 < coarse_height)
        at = sample * (height - 1) * width + (y + 1) * width + x
        total = tl.load(down + at, linked, 0.0) + tl.load(down + at + 1, linked & beside, 0.0)
        at = sample * (coarse_height - 1) * coarse_width + cell
        tl.store(down_2 + at, 0.5 * total, linked)


@triton.jit
def _meet(arrivals, expected, ALONE: tl.constexpr):
    """Wait until all programs have arrived ``expected / programs`` times, and see what they have stored."""
    tl.debug_barrier()
    if not ALONE:
        tl.atomic_add(arrivals, 1, sem="release", scope="gpu")
        while tl.atomic_add(arrivals, 0, sem="acquire", scope="gpu") < expected:
            pass
        tl.debug_barrier()


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
    y1, x1 = tl.minimum(y0 + 1, height - 1), tl.minimum(x0 + 1, width - 1)
    down, right = row - y0.to(tl.float32), column - x0.to(tl.float32)
    upper = (1.0 - right) * tl.load(coarse + y0 * width + x0, inside, 0.0)
    upper += right * tl.load(coarse + y0 * width + x1, inside, 0.0)
    lower = (1.0 - right) * tl.load(coarse + y1 * width + x0, inside, 0.0)
    lower += right * tl.load(coarse + y1 * width + x1, inside, 0.0)
    return (1.0 - down) * upper + down * lower


@triton.jit
def _neighbours(p, n, width):
    """Which pixels of a grid have one on the left, on the right, above and below."""
    inside, column = p < n, p % width
    return inside & (column > 0), inside & (column < width - 1), inside & (p >= width), p < n - width


@triton.jit
def _row_of_matrix(weight, across, down, sample, p, n, height, width):
    """The system at pixels: its diagonal, and the links to the left, to the right, up and down."""
    left, right, upper, lower = _neighbours(p, n, width)
    beside = across + sample * (n - height) + p - p // width
    below = down + sample * (n - width) + p
    to_left, to_right = tl.load(beside - 1, left, 0.0), tl.load(beside, right, 0.0)
    to_upper, to_lower = tl.load(below - width, upper, 0.0), tl.load(below, lower, 0.0)
    links = to_left + to_right + to_upper + to_lower
    return tl.load(weight + sample * n + p, p < n, 1.0) + links, to_left, to_right, to_upper, to_lower


@triton.jit
def _start_tile(start, x, tile, tiles, n, width, coarse_height, coarse_width, origin, TILE: tl.constexpr):
    """The first iterate of a tile."""
    field, p = tile // tiles, (tile % tiles) * TILE + tl.arange(0, TILE)
    inside = p < n
    value = tl.zeros([TILE], tl.float32)
    if origin == 1:
        value = tl.load(start + field * n + p, inside, 0.0)
    if origin == 2:
        coarse = start + field * coarse_height * coarse_width
        value = _enlarged(coarse, p // width, p % width, inside, coarse_height, coarse_width)
    tl.store(x + field * n + p, value, inside)


@triton.jit
def _residual_tile(
    weight, pull, across, down, x, work, now, tile, tiles, n, height, width, channels, area,
    TILE: tl.constexpr,
):  # fmt: skip
    """The first residual of a tile, preconditioned as well, the inverse of the diagonal, and their sum."""
    field, p = tile // tiles, (tile % tiles) * TILE + tl.arange(0, TILE)
    inside, own = p < n, field * n + p
    left, right, upper, lower = _neighbours(p, n, width)
    diagonal, to_left, to_right, to_upper, to_lower = _row_of_matrix(
        weight, across, down, field // channels, p, n, height, width
    )
    at = x + own
    rest = tl.load(pull + own, inside, 0.0) - diagonal * tl.load(at, inside, 0.0, cache_modifier=".cg")
    rest += to_left * tl.load(at - 1, left, 0.0, cache_modifier=".cg")
    rest += to_right * tl.load(at + 1, right, 0.0, cache_modifier=".cg")
    rest += to_upper * tl.load(at - width, upper, 0.0, cache_modifier=".cg")
    rest += to_lower * tl.load(at + width, lower, 0.0, cache_modifier=".cg")
    tl.store(work + own, rest, inside)
    tl.store(work + area + own, rest / diagonal, inside)
    tl.store(work + 3 * area + own, 1.0 / diagonal, inside)
    tl.store(now + tile, tl.sum(tl.where(inside, rest * rest / diagonal, 0.0), 0))


@triton.jit
def _direction_at(scaled, old, p, inside, share, step):
    """The new direction at pixels: the preconditioned residual, and a share of the direction before."""
    here = tl.load(scaled + p, inside, 0.0, cache_modifier=".cg")
    return here + share * tl.load(old + p, inside & (step > 0), 0.0, cache_modifier=".cg")


@triton.jit
def _direction_tile(
    weight, across, down, work, partial, step, tile, tiles, count, n, height, width, channels, area,
    TILE: tl.constexpr,
):  # fmt: skip
    """The direction of a step in a tile, its image under the matrix, and the sum of their product."""
    field, p = tile // tiles, (tile % tiles) * TILE + tl.arange(0, TILE)
    inside, base = p < n, field * n
    left, right, upper, lower = _neighbours(p, n, width)
    diagonal, to_left, to_right, to_upper, to_lower = _row_of_matrix(
        weight, across, down, field // channels, p, n, height, width
    )
    share = _total(partial + (step % 2) * count + field * tiles, tiles)
    share /= tl.maximum(_total(partial + ((step + 1) % 2) * count + field * tiles, tiles), TINY)
    share = tl.where(step > 0, share, 0.0)  # there is no step before the first
    # The direction of the step before is read by other programs while the new one is written.
    z, old = work + area + base, work + (5 - step % 2) * area + base
    here = _direction_at(z, old, p, inside, share, step)
    value = diagonal * here
    value -= to_left * _direction_at(z, old, p - 1, left, share, step)
    value -= to_right * _direction_at(z, old, p + 1, right, share, step)
    value -= to_upper * _direction_at(z, old, p - width, upper, share, step)
    value -= to_lower * _direction_at(z, old, p + width, lower, share, step)
    tl.store(work + (4 + step % 2) * area + base + p, here, inside)
    tl.store(work + 2 * area + base + p, value, inside)
    tl.store(partial + 2 * count + tile, tl.sum(tl.where(inside, here * value, 0.0), 0))


@triton.jit
def _update_tile(x, work, partial, step, tile, tiles, count, n, area, TILE: tl.constexpr):
    """Iterate and residual of a tile after the step along its direction, and the residual's sum."""
    field, p = tile // tiles, (tile % tiles) * TILE + tl.arange(0, TILE)
    inside, own = p < n, field * n + p
    length = _total(partial + (step % 2) * count + field * tiles, tiles)
    length /= tl.maximum(_total(partial + 2 * count + field * tiles, tiles), TINY)
    moved = tl.load(x + own, inside, 0.0, cache_modifier=".cg")
    moved += length * tl.load(work + (4 + step % 2) * area + own, inside, 0.0, cache_modifier=".cg")
    rest = tl.load(work + own, inside, 0.0, cache_modifier=".cg")
    rest -= length * tl.load(work + 2 * area + own, inside, 0.0, cache_modifier=".cg")
    z = rest * tl.load(work + 3 * area + own, inside, 0.0, cache_modifier=".cg")
    tl.store(x + own, moved, inside)
    tl.store(work + own, rest, inside)
    tl.store(work + area + own, z, inside)
    tl.store(partial + ((step + 1) % 2) * count + tile, tl.sum(tl.where(inside, rest * z, 0.0), 0))


@triton.jit(do_not_specialize=_SIZES)
def conjugate_gradients_kernel(
    weight, pull, across, down, start, x, work, partial, arrivals,
    height, width, coarse_height, coarse_width, channels, fields, steps, origin,
    TILE: tl.constexpr, ALONE: tl.constexpr,
):  # fmt: skip
    """All steps on one grid; the programs share the tiles of all ``fields``, ``B * C`` of them.

    With ``ALONE`` a field is one tile and has a program of its own; otherwise all programs meet twice a step.
    ``work`` holds residual, preconditioned residual, image of the direction, inverse of the diagonal, and the
    directions of even and of odd steps; ``partial`` one sum a tile: the residual's of even and of odd steps,
    and that of a direction with its image.
    """
    first, programs, n = tl.program_id(0), tl.num_programs(0), height * width
    tiles = tl.cdiv(n, TILE)
    count, area = tiles * fields, n * fields
    for tile in range(first, count, programs):
        _start_tile(start, x, tile, tiles, n, width, coarse_height, coarse_width, origin, TILE)
    expected = programs
    _meet(arrivals, expected, ALONE)
    for tile in range(first, count, programs):
        _residual_tile(
            weight, pull, across, down, x, work, partial, tile, tiles, n, height, width, channels, area, TILE
        )
    expected += programs
    _meet(arrivals, expected, ALONE)
    for step in range(steps):
        for tile in range(first, count, programs):
            _direction_tile(
                weight, across, down, work, partial, step, tile, tiles, count, n, height, width, channels,
                area, TILE,
            )  # fmt: skip
        expected += programs
        _meet(arrivals, expected, ALONE)
        for tile in range(first, count, programs):
            _update_tile(x, work, partial, step, tile, tiles, count, n, area, TILE)
        expected += programs
        _meet(arrivals, expected, ALONE)


@functools.cache
def _most_programs(device: torch.device) -> int:
    """Programs of a grid of many tiles that a device holds at the same time; in the interpreter one runs."""
    if device.type != "cuda":
        return 1
    return RESIDENT * torch.cuda.get_device_properties(device).multi_processor_count


def _empty(like: Tensor, *shapes: tuple[int, ...]) -> list[Tensor]:
    """Tensors in one allocation, each of which begins at an address that a kernel is compiled for once."""
    begins = list(itertools.accumulate((_aligned(math.prod(shape)) for shape in shapes), initial=0))
    buffer = like.new_empty(begins[-1])
    return [buffer.as_strided(s, _strides(s), first) for s, first in zip(shapes, begins, strict=False)]


def _aligned(count: int) -> int:
    return -(-count // ALIGNED) * ALIGNED


def _strides(shape: tuple[int, ...]) -> list[int]:
    """Of a contiguous tensor."""
    return [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]


class _Grid(NamedTuple):
    """One grid of the pyramid: its system, and what the steps on it write."""

    system: FieldSystem
    x: Tensor  # (B, C, H, W) the field
    work: Tensor
    partial: Tensor  # sums of every tile


def _is_alone(n: int) -> bool:
    """Whether a field of so many pixels is one tile, whose program meets no other."""
    return n <= SINGLE_TILE


def _tiles(shape: Sequence[int]) -> int:
    """Tiles of all fields ``(B, C, H, W)``."""
    n = shape[2] * shape[3]
    return triton.cdiv(n, SINGLE_TILE if _is_alone(n) else TILE) * shape[0] * shape[1]


def _grids(finest: FieldSystem, coarser: bool) -> list[_Grid]:
    """The pyramid from the finest grid on, in one allocation; that grid alone if not ``coarser``."""
    batch, channels, height, width = finest.pull.shape
    sizes = [(height, width)]
    while coarser and min(sizes[-1]) > solver.COARSEST_SIDE:
        sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
    shapes = list[tuple[int, ...]]()
    for h, w in sizes:
        fields = (batch, channels, h, w)
        shapes += [fields, (WORK_ARRAYS * math.prod(fields),), (SUMS * _tiles(fields),)]
    for h, w in sizes[1:]:
        shapes += [(batch, 1, h, w), (batch, channels, h, w), (batch, 1, h, w - 1), (batch, 1, h - 1, w)]
    tensors = iter(_empty(finest.pull, *shapes))
    written = [tuple(itertools.islice(tensors, 3)) for _ in sizes]
    systems = [finest, *(FieldSystem(*itertools.islice(tensors, 4)) for _ in sizes[1:])]
    for fine, coarse in itertools.pairwise(systems):
        _coarsen(fine, coarse)
    return [_Grid(system, *tensors) for system, tensors in zip(systems, written, strict=True)]


def _coarsen(system: FieldSystem, coarse: FieldSystem) -> None:
    """Write ``FieldSystem.coarser`` of tensors that are contiguous."""
    batch, channels, height, width = system.pull.shape
    h, w = coarse.pull.shape[-2:]
    launched_on(system.pull, coarsen_kernel[(triton.cdiv(h * w, TILE), batch * channels)])(
        *vars(system).values(), *vars(coarse).values(), height, width, h, w, channels, TILE=TILE
    )


def _conjugate_gradients(grid: _Grid, start: Tensor | None, steps: int, arrivals: Tensor) -> Tensor:
    """The field after all steps; ``start`` is of this grid, or of the next coarser one."""
    system = grid.system
    batch, channels, height, width = system.pull.shape
    if start is None:
        origin, start = FROM_ZEROS, system.pull
    else:
        origin = FROM_FIELD if start.shape[-2:] == system.pull.shape[-2:] else FROM_COARSER
    fields, alone = batch * channels, _is_alone(height * width)
    tile, warps = (SINGLE_TILE, SINGLE_WARPS) if alone else (TILE, WARPS)
    programs = fields if alone else min(_tiles(system.pull.shape), _most_programs(start.device))
    options = {"num_warps": warps}
    if start.is_cuda:  # the interpreter knows neither
        options |= {"maxnreg": SINGLE_REGISTERS if alone else MOST_REGISTERS}
        options |= {} if alone else {"launch_cooperative_grid": True}
    launched_on(start, conjugate_gradients_kernel[(programs,)])(
        *vars(system).values(), start, grid.x, grid.work, grid.partial, arrivals,
        height, width, *start.shape[-2:], channels, fields, steps, origin,
        TILE=tile, ALONE=alone, **options,
    )  # fmt: skip
    return grid.x


def _of_batch(part: Tensor, pull: Tensor) -> Tensor:
    """A part of a system, contiguous, with as many samples as ``pull``."""
    return (part if len(part) == len(pull) else part.expand(len(pull), -1, -1, -1)).contiguous()


def solve_field(system: FieldSystem, steps: int, start: Tensor | None) -> Tensor:
    """``solver.solve_field`` by kernels: the same steps on the same grids."""
    finest = FieldSystem(*(_of_batch(part, system.pull) for part in vars(system).values()))
    grids = _grids(finest, coarser=start is None)
    arrivals = torch.zeros(len(grids), ALIGNED, dtype=torch.int32, device=system.pull.device)
    field = None if start is None else start.contiguous()
    for grid, counter in zip(reversed(grids), arrivals, strict=True):
        field = _conjugate_gradients(grid, field, solver.COARSEST_STEPS if field is None else steps, counter)
    assert field is not None  # there is one level at least
    return field
