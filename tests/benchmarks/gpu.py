"""Cost of guidance on a GPU, in one run of about four minutes: ``python -m tests.benchmarks.gpu``.

Data flow: the demo pair, Marigold v1-1's size with random weights, the bundled prior -> a table per part,
    and all of them as JSON (``--json FILE``).
Paper: S5.4 (cost).

It needs a checkout, its dependencies and no network. If a part fails, its error is printed and the others
continue. ``--smoke`` runs at a tiny size on any machine; its numbers are meaningless.
"""

from __future__ import annotations

import argparse
import faulthandler
import functools
import gc
import itertools
import json
import os
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from diffusers.utils import logging as diffusers_logging
from PIL import Image

from geodiff_plugin._internal.kernels import has_triton, without_kernels
from geodiff_plugin.bundled import load_bundled_prior
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, DemoPair, read_demo_pair
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.runtime.graphs import FasterNetworks
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.runtime.machine import timed
from tests.benchmarks import full_sizes
from tests.benchmarks.cost import resized_pair
from tests.benchmarks.measuring import Cost, costs, stage_milliseconds, waits_by_place
from tests.benchmarks.operations import MARIGOLD_DC, WAYS, Size, call_of, tiny_folder
from tests.benchmarks.random_marigold import drawn_on, narrowed, random_marigold

__all__ = ["PARTS", "Bench", "Scope", "main"]

#: Seconds after which no part begins, and how long the last one may still take before the process is ended:
#: a kernel that never returns cannot be interrupted otherwise.
BUDGET_S, GRACE_S = 210, 60
#: A function, or a method as ``Class.method``, and what it is a part of: indented below it.
STAGES = (
    "GeometryGuidance.plan_evidence",
    "  clean",
    "  fit_of_small",
    "  measure_fit",
    "  check_poses",
    "  build_cost_volume",
    "    sweep_planes",
    "  match_volume",
    "    aggregate",
    "  match_rows",
    "Trajectory.find_scale",
    "  search_scale",
    "  fit_to_points",
    "  refine_to_matches",
    "prior_error",
    "fit_depth",
    "GuidedRun.output",
    "  sharpen_edges",
    "  filter_depth",
    "  depth_confidence",
)
#: One cell of a row of a table.
Cell = str | float | int | None
Row = dict[str, Cell]


@dataclass(frozen=True)
class Scope:
    """How much is measured.

    Attributes:
        size: of the full-size prior; ``repeats`` is the number of timed rounds.
        published_steps: of Marigold-DC, whose loop is also run once as it was published.
        sides: longer sides of the large images, pixels.
        pairs: in the folder.
        presets: compared between CPU and device.
        device: where.
    """

    size: Size = Size(dc_steps=4, dtype="bfloat16", repeats=5)
    published_steps: int = 50
    sides: tuple[int, ...] = (2000, 4000)
    pairs: int = 12
    presets: tuple[str, ...] = ("default", "fast", "paper")
    device: torch.device = torch.device("cuda")


SMOKE = Scope(Size(0.05, 64, 1, 1, "float32", 1), 2, (480,), 1, ("fast",), torch.device("cpu"))


def _generator() -> torch.Generator:
    return torch.Generator("cpu").manual_seed(0)


def _guided(pipe: Any, pair: DemoPair, parameters: dict[str, Any] | None = None, **options: Any) -> Any:
    """A guided call on a pair, with its guidance made again, so that no evidence is there already."""
    cameras = (pair.rig.K_left, pair.rig.K_right), pair.rig.E
    guidance = GeometryGuidance(pair.right, *cameras, **parameters or {})
    return pipe(pair.left, guidance=guidance, generator=_generator(), **options)


def _plain(pipe: Any, pair: DemoPair, **options: Any) -> Any:
    return pipe(pair.left, generator=_generator(), **options)


def _referred(call: Callable[[], Any]) -> Callable[[], Any]:
    """The call without kernels."""

    def referred() -> Any:
        with without_kernels():
            return call()

    return referred


