"""A capture: poses once, depth of every chosen frame, agreement, one cloud of all."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from contextvars import Context
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import psutil  # comes with accelerate
import torch

from geodiff_plugin import __version__
from geodiff_plugin._checks import InputError, bad_value, refuse, warn
from geodiff_plugin._threads import WithinCores, available_cores
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.capture.results import ALONE, save_alone, write_agreement, write_results
from geodiff_plugin.formats.depth import read_map
from geodiff_plugin.formats.files import MAP_SUFFIXES, find_map, read_matrix
from geodiff_plugin.formats.out import REPORT, OutFolder, atomic_path, check_new, working_in, write_text
from geodiff_plugin.formats.transforms import TRANSFORMS, transforms_of
from geodiff_plugin.jobs.failures import Failures
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Record, Shard, shards_beside
from geodiff_plugin.jobs.lengths import KnownScale, check_lengths, known_scale, measure, spans_to_measure
from geodiff_plugin.jobs.memory import fitting_memory
from geodiff_plugin.jobs.options import OF_SCALE, CaptureOptions
from geodiff_plugin.jobs.prior import compile_for, graphs_for_many, load_quiet_prior
from geodiff_plugin.jobs.provenance import RECORD, SUMMARY, Provenance, begin_frames, check_poses
from geodiff_plugin.jobs.report import messages_of, plain, read_report, single_map, verdict_report
from geodiff_plugin.jobs.runner import Runner
from geodiff_plugin.jobs.separate import ProcessEnded, SeparateProcess, close_all
from geodiff_plugin.jobs.telling import Tell, collected_warnings, say, silent
from geodiff_plugin.jobs.writing import write_maps
from geodiff_plugin.messages import Message, as_records
from geodiff_plugin.options import on_ray
from geodiff_plugin.pose.multiview import SolvedCapture
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.runtime.machine import pick_device

#: File of the solved poses, which an interrupted run reads again.
POSES_FILE = "poses.npz"
#: File with one line a finished frame.
JOURNAL = "frames.jsonl"
#: Memory that one process of the bundled prior takes at 640x480, bytes; what a larger prior takes is unknown.
PROCESS_BYTES = 1.5e9
#: What helps too where the memory is not enough.
FEWER_PROCESSES = ", or give a lower --processes"


@dataclass(frozen=True)
class RunKeys:
    """What another process needs beside the options: keys of poses and frames, and the scale."""

    poses_key: str
    frames_key: str
    scale: KnownScale | None


def open_capture(options: CaptureOptions) -> Capture:
    """The capture of the options, without poses solved."""
    K = None if options.k is None else read_matrix(options.k, "--K")
    capture = Capture.open(
        options.path, K=K, fov=options.fov, trajectory=options.trajectory, images=options.images
    )
    if options.poses == "given" and capture.poses is None:
        bad_value("--poses given", "used with a capture that has poses", f"{options.path} without")
    if "mesh" in options.export and find_spec("open3d") is None:
        bad_value("--export mesh", "used where Open3D is installed", "none", "pip install open3d")
    capture.check_points(options.points, any(getattr(options, way) is not None for way in OF_SCALE))
    check_lengths(capture, options)
    return capture


def solved_poses(
    capture: Capture, options: CaptureOptions, key: str, scale: KnownScale | None = None
) -> KnownScale | None:
    """Solve for the poses, or load those of an earlier run of the same capture; then set the scale.

    ``key`` is that of what the poses depend on. Returns the scale that the options give; ``scale`` passes in
    what another process found.
    """
    path, shard = options.out / POSES_FILE, Shard.of(options.shard)
    solved = None if options.overwrite and shard.whole else load_solved(path, key)
    if solved is None and not shard.whole:
        of = "The poses of these frames are not solved yet"
        refuse(f"{of}: run geodiff capture with --poses-only first, then the shards.")
    if solved is None:
        solved = capture.solve(options.poses, threads=available_cores())
        _save_solved(path, solved, key)
    capture.solved = solved
    capture.scale_measured = (options.known_length or options.distance) is not None
    scale = known_scale(capture, options, partial(_maps, capture, options)) if scale is None else scale
    if scale is not None:
        capture.rescale(scale.factor)
        if scale.doubt is not None:
            capture.scale_measured = False
            capture.notes.append(scale.doubt)
    return scale


def _save_solved(path: Path, solved: SolvedCapture, key: str) -> None:
    """Write everything as ``.npz``, under the key of the frames and settings that it is of."""
    arrays = {f.name: getattr(solved, f.name) for f in fields(solved) if f.name not in ("seen", "notes")}
    arrays["E_given"] = np.zeros(0) if solved.E_given is None else solved.E_given
    arrays["px"], arrays["point"] = map(np.concatenate, zip(*solved.seen, strict=True))
    arrays["counts"] = np.array([len(points) for _, points in solved.seen])
    arrays["notes"] = np.array([(note.code, note) for note in solved.notes], np.str_).reshape(-1, 2)
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, key=np.array(key), **arrays)


def load_solved(path: Path, key: str) -> SolvedCapture | None:
    """What was saved; ``None`` where there is none of that key."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        if str(arrays.pop("key")) != key:
            return None
        cuts = np.cumsum(arrays.pop("counts"))[:-1]
        px, point = np.split(arrays.pop("px"), cuts), np.split(arrays.pop("point"), cuts)
        values: dict[str, Any] = {n: a.item() if a.ndim == 0 else a for n, a in arrays.items()}
        values["E_given"] = values["E_given"] if values["E_given"].size else None
        values["notes"] = tuple(Message(str(code), str(text)) for code, text in values["notes"])
        return SolvedCapture(seen=tuple(zip(px, point, strict=True)), **values)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _pipe(options: CaptureOptions) -> Any:
    prior = "map" if options.prior_map is not None else options.prior
    device = pick_device(options.device)
    pipe = load_quiet_prior(prior, device, options.space)
    graphs = graphs_for_many(options, device)
    return enable_geometry_guidance(pipe, graphs=graphs, kernels=not options.no_kernels)


