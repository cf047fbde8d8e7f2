"""A run over the frames of a capture: poses once, depth of every chosen frame, agreement, files."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers.utils import logging as of_diffusers
from transformers.utils import logging as of_transformers

from geodiff_plugin import __version__
from geodiff_plugin._checks import InputError, bad_value, check_choice, check_number
from geodiff_plugin._threads import available_cores
from geodiff_plugin.capture.capture import Capture
from geodiff_plugin.capture.options import CaptureOptions
from geodiff_plugin.capture.results import ALONE, write_agreement, write_results
from geodiff_plugin.capture.store import load_solved, save_solved
from geodiff_plugin.formats.files import read_matrix
from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.priors import load_prior
from geodiff_plugin.runner import BROKEN, Item, Journal, Runner, this_process
from geodiff_plugin.runtime.machine import pick_device
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance
from geodiff_plugin.types import MetricDepthOutput

__all__ = ["Writer", "open_capture", "run_capture", "run_frames", "solved_poses"]

#: Writes the files of one frame: folder, output, image ``(H, W, 3)`` -> counts for the report.
Writer = Callable[[Path, MetricDepthOutput, np.ndarray], dict[str, Any]]

POSES_FILE, SCALE_FILE, JOURNAL, REPORT = "poses.npz", "scale.json", "frames.jsonl", "report.json"
#: Memory that one process of the bundled prior takes at 640x480, bytes; what a larger prior takes is unknown.
PROCESS_BYTES = 1.5e9
#: Captures with more frames are told how long they will take.
MANY = 300


def open_capture(options: CaptureOptions) -> Capture:
    """The capture of the options, without poses solved."""
    K = None if options.k is None else read_matrix(options.k, "--K")
    capture = Capture.open(options.path, K=K, fov=options.fov, trajectory=options.trajectory)
    if options.poses == "given" and capture.poses is None:
        bad_value("--poses given", "used with a capture that has poses", f"{options.path} without")
    return capture


def _cores() -> int:
    return max(1, available_cores())


def solved_poses(capture: Capture, options: CaptureOptions) -> None:
    """Solve for the poses, or take those that an earlier run of the same capture left; then set the scale."""
    path = options.out / POSES_FILE
    key = options.key(capture.names, "poses", "k", "fov", "trajectory")
    solved = None if options.overwrite else load_solved(path, key)
    if solved is None:
        solved = capture.solve(options.poses, threads=_cores())
        save_solved(path, solved, key)
    capture.adopt(solved)
    factor = _factor(capture, options, key)
    if factor is not None:
        capture.rescale(factor)


def _factor(capture: Capture, options: CaptureOptions, key: str) -> float | None:
    """Metres per unit of the poses, by the one option that gives them; ``None`` without."""
    ways = [options.metres_per_unit, options.known_length, options.distance]
    if sum(way is not None for way in ways) > 1:
        bad_value("the scale", "given in one way", "more of --metres-per-unit, --known-length, --distance")
    if options.metres_per_unit is not None:
        return options.metres_per_unit
    if options.distance is not None:
        return _factor_of_pair(capture, options.distance)
    if options.known_length is None:
        return None
    path, asked = options.out / SCALE_FILE, f"{key} {options.known_length}"
    try:
        saved = json.loads(path.read_text(encoding="utf-8"))
        if saved["of"] == asked:
            return float(saved["metres_per_unit"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    factor = _factor_of_length(capture, options.known_length, options)
    _write_json(path, {"metres_per_unit": factor, "of": asked})
    return factor


def _factor_of_pair(capture: Capture, text: str) -> float:
    parts = [part.strip() for part in text.split(",")]
    metres = _positive(parts[-1], "--distance", text)
    if len(parts) != 3:
        bad_value("--distance", "NAME,NAME,METRES", repr(text))
    numbers = [capture.names.index(capture.frame(name).name) for name in parts[:2]]
    apart = float(np.linalg.norm(np.diff(capture.solve().E[numbers, :3, 3], axis=0)))
    if not apart > 0:
        bad_value("--distance", "of two frames with different positions", repr(text))
    return metres / apart


def _factor_of_length(capture: Capture, text: str, options: CaptureOptions) -> float:
    """The length of the scene at its depth in the poses' own unit, found by a call of that frame."""
    name, _, rest = text.rpartition(":")
    numbers = rest.split(",")
    if not name or len(numbers) != 5:
        bad_value("--known-length", "NAME:X1,Y1,X2,Y2,METRES", repr(text))
    metres = _positive(numbers[-1], "--known-length", text)
    frame = capture.frame(name)
    px = np.array([_number(n, "--known-length", text) for n in numbers[:4]]).reshape(2, 2)
    if not ((px >= 0) & (px <= np.array(frame.size) - 1)).all():
        bad_value("--known-length", f"pixels of {frame.size[0]}x{frame.size[1]}", repr(text))
    pipe = _pipe(options, pick_device(options.device))
    with torch.no_grad():
        depth = np.asarray(capture.depth(pipe, name, options.neighbours).prediction)[0, ..., 0]
    K = capture.solve().K[capture.names.index(name)]
    rays = np.linalg.solve(K, np.c_[px, np.ones(2)].T).T
    ends = rays * depth[tuple(np.rint(px).astype(int).T[::-1])][:, None]
    return metres / float(np.linalg.norm(ends[1] - ends[0]))


