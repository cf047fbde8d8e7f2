"""Temporal stability of depth: ``geodiff eval sequence``.

Data flow: rendered sequences -> every frame alone, or from the frame before -> AbsRel, flicker, seconds.
Paper: none; S5 measures single pairs.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from geodiff_plugin import __version__
from geodiff_plugin._checks import check_choice, check_number
from geodiff_plugin.evaluation.baselines import PriorCache, Settings
from geodiff_plugin.evaluation.layout import Table
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.records import append_record, clean_records, read_records
from geodiff_plugin.evaluation.report import Page, run_facts, write_page
from geodiff_plugin.guidance.evidence_store import EvidenceStore
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.runtime.machine import pick_device
from geodiff_plugin.runtime.pipeline import native_images

__all__ = ["SEQUENCES", "WAYS", "SequenceOptions", "Way", "flicker", "run_sequence", "sequence_table"]

#: What renders a sequence, by name; a checkout registers its renderer (tests/scenes/dataset.py).
SEQUENCES: dict[str, Any] = {}
#: A point is the same in the next frame where the depth there is its own within this share.
SAME_SURFACE = 0.01


@dataclass(frozen=True)
class Way:
    """How the frames of a sequence follow each other.

    Attributes:
        title: in the table.
        share: of the steps that are asked for.
        warm: knob ``warm_start`` of calls that go on from the frame before; ``None``: each frame alone.
    """

    title: str
    share: float = 1.0
    warm: float | None = None


WAYS = {
    "alone": Way("each frame alone"),
    "alone-half": Way("each frame alone, half the steps", share=0.5),
    "scale": Way("scale of the frame before", warm=0.0),
    "warm": Way("warm start, a quarter left out", warm=0.25),
    "warm-50": Way("warm start, half left out", warm=0.5),
    "warm-75": Way("warm start, three quarters left out", warm=0.75),
}


@dataclass(frozen=True)
class SequenceOptions:
    """What to measure.

    Attributes:
        command: as typed, for the page.
        scenes: how many, of the seeds from 0 on.
        frames: of each, at least 2.
        size: ``(H, W)`` of the images.
        ways: keys of ``WAYS``.
        steps: denoising steps of a frame alone.
        prior: ``"bundled"``, a hub id or a folder.
        seed: of the noise, the same for every frame.
        device: as ``--device``.
        out: folder of the records; a run goes on where it was stopped.
        results: where the Markdown page is written as well.
        quiet: no progress bar.
    """

    command: str
    scenes: int = 4
    frames: int = 6
    size: tuple[int, int] = (192, 256)
    ways: tuple[str, ...] = tuple(WAYS)
    steps: int = 4
    prior: str = "bundled"
    seed: int = 0
    device: str = "auto"
    out: Path = Path("geodiff-eval")
    results: Path | None = None
    quiet: bool = False

    def __post_init__(self) -> None:
        for way in self.ways:
            check_choice(way, "ways", WAYS)
        check_number(self.frames, "frames", 2, 10_000, integer=True)
        check_number(self.scenes, "scenes", 1, 10_000, integer=True)


def flicker(errors: Sequence[np.ndarray], sequence: Any) -> tuple[float, float]:
    """Change of log depth of the same surface points from frame to frame, beyond that of the truth.

    Args:
        errors: ``(H, W)`` each, log of depth over truth; NaN where there is no truth.
        sequence: the frames that they belong to.

    Returns:
        Mean absolute change over points, and over frames the mean absolute change of the median: how far the
        whole picture breathes.
    """
    points, breath = [], []
    for i in range(len(errors) - 1):
        rows, columns, at_rows, at_columns = _same_points(sequence, i)
        change = errors[i + 1][at_rows, at_columns] - errors[i][rows, columns]
        change = change[np.isfinite(change)]
        points.append(np.abs(change).mean())
        breath.append(abs(np.median(change)))
    return float(np.mean(points)), float(np.mean(breath))


def _same_points(sequence: Any, i: int) -> tuple[np.ndarray, ...]:
    """Rows and columns in frame ``i``, and in frame ``i + 1`` those of the same surface points."""
    K = sequence.K.numpy()
    depth, following = (sequence.lefts[j].depth_m[0].numpy().astype(np.float64) for j in (i, i + 1))
    move = np.linalg.inv(sequence.T_world_from_left[i + 1].numpy()) @ sequence.T_world_from_left[i].numpy()
    rows, columns = np.nonzero(np.isfinite(depth))
    rays = np.linalg.inv(K) @ np.stack([columns, rows, np.ones_like(rows)])
    x, y, z = move[:3, :3] @ (rays * depth[rows, columns]) + move[:3, 3:]
    u, v = (K[0, 0] * x + K[0, 2] * z) / z, (K[1, 1] * y + K[1, 2] * z) / z
    height, width = depth.shape
    inside = (z > 0) & (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
    rows, columns, z = rows[inside], columns[inside], z[inside]
    at_rows, at_columns = np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int)
    same = np.abs(following[at_rows, at_columns] / z - 1) < SAME_SURFACE
    return rows[same], columns[same], at_rows[same], at_columns[same]


def run_sequence(options: SequenceOptions) -> Page:
    """Measure every way on every sequence, and write the page.

    Raises:
        InputError: bad options, or a prior that cannot be loaded.
        OSError: missing or unreadable files.
    """
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "sequence.jsonl"
    clean_records(path)
    found = {record["key"]: record for record in read_records(path)}
    settings, priors = Settings(options.prior, device=str(pick_device(options.device))), PriorCache()
    pipe, prior = priors.get(settings), priors.fingerprint(settings)
    keys = [
        (seed, way, _key(seed, way, options, settings.device, prior))
        for seed in range(options.scenes)
        for way in options.ways
    ]
    sequence, store = None, EvidenceStore(options.frames)
    for seed, way, key in tqdm(keys, disable=options.quiet, desc="sequences"):
        if key in found:
            continue
        if sequence is None or sequence.seed != seed:
            sequence = SEQUENCES["synthetic"](seed, options.frames, size=options.size)
        found[key] = {"key": key, "seed": seed, "kind": sequence.kind, "way": way}
        found[key] |= _measure(pipe, sequence, WAYS[way], options, store)
        append_record(path, found[key])
    records = [found[key] for _, _, key in keys]
    remarks = (
        f"{options.scenes} rendered scenes of {options.frames} frames, {options.size[1]}x{options.size[0]} "
        f"pixels, prior {options.prior}, {options.steps} steps, seed {options.seed} for every frame.",
    )
    page = Page("Sequences", run_facts(options.command), (sequence_table(records),), remarks)
    write_page(page, options.out, "sequence", options.results)
    return page


def _key(seed: int, way: str, options: SequenceOptions, device: str, prior: str) -> str:
    how = (options.frames, *options.size, options.steps, options.seed, device)
    return "|".join(map(str, (seed, way, *how, options.prior, prior, __version__)))


def _measure(
    pipe: Any, sequence: Any, way: Way, options: SequenceOptions, store: EvidenceStore
) -> dict[str, float]:
    """AbsRel, flicker and seconds a frame of one way of going through a sequence."""
    steps = max(1, round(options.steps * way.share))
    device = pipe._execution_device
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    errors, scores, before, seconds = [], [], None, 0.0
    for left, right in zip(sequence.lefts, sequence.rights, strict=True):
        knobs = {} if way.warm is None else {"previous": before, "warm_start": way.warm}
        guidance = GeometryGuidance(right.image_01, sequence.K.numpy(), sequence.E.numpy(), **knobs)
        guidance.evidence_store = store
        with torch.no_grad():
            guidance.prepare(native_images(left.image_01, device))  # the same for every way, so not timed
        generator = torch.Generator("cpu").manual_seed(options.seed)
        call = {"num_inference_steps": steps, "generator": generator, "output_latent": True}
        started = clock()
        before = pipe(left.image_01, guidance=guidance, **call)  # its result is numpy: nothing is pending
        seconds += clock() - started
        depth_m, truth = before.prediction[0, ..., 0], left.depth_m[0].numpy()
        valid = left.valid[0].numpy()
        scores.append(evaluate_depth(depth_m, truth, valid)["abs_rel"])
        errors.append(np.log(depth_m / np.where(valid, truth, np.nan)))
    moved, breath = flicker(errors, sequence)
    numbers = {"abs_rel": float(np.mean(scores)), "worst": float(np.max(scores))}
    return numbers | {"flicker": moved, "breath": breath, "seconds": seconds / len(sequence.lefts)}


def sequence_table(records: Sequence[dict[str, Any]]) -> Table:
    """Ways by means over the sequences.

    Args:
        records: of ``run_sequence``.
    """
    rows = []
    for way in dict.fromkeys(record["way"] for record in records):
        own = [record for record in records if record["way"] == way]
        mean = {n: np.mean([r[n] for r in own]) for n in ("abs_rel", "flicker", "breath", "seconds")}
        shown = [f"{mean['abs_rel']:.4f}", f"{max(r['worst'] for r in own):.3f}"]
        shown += [f"{100 * mean[name]:.2f}" for name in ("flicker", "breath")] + [f"{mean['seconds']:.2f}"]
        rows.append((WAYS[way].title, *shown))
    note = (
        "AbsRel in metres, without alignment, and that of the worst frame. Flicker: mean absolute change of "
        "log depth of the same surface point from one frame to the next, beyond that of the truth, in per "
        "cent; breathing: the same of the frame's median. Seconds of a guided call whose evidence is there "
        "already; on a CPU those of all its threads."
    )
    header = ("frames", "AbsRel", "worst frame", "flicker %", "breathing %", "s a frame")
    return Table("From frame to frame", header, tuple(rows), note)
