"""Error and flicker of frames from a moving rendered rig, independent and temporally smoothed.

The numbers are in docs/appendix/results-scenes.md.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import pairwise, product
from typing import Any

import numpy as np
import torch

from geodiff_plugin import __version__
from geodiff_plugin.cameras import PosedCamera
from geodiff_plugin.capture.agreement import scene_poses, seen_in, temporally_smoothed
from geodiff_plugin.evaluation.baselines import PriorCache
from geodiff_plugin.evaluation.experiment import Experiment, Page, run_experiment
from geodiff_plugin.evaluation.metrics import evaluate_depth
from geodiff_plugin.evaluation.tables import CellOf, Table, max_of, mean_of, table_of_groups
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.jobs.journal import Item, Record, fingerprint
from geodiff_plugin.types import DepthFrame
from tests.lab.options import WAYS, SequenceOptions
from tests.scenes import SyntheticSequence, render_sequence

#: Maximum relative change in depth of the same surface point between frames.
SAME_SURFACE = 0.01


def flicker(errors: Sequence[np.ndarray], ground_truth: Sequence[DepthFrame]) -> tuple[float, float]:
    """Compute the mean absolute change in a surface point's log depth between frames, beyond ground truth.

    ``errors`` are ``(H, W)`` each, the log of depth over ground truth. The second number is the same for the
    frames' medians.
    """
    points, medians = [], []
    for (frame, following), (before, after) in zip(pairwise(ground_truth), pairwise(errors), strict=True):
        row, column, z, inside = seen_in(frame, following)
        same = inside & (np.abs(following.depth[row, column] - z) < SAME_SURFACE * z)
        change = after[row, column][same] - before[same]
        change = change[np.isfinite(change)]
        points.append(np.abs(change).mean())
        medians.append(abs(np.median(change)))
    return float(np.mean(points)), float(np.mean(medians))


def true_frames(sequence: SyntheticSequence) -> list[DepthFrame]:
    """Return the left views of a sequence; depth is NaN without ground truth."""
    frames = []
    for view, pose in zip(sequence.lefts, sequence.T_world_from_left, strict=True):
        depth = np.where(view.valid[0].numpy(), view.depth_m[0].numpy().astype(np.float64), np.nan)
        camera = PosedCamera(sequence.K.numpy(), depth.shape[::-1], E=pose.numpy())
        frames.append(DepthFrame("", depth, depth, camera))
    return frames


def run(name: str, options: SequenceOptions) -> Page | None:
    """Measure every way on every sequence, and write the page; errors as in ``run_experiment``."""
    settings, priors = options.settings, PriorCache()
    pipe, prior = priors.get(settings), priors.fingerprint(settings)

    @lru_cache(maxsize=1)
    def render(seed: int) -> SyntheticSequence:
        return render_sequence(seed, options.frames, size=options.size)

    cells = []
    for seed, way in product(range(options.scenes), options.ways):
        how = (options.frames, *options.size, options.steps, options.seed, settings.device)
        key = fingerprint(seed, way, *how, settings.prior, prior, __version__)
        work = partial(_measure, pipe, render, seed, way, options)
        cells.append(Item(key, work, name=f"sequence {seed}, {way}", head={"seed": seed, "way": way}))
    of = f"{options.frames} frames, {options.size[1]}x{options.size[0]} pixels, prior {settings.prior}"
    remark = f"{options.scenes} rendered scenes of {of}, {options.steps} steps, seed {options.seed} each."
    return run_experiment(name, options, Experiment("Sequences", cells, page_tables, lambda _: [remark]))


def _measure(pipe: Any, render: Any, seed: int, way: str, options: SequenceOptions) -> Record:
    """Measure AbsRel, flicker and seconds per frame of one way to process a sequence."""
    sequence = render(seed)
    device, ground_truth = pipe._execution_device, true_frames(sequence)
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    camera = replace(ground_truth[0].camera, K=sequence.K.numpy().astype(np.float64), E=np.eye(4))
    frames, images, started = [], [], clock()
    for left, right in zip(sequence.lefts, sequence.rights, strict=True):
        guidance = GeometryGuidance(right.image_01, sequence.K.numpy(), sequence.E.numpy())
        generator = torch.Generator("cpu").manual_seed(options.seed)
        call = {"generator": generator, "num_inference_steps": options.steps}
        out = pipe(left.image_01, guidance=guidance, **call)  # its result is numpy: nothing is pending
        maps = out.prediction[0, ..., 0], out.confidence[0, ..., 0]
        frames.append(DepthFrame("", *maps, camera))
        images.append(left.image_01.permute(1, 2, 0).numpy())
    if way == "temporal_smoothing":
        frames = list(temporally_smoothed(scene_poses(zip(frames, images, strict=True)), frames.__getitem__))
    seconds = clock() - started
    known = [np.isfinite(true.depth) for true in ground_truth]
    each = zip(frames, ground_truth, known, strict=True)
    scores = [evaluate_depth(frame.depth, true.depth, there)["abs_rel"] for frame, true, there in each]
    errors = [np.log(frame.depth / true.depth) for frame, true in zip(frames, ground_truth, strict=True)]
    points, medians = flicker(errors, ground_truth)
    numbers = {"abs_rel": float(np.mean(scores)), "worst": float(np.max(scores)), "flicker": points}
    return (
        {"kind": sequence.kind}
        | numbers
        | {"median_flicker": medians, "seconds": seconds / len(ground_truth)}
    )


_COLUMNS: dict[str, CellOf] = {
    "frames": lambda group: WAYS[group[0]["way"]],
    "AbsRel": mean_of("abs_rel", 4),
    "worst frame": max_of("worst"),
    "flicker %": mean_of("flicker", 2, 100.0),
    "median flicker %": mean_of("median_flicker", 2, 100.0),
    "s/frame": mean_of("seconds", 2),
}


def page_tables(records: Sequence[Record]) -> list[Table]:
    """Make a table of means over the sequences."""
    note = (
        "AbsRel in metres, without alignment. Flicker is the mean absolute change in a surface point's log "
        "depth between consecutive frames, beyond the change in ground truth. Median flicker is the same for "
        "the frame's median depth. On a CPU, seconds are summed over all threads."
    )
    return [table_of_groups("Flicker between frames", records, ("way",), _COLUMNS, note)]
