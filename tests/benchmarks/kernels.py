"""Registers and spills of every Triton kernel, compiled without a card.

    python -m tests.benchmarks.kernels

Data flow: kernel, types of its arguments and constants -> machine code by Triton -> a table on standard
output. The command fails if a kernel spills registers, or if programs that
wait for each other would not all be resident at the same time.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from geodiff_plugin.algorithm.kernels import edges, match_fitting, solver
from geodiff_plugin.cli.terminal import new_table, show
from geodiff_plugin.matching.census import MARGIN_PX, SIDE, VOTE_LEVELS
from geodiff_plugin.matching.constants import EVERY_ROW
from geodiff_plugin.matching.kernels import aggregation, consistency, sweep, winner
from geodiff_plugin.matching.kernels import reflections as reflection
from geodiff_plugin.matching.kernels import windows as window
from geodiff_plugin.result.kernels import confidence, median, planar, reprojection
from geodiff_plugin.runtime.kernels import group_norm
from geodiff_plugin.scale.constants import BASIN_CANDIDATES, KERNEL_FORMS
from geodiff_plugin.scale.kernels import points, search, space
from geodiff_plugin.trust.kernels import match_statistics as statistics

#: Compute capabilities of an A100, of an H100 and of GeForce RTX 50.
ARCHITECTURES = (80, 90, 120)
#: Registers of a multiprocessor, on all of these.
REGISTERS = 65_536
_CUOBJDUMP = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"


@dataclass(frozen=True)
class Compiled:
    """A kernel as some stage launches it."""

    name: str
    kernel: Any
    types: str  # of the arguments that are not constants, as Triton writes them
    constants: dict[str, Any]
    warps: int
    options: dict[str, Any] = field(default_factory=dict)  # further ones of the launch
    resident: int = 0  # programs that must fit a multiprocessor, because they wait for each other


def launches() -> Iterator[Compiled]:
    """Every kernel, at the largest sizes that are usual."""
    yield from _of_the_matching()
    yield from _of_the_matches()
    yield from _of_the_solver()
    yield from _of_the_fit()
    yield from _of_the_flattening()
    yield from _of_the_networks()
    yield from _of_the_scale()
    yield from _of_the_result()
    yield from _of_the_photometric_error()


def _of_the_matching() -> Iterator[Compiled]:
    paths = "*u8 *i16 *i32 i32 i32 i32 i32 i32 i32 i32"
    for planes in (128, 256, 512, 1024, 2048, 4096):
        axes = {"DOWN": (1, 0, 1, 1), "ACROSS": (0, 1, 1, -1), "PADDED": planes}
        warps = aggregation.path_warps(planes)
        yield Compiled(f"paths, {planes} planes", aggregation.paths_kernel, paths, axes, warps)
    types = "*i32 *u8 *i1 *fp32 *fp32 *fp32 *fp32 *fp32" + 9 * " i32"
    for evidence, padded in ((True, 128), (False, 128), (True, 4096)):
        sizes = {"EVIDENCE": evidence, "BLOCK": max(1, 1024 // padded), "PADDED": padded}
        name = f"winner{' and evidence' if evidence else ''}, {padded} planes"
        yield Compiled(name, winner.winner_kernel, types, sizes, 4)
    block = dict(zip(("BLOCK", "PLANES"), sweep.COST_BLOCK, strict=True))
    census = {"SIDE": SIDE, "MARGIN": MARGIN_PX, "VOTE": VOTE_LEVELS}
    types = "*i16 *i16 *i32 *i32 *i1 *u8 *i1" + 8 * " i32"
    sizes = census | block | {"HAS_VALID": True}
    yield Compiled("sweep", sweep.census_cost_kernel, types, sizes, 4)
    look_up = "*u8 *i32 *u8" + 9 * " i32"
    yield Compiled("costs of a right view", consistency.look_up_kernel, look_up, block, 4)
    exact = {"enable_fp_fusion": False}
    pixels: dict[str, Any] = {"BLOCK": sweep.PIXELS}
    resample = "*fp32 *fp32 *i16" + 6 * " i32"
    yield Compiled("shifted right views", sweep.resample_kernel, resample, pixels, 4, exact)
    axes = {"DOWN": (1, 0), "ACROSS": (0, 1)}
    penalties = "*fp32 *i16 i32 i32 i32"
    yield Compiled("penalties", aggregation.penalties_kernel, penalties, axes | pixels, 4, exact)
    weigh = 7 * "*fp32 " + "*i1 *fp32" + 8 * " i32" + 3 * " fp32"
    sizes = pixels | {"FIRST": False, "HAS_VALID": True, "EVERY_ROW": EVERY_ROW}
    yield Compiled("evidence of a right view", consistency.assess_kernel, weigh, sizes, 4, exact)


def _of_the_matches() -> Iterator[Compiled]:
    block = {"BLOCK": reflection.BLOCK}
    yield Compiled("distance behind a map", reflection.behind_kernel, 5 * "*fp32 " + "i32", block, 4)
    yield Compiled("spread of matches", reflection.spread_kernel, "*fp32 *fp32 i32", {}, 1)
    rows = 4 * "*fp32 " + 3 * "i32 "
    yield Compiled("sums of rows", reflection.rows_kernel, rows, block, 4)
    remaining = 5 * "*fp32 " + 4 * "i32 "
    yield Compiled("what remains of matches", reflection.remaining_kernel, remaining, block, 4)
    tile = dict(zip(("ROWS", "COLUMNS"), window.TILE, strict=True))
    yield Compiled("what matches know", window.known_kernel, 3 * "*fp32 " + "i32 i32", tile, 4)
    hidden = 3 * "*fp32 " + "*i1 " + 4 * "*fp32 " + "i32 i32"
    yield Compiled("hidden strips", window.occlusion_kernel, hidden, tile, 4)
    yield Compiled("grounds", confidence.features_kernel, 7 * "*fp32 " + "i32 i32", tile, 4)
    marked = 6 * "*fp32 " + "i32"
    yield Compiled("matches to sort", statistics.marked_kernel, marked, {"BLOCK": statistics.BLOCK}, 4)
    yield Compiled("numbers of matches", statistics.numbers_kernel, 4 * "*fp32 " + "i32", {}, 1)


def _of_the_networks() -> Iterator[Compiled]:
    sizes = {"BLOCK": group_norm.BLOCK}
    yield Compiled("group norm, moments", group_norm.moments_kernel, "*bf16 *fp32 i32 i32 i32", sizes, 4)
    norm = "*bf16 *bf16 *fp32 *bf16 *bf16" + 6 * " i32" + " fp32"
    sizes = sizes | {"PARTS": group_norm.MAX_PARTS}
    yield Compiled("group norm", group_norm.normalize_kernel, norm, sizes, 4)


def _of_the_result() -> Iterator[Compiled]:
    sizes = {"CHANNELS": 3, "BLOCK": edges.BLOCK, "PADDED": edges.PADDED}
    sharpen, warps = "*fp32 *fp32 *fp32 i32 i32 i32", edges.WARPS
    yield Compiled("sharp edges", edges.sharpen_kernel, sharpen, sizes, warps)
    sizes = {"CHANNELS": 3, "BLOCK": median.BLOCK, "VALUES": median.VALUES}
    vote = 11 * "*fp32 " + "fp32 fp32 i32 i32"
    enlarge, around = (
        4 * "*fp32 " + 4 * "i32 ",
        {"CHANNELS": 3, "BLOCK": median.BLOCK, "AROUND": median.AROUND},
    )
    yield Compiled("enlarged votes", median.upsample_kernel, enlarge, around, 4)
    fraction = "*fp32 *fp32 i32 i32"
    yield Compiled("crispness", median.fraction_kernel, fraction, {"PIXELS": median.PIXELS}, median.WARPS)
    yield Compiled("votes", median.vote_kernel, vote, sizes, median.WARPS)
    sizes = {"BLOCK": median.BLOCK, "IN_MEDIAN": median.IN_MEDIAN}
    signature = "*fp32 *fp32 *fp32 *fp32 *fp32 i32 i32"
    yield Compiled("median of votes", median.median_kernel, signature, sizes, median.WARPS)
    sizes = {"SPREAD": True, "PRIOR": 2, "PIXELS": confidence.PIXELS}
    types = 7 * "*fp32 " + "i32"
    yield Compiled("confidence", confidence.confidence_kernel, types, sizes, 4)
    sizes = {"CHANNELS": 3, "PIXELS": reprojection.PIXELS}
    yield Compiled("warp", reprojection.warp_kernel, "*fp32 *fp32 *fp32 *fp32 *i1 i32 i32 i32 i32", sizes, 4)


def _of_the_photometric_error() -> Iterator[Compiled]:
    images, sizes = "*fp32 *fp32 *i1 ", {"CHANNELS": 3, "PIXELS": reprojection.PIXELS}
    yield Compiled("exposure, sums", reprojection.sums_kernel, images + "*fp32 i32", sizes, 4)
    yield Compiled("exposure, squares", reprojection.squares_kernel, images + "*fp32 *fp32 i32", sizes, 4)
    cells = images + "*fp32 *fp32 *fp32 i32 i32"
    yield Compiled("exposure, cells", reprojection.cells_kernel, cells, sizes, 4)
    error = 6 * "*fp32 " + "i32 i32"
    yield Compiled("photometric error", reprojection.error_kernel, error, sizes, 4)


def _of_the_scale() -> Iterator[Compiled]:
    refine = "*fp32 *i64 " + 7 * "*fp32 " + 7 * "i32 "
    for block in (1024, 16384):
        sizes = {"FORM": KERNEL_FORMS["depth"], "BLOCK": block, "CHUNK": points.CHUNK}
        yield Compiled(
            f"refinement, {block} matches", points.refine_kernel, refine, sizes, points.warps(block)
        )

    sizes = {"MODE": space.RELATIVE, "FORM": KERNEL_FORMS["log1p"], "CLIPPED": False, "RAW": True}
    sizes |= {"PIXELS": space.PIXELS}
    yield Compiled("metric and relative maps", space.map_kernel, 5 * "*fp32 " + "i32", sizes, 4)
    sizes = {"FORM": KERNEL_FORMS["depth"], "CLIPPED": False, "GRID": BASIN_CANDIDATES, "BLOCK": search.BLOCK}
    basin = "*fp32 *i64 " + 8 * "*fp32 " + 7 * "i32 "
    yield Compiled("search by points", search.basin_kernel, basin, sizes, 4)
    sizes = {"PIXELS": search.GROUPED_PIXELS, "PLANES": search.GROUPED_PLANES}
    group = "*u8 *i1 *fp32 *i64 *i64 " + 4 * "*fp32 " + 11 * "i32 "
    yield Compiled("groups of the search", search.group_kernel, group, sizes, 4)
    sizes = {"FORM": KERNEL_FORMS["depth"], "PADDED": search.PADDED, "BLOCK": search.BLOCK}
    level = 12 * "*fp32 " + "i32 i32 i32 fp32 fp32 fp32 fp32 fp32 fp32 i32 i32 i32"
    yield Compiled("search in a volume", search.level_kernel, level, sizes, 4)
    choose = "*fp32 *fp32 *fp32 *fp32 fp32 fp32 i32 i32"
    yield Compiled("best candidate", search.choose_kernel, choose, {"PADDED": search.PADDED}, 4)


def _of_the_solver() -> Iterator[Compiled]:
    solve = 13 * "*fp32 " + "*i32 fp32" + 13 * " i32"
    options = {"maxnreg": solver.MAX_REGISTERS, "launch_cooperative_grid": True}
    for robust, name in ((False, "fields"), (True, "robust fields")):
        sizes = {"ROBUST": robust, "TILE": solver.TILE, "ALONE": solver.ALONE}
        many = solve, sizes, solver.WARPS, options, solver.RESIDENT
        yield Compiled(name, solver.solve_kernel, *many)


def _of_the_fit() -> Iterator[Compiled]:
    block: dict[str, Any] = {"BLOCK": match_fitting.BLOCK}
    affinities = 4 * "*fp32 " + "i32 i32 fp32"
    yield Compiled("links", match_fitting.affinities_kernel, affinities, block | {"CHANNELS": 3}, 4)
    observe = 7 * "*fp32 " + "i32 i32 fp32"
    yield Compiled("residuals of matches", match_fitting.observe_kernel, observe, block, 4)
    sizes = {"CHUNK": match_fitting.CHUNK}
    spread = 5 * "*fp32 " + "i32 i32"
    yield Compiled(
        "spread of residuals", match_fitting.spread_kernel, spread, sizes, match_fitting.SPREAD_WARPS
    )
    yield Compiled("levels of a fit", match_fitting.levels_kernel, "*fp32 *fp32 *fp32 i32 fp32", block, 4)
    off_edges = 4 * "*fp32 " + 4 * "i32 "
    yield Compiled("matches off edges", match_fitting.off_edges_kernel, off_edges, block, 4)


def _of_the_flattening() -> Iterator[Compiled]:
    block = {"BLOCK": planar.BLOCK}
    tile = dict(zip(("ROWS", "COLUMNS"), window.TILE, strict=True))
    yield Compiled("known shape", planar.known_kernel, 10 * "*fp32 " + "i32 i32", tile, 4)
    yield Compiled("slopes", planar.slopes_kernel, 6 * "*fp32 " + "i32 i32", block, 4)
    yield Compiled("pull of the slopes", planar.forces_kernel, 5 * "*fp32 " + "i32 i32", block, 4)


def resources(launch: Compiled, architecture: int) -> tuple[int, int]:
    """Registers of a thread, and bytes that it spills."""
    names = [name for name in launch.kernel.arg_names if name not in launch.constants]
    types = dict(zip(names, launch.types.split(), strict=True))
    signature = {name: types.get(name, "constexpr") for name in launch.kernel.arg_names}
    source = ASTSource(launch.kernel, signature, launch.constants)
    target = GPUTarget("cuda", architecture, 32)
    options = {"num_warps": launch.warps} | launch.options
    cubin = triton.compile(source, target=target, options=options).asm["cubin"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "kernel.cubin"
        file.write_bytes(cubin)
        command = [str(_CUOBJDUMP), "--dump-resource-usage", str(file)]
        reported = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    used = {name: int(count) for name, count in re.findall(r"(\w+):(\d+)", reported)}
    return used["REG"], used["STACK"] + used["LOCAL"]


def main() -> None:
    """Print the table."""
    columns = [f"sm_{each}: registers, spilled bytes" for each in ARCHITECTURES]
    table, spilling, crowded = new_table(("kernel", "warps", *columns)), [], []
    for launch in launches():
        found = [resources(launch, architecture) for architecture in ARCHITECTURES]
        table.add_row(launch.name, str(launch.warps), *(f"{used}, {spilled}" for used, spilled in found))
        if any(spilled for _, spilled in found):
            spilling.append(launch.name)
        if any(used * 32 * launch.warps * launch.resident > REGISTERS for used, _ in found):
            crowded.append(launch.name)
    show(table)
    if spilling:
        raise SystemExit(f"These kernels spill registers: {', '.join(spilling)}.")
    if crowded:
        raise SystemExit(f"Programs of these kernels would wait for others forever: {', '.join(crowded)}.")


if __name__ == "__main__":
    main()