def _graphed(pipe: Any, call: Callable[[], Any], is_plain: bool) -> Callable[[], Any]:
    """The call with graphs and faster norms, which a plain call has only here, to be compared with."""
    faster = FasterNetworks(pipe)

    def graphed() -> Any:
        if is_plain:
            with torch.no_grad(), faster.attached(pipe):
                return call()
        with patch.object(pipe, "_faster", faster):
            return call()

    return graphed


def _difference(result: Any, reference: Any) -> tuple[float, float]:
    """Mean and largest relative difference of two depth maps."""
    relative = np.abs(result.prediction / reference.prediction - 1.0)
    return float(relative.mean()), float(relative.max())


class Bench:
    """What the parts share: the scope, the pair, and the full-size pipeline, made when a part first asks.

    Args:
        scope: how much is measured.
        folder: for files; there must be nothing in it.
        until: time of ``time.monotonic`` from which no further round begins.
    """

    def __init__(self, scope: Scope, folder: Path, until: float = float("inf")) -> None:
        self.scope, self.device, self.folder, self.until = scope, scope.device, folder, until
        self.pair, self.failed = read_demo_pair(), 0

    @functools.cached_property
    def pipe(self) -> Any:
        """Marigold v1-1's size, random weights, guidance enabled."""
        size = self.scope.size
        pipe = random_marigold(device=self.device, width=size.width, dtype=getattr(torch, size.dtype))
        pipe.set_progress_bar_config(disable=True)
        return enable_geometry_guidance(pipe)

    @functools.cached_property
    def tiny(self) -> str:
        """Folder of a tiny autoencoder."""
        return tiny_folder(str(self.folder), self.scope.size.width)

    @property
    def call(self) -> dict[str, Any]:
        """Arguments of a call of the full-size pipeline."""
        size = self.scope.size
        return {"processing_resolution": size.resolution, "num_inference_steps": size.steps}

    def bundled(self, device: torch.device | str) -> Any:
        """The bundled prior, guidance enabled."""
        pipe = enable_geometry_guidance(load_bundled_prior().to(device))
        pipe.set_progress_bar_config(disable=True)
        return pipe

    def rows(self, calls: dict[str, Callable[[], Any]]) -> Iterator[Row]:
        """The cost of every call, next to the cost of the call named "plain"."""
        found = costs(calls, self.device, self.scope.size.repeats, self.until)
        plain = found["plain"]
        for name, cost in found.items():
            if isinstance(cost, Cost):
                yield _row_of(name, cost, plain if isinstance(plain, Cost) else None)
            else:
                self.failed += 1
                yield {"call": name, "failed": f"{type(cost).__name__}: {cost}"}


def _row_of(name: str, cost: Cost, plain: Cost | None) -> Row:
    row: Row = {"call": name, "ms": round(cost.milliseconds, 2)}
    row["x plain"] = None if plain is None else round(cost.milliseconds / plain.milliseconds, 2)
    row["fastest, ms"] = round(cost.fastest_ms, 2)
    row["fastest x plain"] = None if plain is None else round(cost.fastest_ms / plain.fastest_ms, 2)
    row["peak MB"] = round(cost.peak_bytes / 1e6)
    is_known = plain is not None and plain.peak_bytes > 0  # a short call on a CPU has no sample of it
    row["x plain's MB"] = round(cost.peak_bytes / plain.peak_bytes, 2) if is_known else None
    seen = cost.traced
    row |= {"launches": seen and seen.launches, "waits": seen and seen.waits}
    return row | {"device busy ms": seen and round(seen.busy_ms, 1)}


def first_call(bench: Bench) -> Iterator[Row]:
    """The first guided call of a process, which compiles the kernels, and the second (bundled prior)."""
    pipe, cache = bench.bundled(bench.device), Path(os.environ["TRITON_CACHE_DIR"])
    # What torch and cuDNN load at their first use is not ours.
    timed(lambda: _plain(pipe, bench.pair), bench.device)
    timed(lambda: _referred(lambda: _guided(pipe, bench.pair))(), bench.device)
    was_empty = not (cache.is_dir() and any(cache.iterdir()))
    for name in ("first", "second"):
        seconds = timed(lambda: _guided(pipe, bench.pair), bench.device)
        yield {"call": name, "s": round(seconds, 3), "Triton's cache was empty": str(was_empty)}
        was_empty = False