def _number(text: str, option: str, typed: str) -> float:
    try:
        return float(text)
    except ValueError:
        bad_value(option, "with numbers", repr(typed))


def _positive(text: str, option: str, typed: str) -> float:
    value = _number(text, option, typed)
    return value if 0 < value < math.inf else bad_value(option, "a length above 0", repr(typed))


def _pipe(options: CaptureOptions, device: torch.device) -> Any:
    bars = [library for library in (of_diffusers, of_transformers) if library.is_progress_bar_enabled()]
    for library in bars:
        library.disable_progress_bar()
    try:
        pipe = enable_geometry_guidance(load_prior(options.prior).to(device))
    finally:
        for library in bars:
            library.enable_progress_bar()
    pipe.set_progress_bar_config(disable=True)
    return pipe


#: What a process works with: the capture, the prior, the options, the writer.
_worker: tuple[Capture, Any, CaptureOptions, Writer] | None = None


def _frame(item: Item) -> dict[str, Any]:
    """One frame: its files, and its report."""
    assert _worker is not None
    capture, pipe, options, write = _worker
    name, started = item.key, time.perf_counter()
    neighbours = capture.neighbours(name, options.neighbours)
    call: dict[str, Any] = {} if options.steps is None else {"num_inference_steps": options.steps}
    with torch.no_grad():
        output = capture.depth(pipe, name, neighbours, seed=options.seed, points=options.points, **call)
    image = capture.image(name)
    report = frame_report(capture, name, neighbours, output)
    with _replacing(options.out / name) as folder:
        report["files"] = write(folder, output, image)
        depth = np.asarray(output.prediction)[0, ..., 0]
        sure = output.confidence
        confidence = np.full_like(depth, 0.5) if sure is None else np.asarray(sure)[0, ..., 0]
        for file, values in zip(ALONE, (depth, confidence), strict=True):
            np.save(folder / file, values.astype(np.float32))
        report["seconds"] = round(time.perf_counter() - started, 2)
        _write_json(folder / REPORT, report)
    return report


def frame_key(capture: Capture, options: CaptureOptions) -> str:
    """Of everything that a frame's depth depends on."""
    of = "poses neighbours points metres_per_unit known_length distance k fov trajectory prior steps seed"
    return options.key(capture.names, *of.split())


def frame_report(
    capture: Capture, name: str, neighbours: Sequence[str], output: MetricDepthOutput
) -> dict[str, Any]:
    """What ``report.json`` of a frame says."""
    solved, number = capture.solve(), capture.names.index(name)
    depth = np.asarray(output.prediction)[0, ..., 0]
    low, middle, high = (float(v) for v in np.percentile(depth, (2, 50, 98)))
    spread = solved.scale_spread
    return {
        "version": __version__,
        "frame": name,
        "neighbours": list(neighbours),
        "unit": output.unit,
        "K": np.asarray(output.K)[0].tolist(),
        "T_world_from_camera": solved.E[number].tolist(),
        "connected": bool(solved.connected[number]),
        "scale_spread": None if math.isnan(spread) else round(spread, 4),
        "depth": {"p02": low, "median": middle, "p98": high},
        "poses": [pose.status for pose in output.poses],
        "trusted": [bool(verdict.trusted) for verdict in output.verdicts],
        "warnings": list(output.warnings),
    }


