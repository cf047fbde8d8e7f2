"""The plan of phase 1 for one image: defines what runs concurrently.

On CUDA the device matches the views while the CPU works in parallel:

1. On the CPU, in three tasks: grey images, then features of downscaled ones and the fit of the poses, and the
   checks of the images. This starts before it is known whether the images are clean, and is repeated if they
   are not.
2. On the device: cleaning, the cost volume and its matches, with the poses as given, since most of them fit.
3. Vertical lines of a rectified pair and, after the matches, its row matching, with their checks.
4. If the poses fit, the rest of their check, which changes no view. If they do not, the device matches again.

Steps 3 and 4 may still run during phase 2: ``complete`` waits for them. On other devices both would compete
for the same cores, so every task finishes at creation (``BackgroundTask``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from geodiff_plugin._internal.threads import BackgroundTask, sent_to_cpu
from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.pose_check import CheckedPoses, image_facts
from geodiff_plugin.matching import Matches
from geodiff_plugin.matching.rows import RowImages, RowMatches, match_rows, row_matches
from geodiff_plugin.pose.fit import PoseFit, fit_of_small, measure_fit, posed_greys
from geodiff_plugin.trust import FactSheet, RowsStage, measure, vertical_lines


class CheckedRows(NamedTuple):
    """Row matches of a rectified pair and the facts of their checks."""

    matches: RowMatches
    facts: FactSheet


@dataclass(frozen=True, eq=False)
class EvidencePlan:
    """The evidence of one image and the tasks that complete it."""

    evidence: Evidence  # everything that phase 2 needs
    rows: BackgroundTask[CheckedRows] | None = None
    poses: BackgroundTask[CheckedPoses] | None = None

    def complete(self) -> Evidence:
        """Wait for all tasks and return the evidence with their results."""
        evidence = self.evidence
        if self.poses is not None:
            poses = self.poses.result()
            evidence = replace(evidence, report=poses.report, facts=evidence.facts | poses.facts)
        if self.rows is not None:
            rows = self.rows.result()
            evidence = replace(evidence, rows=rows.matches, facts=evidence.facts | rows.facts)
        return evidence

    def close(self) -> None:
        """Wait until all tasks have ended, so that the memory they read is not reused earlier."""
        for task in (self.rows, self.poses):
            if task is not None:
                task.close()


class FitTasks(NamedTuple):
    """Tasks that compute on the CPU whether poses fit."""

    images: BackgroundTask[FactSheet]
    small: BackgroundTask[PoseFit]  # ``fit_of_small``, finished first
    fit: BackgroundTask[PoseFit]


def fit_in_background(posed: PosedViews) -> FitTasks:
    """Start the pose fit of views whose left image, at least, is on the device."""
    device = posed.left.image_01.device
    greys = BackgroundTask(lambda: posed_greys(posed), device)
    small = BackgroundTask(lambda: fit_of_small(greys.result()), device)
    images = BackgroundTask(lambda: image_facts(greys.result()), device)
    return FitTasks(images, small, BackgroundTask(lambda: measure_fit(greys.result(), small.result), device))


class RowTasks:
    """Row matching of a rectified pair: rows are sent to the CPU at once and matched when the range is known.

    Args:
        rgb_images: the rectified pair.
        size: native ``(H, W)`` of the left image.
    """

    def __init__(self, rgb_images: RowImages, size: tuple[int, int]) -> None:
        self._images, self._size = rgb_images, size
        sent = sent_to_cpu(rgb_images.levels)
        self._greys: Callable[[], tuple[np.ndarray, np.ndarray]] = lambda: rgb_images.greys(sent())
        self._lines = BackgroundTask(lambda: vertical_lines(self._greys()[0]), rgb_images.device)

    def match(self, matches: Matches, points: Matches | None) -> BackgroundTask[CheckedRows]:
        """Match the rows up to the nearest depth among the matches and known points."""
        nearest = matches.inverse_depth.amax()
        if points is not None:
            nearest = torch.maximum(nearest, points.inverse_depth.amax())
        received = sent_to_cpu(nearest)
        rgb_images = self._images

        def work() -> CheckedRows:
            nearest_px = rgb_images.shift_px(float(received()))
            shifts = match_rows(rgb_images, self._greys(), nearest_px)
            stage = RowsStage(
                grey=shifts.grey,
                shift=shifts.shift,
                matched=shifts.known,
                gaps=shifts.gaps,
                lines=self._lines.result(),
                size=self._size,
            )
            return CheckedRows(row_matches(rgb_images, shifts), measure(stage))

        return BackgroundTask(work, rgb_images.device)