def _depth(
    capture: Capture, pipe: Any, name: str, options: CaptureOptions, points: str = "none"
) -> MetricDepthOutput:
    """Depth of one frame as the options say."""
    call: dict[str, Any] = {} if options.steps is None else {"num_inference_steps": options.steps}
    if options.prior_map is not None:
        path = find_map(options.prior_map, name) or options.prior_map / f"{name}{MAP_SUFFIXES[0]}"
        call["depth_map"] = read_map(path, f"--prior-map of {name}")
    with torch.no_grad():
        return capture.depth(pipe, name, options.neighbours, seed=options.seed, points=points, **call)


def _maps(capture: Capture, options: CaptureOptions, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Depth and confidence of one frame by a run of its own."""
    output = _depth(capture, _pipe(options), name, options)
    return single_map(output.prediction), None if output.confidence is None else single_map(output.confidence)


def _make_frame(capture: Capture, options: CaptureOptions, loaded: Callable[[], Any], item: Item) -> Record:
    """One frame, within the memory that there is."""
    pipe, size = loaded(), capture.frame(item.key).size
    with fitting_memory("A frame", size, FEWER_PROCESSES):
        return _write_frame(capture, options, pipe, item)


def _write_frame(capture: Capture, options: CaptureOptions, pipe: Any, item: Item) -> Record:
    """One frame: its files, and its report."""
    name, started = item.key, time.perf_counter()
    output = _depth(capture, pipe, name, options, options.points)
    depth, solved, number = single_map(output.prediction), capture.solve(), capture.names.index(name)
    low, middle, high = (float(v) for v in np.percentile(depth, (2, 50, 98)))
    report: Record = {
        "version": __version__,
        "frame": name,
        "made_from": item.inputs,
        "neighbours": capture.neighbours(name, options.neighbours),
        "unit": output.unit,
        "K": np.asarray(output.K)[0].tolist(),
        "T_world_from_camera": solved.E[number].tolist(),
        "connected": bool(solved.connected[number]),
        "scale_spread": plain(round(solved.scale_spread, 4)),
        "depth": {"p02": low, "median": middle, "p98": high},
        "poses": [pose.status for pose in output.poses],
        "verdict": verdict_report(output),
        "warnings": list(output.warnings),
        "messages": messages_of(output),
    }

    def fill(folder: Path) -> None:
        report["files"] = write_maps(folder, output, capture.image(name))
        save_alone(folder, depth, None if output.confidence is None else single_map(output.confidence))
        report["files"]["names"] = [*sorted(path.name for path in folder.iterdir()), REPORT]
        report["seconds"] = round(time.perf_counter() - started, 2)
        write_text(folder / REPORT, json.dumps(report, indent=2) + "\n")

    with OutFolder(options.out / name, overwrite=True) as out:
        out.write(fill)
    return report


def _run_frames(
    capture: Capture, options: CaptureOptions, names: Sequence[str], keys: RunKeys, progress: bool
) -> list[Record]:
    """Depth of every chosen frame that is not done yet, by one process a core; their reports in order."""
    path, shard = options.out / JOURNAL, Shard.of(options.shard)
    if options.overwrite:
        for each in (path, *shards_beside(path).values()) if shard.whole else (shard.path(path),):
            each.unlink(missing_ok=True)
    items = [Item(name, inputs=keys.frames_key, head={"frame": name}) for name in names]
    if options.engine == "ray" and shard.whole:
        return _frames_on_ray(options, items, keys, progress)
    with Journal(path, shard) as journal:
        runner = Runner(
            shard.part(items),
            journal,
            noun="frame",
            survives=(InputError, OSError, ValueError, RuntimeError),
            progress=progress,
            whole=lambda item, _: _is_made(item, options.out / item.key),
        )
        make = partial(_make_frame, capture, options, cache(partial(_pipe, options)))
        count = _processes(options, len(runner.left)) if shard.whole else 1
        if count > 1:
            return _in_processes(runner, make, options, keys, count)
        with WithinCores(1 if options.shard else shard.count):
            return runner.run(make)


def _frames_on_ray(
    options: CaptureOptions, items: Sequence[Item], keys: RunKeys, progress: bool
) -> list[Record]:
    """The frames by actors of Ray, each of which opens the capture and its poses."""
    items_on_actors = on_ray("items_on_actors")
    make = partial(_frame_by_name, replace(options, overwrite=False), keys)
    with Journal(options.out / JOURNAL) as journal:
        for item in items:
            if not _is_made(item, options.out / item.key):
                journal.forget(item)
        return items_on_actors(items, journal, make, options, Failures(len(items), "frame", say), progress)


def _frame_by_name(options: CaptureOptions, keys: RunKeys) -> Callable[[str], Record]:
    """What an actor does with the name of a frame."""
    capture = _opened_again(options, keys)
    loaded = cache(partial(_pipe, options))
    return lambda name: _make_frame(capture, options, loaded, Item(name, inputs=keys.frames_key))


def _opened_again(options: CaptureOptions, keys: RunKeys) -> Capture:
    """The capture with its solved poses, in another process; what the first has told is not told again."""

    def opened() -> Capture:
        with collected_warnings(silent):
            capture = open_capture(options)
            solved_poses(capture, options, keys.poses_key, keys.scale)
            return capture

    return Context().run(opened)  # where no ``noted`` block hears it


def _in_processes(
    runner: Runner, make: Callable[[Item], Record], options: CaptureOptions, keys: RunKeys, count: int
) -> list[Record]:
    """The frames by so many processes, of which this is one; each has the cores that the others leave it."""
    helping = partial(_help, replace(options, overwrite=False), keys, count)
    helpers = [SeparateProcess(__name__, extended=True) for _ in range(count - 1)]

    def make_here(item: Item) -> Record:
        with WithinCores(1 + sum(helper.alive for helper in helpers)):
            return make(item)

    try:
        return runner.run_with(helpers, helping, make_here)
    finally:
        close_all(helpers)


def _help(options: CaptureOptions, keys: RunKeys, count: int, item: Item) -> Record:
    """A frame by one of so many processes that does nothing else."""
    with WithinCores(count):
        try:
            capture, pipe = _ready(options, keys)
        except Exception as error:  # for example of a prior that only the first process knows
            raise ProcessEnded(f"A helper process cannot begin: {error}") from error
        return _make_frame(capture, options, lambda: pipe, item)


@cache
def _ready(options: CaptureOptions, keys: RunKeys) -> tuple[Capture, Any]:
    """The capture and the prior of a process that helps."""
    return _opened_again(options, keys), _pipe(options)


def _processes(options: CaptureOptions, left: int) -> int:
    """How many processes work on so many frames: on a CPU one a core, as far as the memory goes."""
    on_cpu = pick_device(options.device).type == "cpu"
    held = int(psutil.virtual_memory().available / PROCESS_BYTES)
    wanted = options.processes or (min(available_cores(), max(1, held)) if on_cpu else 1)
    return max(1, min(wanted, left))


def _is_made(item: Item, folder: Path) -> bool:
    """Whether a folder holds what this item would make."""
    whole = all((folder / f"{file}.npy").is_file() for file in ALONE)
    return whole and read_report(folder).get("made_from") == item.inputs


def depth_capture(options: CaptureOptions, *, tell: Tell = silent, progress: bool = False) -> Record:
    """What ``geodiff capture`` does: poses, frames, their agreement and one cloud, into ``options.out``.

    Args:
        options: of the command.
        tell: takes the lines for the user.
        progress: whether a bar on stderr counts the frames.

    Returns:
        The content of ``capture.json``; ``failed`` and ``not_trusted`` name frames. Of a shard, and with
        ``options.poses_only``, only what there is by then.

    Raises:
        InputError: no capture, options that do not fit it, or no frame that got depth.
    """
    started = time.perf_counter()
    capture = open_capture(options)
    names = capture.choose(options.frames)
    ours = any((options.out / name).is_file() for name in (POSES_FILE, JOURNAL, RECORD))
    check_new(options.out, ours or options.overwrite).mkdir(parents=True, exist_ok=True)
    for note in capture.notes:
        tell(note)
    largest = max((capture.frame(name).size for name in names), key=math.prod)
    with (
        working_in(options.out, shared=not Shard.of(options.shard).whole),
        fitting_memory("A capture", largest, FEWER_PROCESSES),
    ):
        return _depth_of_frames(capture, options, names, Progress(started, tell, progress))


@dataclass(frozen=True)
class Progress:
    """When a run began, who hears its lines, and whether it shows a bar."""

    started: float
    tell: Tell
    bar: bool

    def seconds(self, *before: float) -> float:
        """Since the beginning, less those of the stages before."""
        return round(time.perf_counter() - self.started - sum(before), 1)


def _depth_of_frames(
    capture: Capture, options: CaptureOptions, names: Sequence[str], progress: Progress
) -> Record:
    """The run, in a folder that no other one works in."""
    made_from = Provenance.of(capture, options)
    poses_key, key = made_from.for_poses().key, made_from.key
    check_poses(made_from, options.out, options.overwrite)
    if not options.poses_only:
        begin_frames(made_from, options.out, names, options.overwrite)
    scale = solved_poses(capture, options, poses_key)
    seconds = {"poses": progress.seconds()}
    _tell_of_poses(capture, scale, progress.tell)
    if options.poses_only:
        return {"unit": capture.unit, "poses": _pose_report(capture)} | _outcome([])
    compile_for(options, pick_device(options.device), progress.tell)
    frames = _run_frames(capture, options, names, RunKeys(poses_key, key, scale), progress.bar)
    outcome = _outcome(frames)
    if not Shard.of(options.shard).whole:
        return {"unit": capture.unit} | outcome
    seconds["frames"] = progress.seconds(*seconds.values())
    done = [name for name in names if name not in outcome["failed"]]
    if not done:
        raise InputError(f"No frame got depth: {frames[0]['error']}")
    agreement = write_agreement(capture, options.out, done)
    doubted = outcome["not_trusted"]
    original = transforms_of(options.path, options.images) if capture.kind == TRANSFORMS else None
    files = write_results(capture, options.out, done, options.export, doubted, original)
    seconds["agreement and cloud"] = progress.seconds(*seconds.values())
    report = {
        "version": __version__,
        "made_from": key,
        "path": str(options.path),
        "kind": capture.kind,
        "unit": capture.unit,
        "poses": _pose_report(capture),
        "seconds": seconds,
        "files": files,
        "agreement": agreement,
        "measured": _measured(capture, options, outcome, scale),
        "notes": capture.notes,
        "messages": as_records(capture.notes, capture.solve().notes),
        **outcome,
    }
    write_text(options.out / SUMMARY, json.dumps(report, indent=2) + "\n")
    return report


def _tell_of_poses(capture: Capture, scale: KnownScale | None, tell: Tell) -> None:
    """Lines on how the poses fit, and warnings on what is wrong with them or with their scale."""
    solved = capture.solve()
    tell(f"poses {solved.status}: matches lie {solved.residual_px:.2f} px off their epipolar lines")
    for note in (*solved.notes, *([scale.doubt] if scale and scale.doubt else ())):
        (tell if note.code == "capture.kept" else warn)(note)


def _measured(
    capture: Capture, options: CaptureOptions, outcome: Record, scale: KnownScale | None
) -> list[Record]:
    """What ``--measure`` asks for of the frames that got depth."""
    spans = [span for span in spans_to_measure(capture, options) if span.frame not in outcome["failed"]]
    spread = capture.solve().scale_spread if scale is None else scale.spread
    return measure(capture, spans, options.out, outcome["not_trusted"], spread if spread > 0 else 0.0)


def _outcome(frames: list[Record]) -> Record:
    """The reports of frames, and the names of those that failed or are not trusted."""
    return {
        "failed": [report["key"] for report in frames if report.get("status") == BROKEN],
        "not_trusted": [f["frame"] for f in frames if "verdict" in f and f["verdict"]["status"] != "trusted"],
        "frames": frames,
    }


def _pose_report(capture: Capture) -> Record:
    """What the solve did."""
    solved = capture.solve()
    numbers = {
        "residual_px_given": solved.residual_px_given,
        "residual_px": solved.residual_px,
        "scale_by_positions": solved.scale_trajectory,
        "scale_by_depth": solved.scale_depth,
        "scale_spread": solved.scale_spread,
    }
    rounded = plain({name: round(value, 4) for name, value in numbers.items()})
    each = zip(capture.names, solved.connected, *solved.moved(), strict=True)
    frames = {
        name: {
            "connected": bool(connected),
            "moved": round(float(moved), 5),
            "turned_deg": round(float(turned_deg), 3),
        }
        for name, connected, moved, turned_deg in each
        if math.isfinite(moved)
    }
    return {"status": solved.status, **rounded, "notes": list(solved.notes), "frames": frames}