def full_size(bench: Bench) -> Iterator[Row]:
    """Marigold v1-1's size: every way, with kernels and without, with graphs and without."""
    pipe, size = bench.pipe, bench.scope.size
    calls = {way: call_of(way, pipe, size, bench.tiny) for way in WAYS}
    calls[f"{MARIGOLD_DC}, {size.dc_steps} steps"] = calls.pop(MARIGOLD_DC)
    calls["guided, without kernels"] = _referred(calls["guided"])
    for way in ("plain", "guided", "guided, tiny decoder"):
        calls[f"{way}, graphs"] = _graphed(pipe, calls[way], way == "plain")
    yield from bench.rows(calls)
    published = call_of(MARIGOLD_DC, pipe, replace(size, dc_steps=bench.scope.published_steps), bench.tiny)
    seconds = timed(published, bench.device)
    yield {"once": f"{MARIGOLD_DC}, {bench.scope.published_steps} steps", "ms": round(1e3 * seconds, 1)}
    guided = calls["guided"]()
    for other in ("guided, without kernels", "guided, graphs"):
        mean, most = _difference(calls[other](), guided)
        yield {"relative difference": f"{other} from guided", "mean": mean, "maximum": most}


def stages(bench: Bench) -> Iterator[Row]:
    """Milliseconds of one guided call at full size by stage; the device is waited for around each."""
    pipe = bench.pipe
    networks = {"U-Net": (pipe.unet, "forward"), "VAE encode": (pipe.vae, "encode")}
    networks |= {"VAE decode": (pipe.vae, "decode")}
    call = functools.partial(_guided, pipe, bench.pair, **bench.call)
    call()
    found = stage_milliseconds(call, [stage.strip() for stage in STAGES], networks, bench.device)
    for label in (*STAGES, *networks):
        spent = found[label.strip()]
        if spent is None:
            bench.failed += 1
            yield {"stage": label, "failed": "the package has no function of this name"}
        else:
            yield {"stage": label, "ms": round(sum(spent), 2), "calls": len(spent)}


def waits(bench: Bench) -> Iterator[Row]:
    """Where the host waits for the device in one guided call at full size, most often first."""
    if bench.device.type != "cuda":
        yield {"place": "none: the host waits only for CUDA", "waits": None}
        return
    call = functools.partial(_guided, bench.pipe, bench.pair, **bench.call)
    plain = functools.partial(_plain, bench.pipe, bench.pair, **bench.call)
    yield {"place": "plain call, total", "waits": waits_by_place(plain).total()}
    found = waits_by_place(call)
    yield {"place": "guided call, total", "waits": found.total()}
    yield from ({"place": place, "waits": count} for place, count in found.most_common(30))


def bundled(bench: Bench) -> Iterator[Row]:
    """The bundled prior in float32; a plain call of it takes one step, a guided one four."""
    pipe = bench.bundled(bench.device)
    guided = functools.partial(_guided, pipe, bench.pair)
    calls = {"plain": functools.partial(_plain, pipe, bench.pair), "guided": guided}
    calls |= {"guided, graphs": _graphed(pipe, guided, is_plain=False)}
    yield from bench.rows(calls | {"guided, without kernels": _referred(guided)})


def equality(bench: Bench) -> Iterator[Row]:
    """Relative differences of the bundled prior's depth in float32 from that of the CPU without kernels."""
    here, there = bench.bundled("cpu"), bench.bundled(bench.device)
    for preset in bench.scope.presets:
        parameters = {"preset": preset}
        reference = _referred(functools.partial(_guided, here, bench.pair, parameters))()
        call = functools.partial(_guided, there, bench.pair, parameters)
        for name, made in (("as it is", call), ("without kernels", _referred(call))):
            mean, most = _difference(made(), reference)
            yield {"preset": preset, f"on {bench.device.type}": name, "mean": mean, "maximum": most}