class _replacing:  # noqa: N801
    """A folder filled beside its place, which it takes when the block ends well."""

    def __init__(self, target: Path) -> None:
        self.target = target
        self.folder = target.with_name(f".{target.name}.{os.getpid()}")

    def __enter__(self) -> Path:
        self.folder.mkdir(parents=True)
        return self.folder

    def __exit__(self, kind: Any, *_: object) -> None:
        if kind is None:
            shutil.rmtree(self.target, ignore_errors=True)
            os.replace(self.folder, self.target)
        else:
            shutil.rmtree(self.folder, ignore_errors=True)


def _write_json(path: Path, data: Any) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2) + "\n", encoding="utf-8")


def run_frames(
    capture: Capture, options: CaptureOptions, names: Sequence[str], write: Writer
) -> list[dict[str, Any]]:
    """Depth of every chosen frame that is not done yet, by one process a core.

    Args:
        capture: with its poses solved and saved by ``solved_poses``.
        options: of the run.
        names: of the frames.
        write: writes the files of a frame; a function of a module, as other processes import it.

    Returns:
        The reports in the order of the names; ``{"key", "status": "broken", "error"}`` of one that failed.

    Raises:
        InputError: every frame failed for one reason.
    """
    journal, items = _job(capture, options, names)
    if options.overwrite:
        for item in items:
            journal.forget(item)
    left = sum(journal.get(item) is None for item in items)
    on_cpu = pick_device(options.device).type == "cpu"
    wanted = options.processes or (min(_cores(), _memory_processes()) if on_cpu else 1)
    count = max(1, min(wanted, left)) if this_process().count == 1 else 1
    options = replace(options, processes=count)
    context = multiprocessing.get_context("spawn")
    helpers = [
        context.Process(target=_help, args=(options, names, write, index, count), daemon=True)
        for index in range(1, count)
    ]
    for helper in helpers:
        helper.start()
    threads = torch.get_num_threads()
    try:
        return _work(capture, options, names, write, journal, items)
    finally:
        torch.set_num_threads(threads)
        for helper in helpers:
            helper.terminate()
            helper.join()


def _job(capture: Capture, options: CaptureOptions, names: Sequence[str]) -> tuple[Journal, list[Item]]:
    key = frame_key(capture, options)
    return Journal(options.out / JOURNAL), [Item(name, inputs=key) for name in names]


def _work(
    capture: Capture,
    options: CaptureOptions,
    names: Sequence[str],
    write: Writer,
    journal: Journal,
    items: list[Item],
) -> list[dict[str, Any]]:
    """This process's part of the frames."""
    global _worker
    torch.set_num_threads(1 if (options.processes or 1) > 1 else _cores())
    survives = (InputError, OSError, ValueError, RuntimeError)
    quiet = options.quiet
    runner = Runner(
        items,
        journal,
        noun="frame",
        survives=survives,
        progress=not quiet,
        whole=partial(_whole, options.out),
    )
    if any(journal.get(item) is None for item in items):
        _worker = capture, _pipe(options, pick_device(options.device)), options, write
    return runner.run(_frame)


def _whole(out: Path, item: Item, record: dict[str, Any]) -> bool:
    return (out / item.key / "depth.npy").is_file()


def _help(options: CaptureOptions, names: Sequence[str], write: Writer, index: int, count: int) -> None:
    """Another process of the same run, which takes frames that nobody has taken."""
    os.environ.update(RANK=str(index), WORLD_SIZE=str(count), LOCAL_RANK="0")
    options = replace(options, overwrite=False, quiet=True)
    capture = open_capture(options)
    solved_poses(capture, options)
    _work(capture, options, names, write, *_job(capture, options, names))


def _memory_processes() -> int:
    """How many processes the memory holds."""
    try:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):
        return 2
    return max(1, int(free / PROCESS_BYTES))


