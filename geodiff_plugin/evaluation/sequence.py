"""Temporal stability of depth over frames of a moving rig: ``geodiff eval sequence``."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch

from geodiff_plugin import __version__
from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.experiment import Experiment, Page, last_of
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.options import SequenceOptions
from geodiff_plugin.evaluation.tables import Table
from geodiff_plugin.guidance.evidence import EvidenceStore
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.runner import Item, Record
from geodiff_plugin.runtime.pipeline import native_images

#: What makes a sequence, by name; a checkout registers its renderer (tests/scenes/dataset.py).
SEQUENCES: dict[str, Any] = {}
#: A point is the same in the next frame where the depth there is its own within this share.
SAME_SURFACE = 0.01


class Way(NamedTuple):
    """How frames follow each other: title, share of the steps, and ``warm_start``, ``None`` for alone."""

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


def run_sequence(name: str, options: SequenceOptions) -> Page | None:
    """Measure every way on every sequence, and write the page.

    Raises:
        InputError: no sequences are registered, bad options, or a prior that cannot be loaded.
        OSError: missing or unreadable files.
    """
    if "synthetic" not in SEQUENCES:
        cure = "A clone of the repository has them: python -m tests.scenes eval sequence ..."
        bad_value("the sequences", "registered in evaluation.sequence.SEQUENCES as 'synthetic'", "none", cure)
    settings, priors, store = options.settings, PriorCache(), EvidenceStore(options.frames)
    pipe, prior = priors.get(settings), priors.fingerprint(settings)
    render = last_of(lambda seed: SEQUENCES["synthetic"](seed, options.frames, size=options.size))
    cells = []
    for seed in range(options.scenes):
        for way in options.ways:
            how = (options.frames, *options.size, options.steps, options.seed, settings.device)
            key = "|".join(map(str, (seed, way, *how, settings.prior, prior, __version__)))
            work = partial(_measure, pipe, render, seed, WAYS[way], options, store)
            cells.append(Item(key, work, name=f"sequence {seed}, {way}", head={"seed": seed, "way": way}))
    remark = (
        f"{options.scenes} rendered scenes of {options.frames} frames, {options.size[1]}x{options.size[0]} "
        f"pixels, prior {settings.prior}, {options.steps} steps, seed {options.seed} for every frame."
    )
    experiment = Experiment(name, "Sequences", cells, lambda own: [sequence_table(own)], lambda _: [remark])
    return experiment.run(name, options)


def _measure(
    pipe: Any, render: Any, seed: int, way: Way, options: SequenceOptions, store: EvidenceStore
) -> Record:
    """AbsRel, flicker and seconds a frame of one way of going through a sequence."""
    sequence, steps = render(seed), max(1, round((options.steps or 1) * way.share))
    device = pipe._execution_device
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    errors, scores, before, seconds = [], [], None, 0.0
    for left, right in zip(sequence.lefts, sequence.rights, strict=True):
        knobs: dict[str, Any] = {} if way.warm is None else {"previous": before, "warm_start": way.warm}
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
    numbers |= {"flicker": moved, "breath": breath, "seconds": seconds / len(sequence.lefts)}
    return {"kind": sequence.kind} | numbers


def sequence_table(records: Sequence[Record]) -> Table:
    """Ways by means over the sequences, of the records of ``run_sequence``."""
    rows = []
    for way in dict.fromkeys(record["way"] for record in records):
        chosen = [record for record in records if record["way"] == way]
        mean = {n: np.mean([r[n] for r in chosen]) for n in ("abs_rel", "flicker", "breath", "seconds")}
        shown = [f"{mean['abs_rel']:.4f}", f"{max(r['worst'] for r in chosen):.3f}"]
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