def one_step(bench: Bench) -> Iterator[Row]:
    """Priors of one step at full size, with their text encoders."""
    width, size = bench.scope.size.width, bench.scope.size
    with ExitStack() as stack:
        if width < 1.0:
            for name in ("UNET", "VAE"):
                stack.enter_context(
                    patch.object(full_sizes, name, narrowed(getattr(full_sizes, name), width))
                )
            stack.enter_context(patch.dict(full_sizes.TEXT, {"num_hidden_layers": 1}))
        for key in ("e2e-ft", "lotus"):
            with drawn_on(bench.device):
                pipe = full_sizes.FULL_SIZES[key]()
            with torch.device("cpu"):  # diffusers keeps the tables of a schedule on the CPU
                pipe.scheduler = type(pipe.scheduler).from_config(pipe.scheduler.config)
            pipe = enable_geometry_guidance(pipe.to(bench.device, getattr(torch, size.dtype)))
            pipe.set_progress_bar_config(disable=True)
            options = {"processing_resolution": size.resolution}
            calls = {"plain": functools.partial(_plain, pipe, bench.pair, **options)}
            calls["guided"] = functools.partial(_guided, pipe, bench.pair, **options)
            yield from ({"prior": key, **row} for row in bench.rows(calls))
            del pipe, calls
            _release(bench.device)


def large(bench: Bench) -> Iterator[Row]:
    """Large images at the processing resolution of the others."""
    for side in bench.scope.sides:
        left, right, (K_left, K_right) = resized_pair(bench.pair, side)
        rig = replace(bench.pair.rig, K_left=K_left, K_right=K_right)
        pair = replace(bench.pair, left=left, right=right, rig=rig)
        calls = {
            name: functools.partial(call, bench.pipe, pair, **bench.call)
            for name, call in (("plain", _plain), ("guided", _guided))
        }
        megapixels = round(left.shape[0] * left.shape[1] / 1e6, 2)
        yield from ({"megapixels": megapixels, **row} for row in bench.rows(calls))


def folder(bench: Bench) -> Iterator[Row]:
    """Pairs a second of ``geodiff depth`` on a folder, graphs included, and of stock calls on its lefts."""
    from geodiff_plugin.jobs.options import DepthOptions  # and what the commands need, in this part alone
    from geodiff_plugin.jobs.prior import graphs_for_many
    from tests.benchmarks.many import ManyPairs

    where, size = bench.folder / "pairs", bench.scope.size
    for side in ("left", "right"):
        (where / side).mkdir(parents=True)
        rgb = (DEMO_PAIR_FOLDER / f"{side}.png").read_bytes()
        for i in range(bench.scope.pairs):
            (where / side / f"{i:03}.png").write_bytes(rgb)

    def plain() -> None:
        for path in sorted((where / "left").iterdir()):
            image = Image.open(path).convert("RGB")
            depth = bench.pipe(image, generator=_generator(), **bench.call).prediction
            np.save(where / f"{path.stem}.npy", depth)

    options = DepthOptions(
        left=where / "left",
        right=where / "right",
        calib=(DEMO_PAIR_FOLDER / "calib.txt",),
        steps=size.steps,
        resolution=size.resolution,
        device=str(bench.device),
        out=where / "out",
        overwrite=True,
        quiet=True,
    )
    enable_geometry_guidance(bench.pipe, graphs=graphs_for_many(options, bench.device))
    with closing(ManyPairs(options, bench.pipe)) as many:
        guided = functools.partial(many.seconds, None, True)
        calls = {"plain, with file I/O": plain, "guided, geodiff depth": guided}
        rounds = 3  # graphs are recorded at the second call of a size
        taken = {name: min(timed(call, bench.device) for _ in range(rounds)) for name, call in calls.items()}
    enable_geometry_guidance(bench.pipe, cuda_graphs=False)
    first = next(iter(taken.values()))
    for name, seconds in taken.items():
        rate = bench.scope.pairs / seconds
        yield {"call": name, "pairs/s": round(rate, 2), "of plain's": round(first / seconds, 2)}


#: Name -> part, in their order; the first must be first, as it measures a fresh process.
PARTS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "first-call": first_call,
    "full-size": full_size,
    "stages": stages,
    "waits": waits,
    "bundled": bundled,
    "one-step": one_step,
    "folder": folder,
    "large": large,
    "equality": equality,
}