def run_capture(options: CaptureOptions, write: Writer, say: Callable[[str], None]) -> dict[str, Any]:
    """Everything of ``geodiff capture``: poses, frames, report.

    Args:
        options: as typed.
        write: writes the files of a frame; a function of a module.
        say: tells the user a sentence.

    Returns:
        The report, as in ``capture.json``.

    Raises:
        OSError, InputError: bad input, before any depth is computed where it can be seen that early.
    """
    check_choice(options.poses, "--poses", ("refined", "given"))
    check_choice(options.points, "--points", ("none", "model", "depth"))
    for kind in options.export:
        check_choice(kind, "--export", ("colmap", "mesh"))
    check_number(options.neighbours, "--neighbours", 1, 32, integer=True)
    started = time.perf_counter()
    capture = open_capture(options)
    names = capture.choose(options.frames)
    for note in capture.files.notes:
        say(note)
    if len(capture) > MANY and not options.quiet:
        say(_forecast(capture, len(names)))
    options.out.mkdir(parents=True, exist_ok=True)
    solved_poses(capture, options)
    solved = capture.solve()
    seconds = {"poses": round(time.perf_counter() - started, 1)}
    if not options.quiet:
        say(pose_line(capture))
    for note in solved.notes:
        say(f"warning: {note}")
    frames = run_frames(capture, options, names, write)
    seconds["frames"] = round(time.perf_counter() - started - seconds["poses"], 1)
    done = [report["frame"] for report in frames if report.get("status") != BROKEN]
    agreement = write_agreement(capture, options.out, done)
    files = write_results(capture, options.out, done, options.export)
    seconds["agreement and cloud"] = round(time.perf_counter() - started - sum(seconds.values()), 1)
    report = {
        "version": __version__,
        "path": str(options.path),
        "kind": capture.files.kind,
        "unit": capture.unit,
        "poses": pose_report(capture),
        "seconds": seconds,
        "files": files,
        "agreement": agreement,
        "frames": frames,
    }
    _write_json(options.out / "capture.json", report)
    return report


def _forecast(capture: Capture, chosen: int) -> str:
    """How long a large capture will take, before it begins."""
    width, height = capture.files.frames[0].size
    megapixels = width * height / 1e6
    hours = (len(capture) * 1.0 + chosen * 12 * max(1.0, megapixels / 0.3) ** 0.5) / _cores() / 3600
    return (
        f"{len(capture)} frames, depth of {chosen}: about {hours:.1f} h on {_cores()} cores with the bundled "
        f"prior, {len(capture) * 0.4 / 1000:.1f} GB for features. --frames FIRST:LAST:STEP chooses fewer."
    )


def pose_line(capture: Capture) -> str:
    """One line on what the solve did."""
    solved, unit = capture.solve(), capture.unit or "units"
    if solved.status in ("given", "kept"):
        return f"poses as given: matches {solved.residual_px_given:.2f} px off their epipolar lines"
    if solved.status == "estimated":
        count = int(solved.connected.sum())
        return f"poses estimated: {count} of {len(capture)} frames, {solved.residual_px:.2f} px"
    moved, turned = np.median(solved.moved), np.median(solved.turned_deg)
    return (
        f"poses solved: residual {solved.residual_px_given:.2f} -> {solved.residual_px:.2f} px, cameras "
        f"moved {moved:.3f} {unit} and turned {turned:.1f} degrees in the median, scale known to "
        f"{100 * solved.scale_spread:.0f} %"
    )


def pose_report(capture: Capture) -> dict[str, Any]:
    """What the solve did, for ``capture.json``."""
    solved = capture.solve()
    numbers = {
        "residual_px_given": solved.residual_px_given,
        "residual_px": solved.residual_px,
        "scale_by_positions": solved.scale_trajectory[0],
        "scale_by_depth": solved.scale_depth[0],
        "scale_spread": solved.scale_spread,
    }
    frames = {
        name: {"connected": bool(c), "moved": round(float(m), 5), "turned_deg": round(float(t), 3)}
        for name, c, m, t in zip(
            capture.names, solved.connected, solved.moved, solved.turned_deg, strict=True
        )
        if math.isfinite(m)
    }
    shown = {name: round(v, 4) if math.isfinite(v) else None for name, v in numbers.items()}
    return {"status": solved.status, **shown, "notes": list(solved.notes), "frames": frames}