def _release(device: torch.device) -> None:
    """Give memory of objects that are no longer used back to the device."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def _shown(cell: Cell) -> str:
    if cell is None:
        return "-"
    return f"{cell:.2e}" if isinstance(cell, float) and 0.0 < abs(cell) < 0.01 else str(cell)


def _print_part(name: str, about: str, rows: Sequence[Row]) -> None:
    """A table of aligned columns; rows of other columns begin another one."""
    print(f"\n{name}: {about}")
    for head, group in itertools.groupby(rows, key=tuple):
        table = [head, *(tuple(_shown(cell) for cell in row.values()) for row in group)]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        for first, *others in table:
            numbers = (cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True))
            print("  ".join([first.ljust(widths[0]), *numbers]))


def machine(device: torch.device) -> dict[str, Cell]:
    """What a reader needs to know of the machine."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    found: dict[str, Cell] = {"device": name, "torch": torch.__version__, "cores": os.cpu_count()}
    if has_triton():
        import triton

        found["triton"] = triton.__version__
    return found


def run(names: Sequence[str], bench: Bench, started: float, where: Path | None) -> dict[str, Any]:
    """Run parts and print them; ``where`` is written after each, so that what was measured is kept."""
    answer: dict[str, Any] = {"machine": machine(bench.device), "parts": {}}
    print(", ".join(f"{key} {value}" for key, value in answer["machine"].items()))
    for name in names:
        began, rows, about = time.monotonic(), [], (PARTS[name].__doc__ or "").split("\n")[0]
        if began > bench.until:
            print(f"\n{name}: left out, the {bench.until - started:.0f} seconds are over", flush=True)
            continue
        try:
            for row in PARTS[name](bench):
                rows.append(row)  # noqa: PERF402 -- what came before an error is kept
        except Exception as error:
            bench.failed += 1
            traceback.print_exc()
            rows.append({"failed": f"{type(error).__name__}: {error}"})
        _print_part(name, about, rows)
        seconds = time.monotonic() - began
        print(f"({seconds:.1f} s, {time.monotonic() - started:.0f} s in all)", flush=True)
        answer["parts"][name] = {"seconds": round(seconds, 1), "rows": rows}
        if where is not None:
            where.write_text(json.dumps(answer, indent=1) + "\n", encoding="utf-8")
        _release(bench.device)
    return answer


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; ``--help`` lists the options. 1 if something failed."""
    started = time.monotonic()
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all by default")
    parser.add_argument("--but", nargs="*", default=[], metavar="PART", help="parts to skip")
    parser.add_argument("--smoke", action="store_true", help="run at a tiny size on the CPU, as a test")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the tables as JSON")
    parser.add_argument("--repeats", type=int, help="number of timed rounds per comparison")
    parser.add_argument("--sides", type=int, nargs="+", help="longer sides of the large images in pixels")
    parser.add_argument("--budget", type=float, default=BUDGET_S, help="seconds after which no part starts")
    typed = parser.parse_args(arguments)
    if unknown := {*typed.parts, *typed.but} - set(PARTS):
        parser.error(f"parts are {', '.join(PARTS)}; not {', '.join(sorted(unknown))}")
    smoke = typed.smoke or not torch.cuda.is_available()
    if smoke and not typed.smoke:
        print("PyTorch finds no CUDA here: a tiny version runs on the CPU instead, whose times say nothing.")
    scope = SMOKE if smoke else Scope()
    if typed.repeats is not None:
        scope = replace(scope, size=replace(scope.size, repeats=typed.repeats))
    scope = scope if typed.sides is None else replace(scope, sides=tuple(typed.sides))
    diffusers_logging.set_verbosity_error()
    names = [name for name in typed.parts or PARTS if name not in typed.but]
    with tempfile.TemporaryDirectory() as parent, ExitStack() as stack:
        cache = os.environ.get("TRITON_CACHE_DIR", str(Path(parent) / "triton"))
        stack.enter_context(patch.dict(os.environ, {"TRITON_CACHE_DIR": cache, "HF_HUB_OFFLINE": "1"}))
        if not smoke:
            faulthandler.dump_traceback_later(typed.budget + GRACE_S, exit=True)
            stack.callback(faulthandler.cancel_dump_traceback_later)
        bench = Bench(scope, Path(parent), started + typed.budget)
        run(names, bench, started, typed.json)
    return 1 if bench.failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
