"""Averages the depth of video frames where neighbours agree (``geodiff depth --temporal-smoothing``)."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera
from geodiff_plugin.capture.results import AGREED, ALONE, FIGURES, FinishedFrame, write_smoothed
from geodiff_plugin.findings import some_names
from geodiff_plugin.formats import REPORT, read_report, reason_of, write_text
from geodiff_plugin.jobs.notices import Notify, silent
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef, options_of
from geodiff_plugin.jobs.reading import read_pair
from geodiff_plugin.jobs.report import known_sigma, valid_depth
from geodiff_plugin.jobs.writing import (
    DEPTH_REPROJECTED,
    SIGMA_REPROJECTED,
    thresholds,
    write_reprojected,
)


@dataclass
class _Result:
    """The result of a frame: its folder, and the content of its report."""

    folder: Path
    report: dict[str, Any]

    @property
    def frame(self) -> FinishedFrame:
        """Return folder, K and unit of its maps."""
        return FinishedFrame(self.folder, np.reshape(self.report["K"], (3, 3)), self.report["unit"])

    def add(self, names: Iterable[str], **entries: Any) -> None:
        """Add files to those listed in the report, so that a later run with --overwrite replaces them."""
        files = self.report["files"]
        files["names"] = sorted({*files["names"], *names})
        write_text(self.folder / REPORT, json.dumps(self.report | entries, indent=2) + "\n")


def write_smoothed_frames(
    options: DepthOptions,
    refs: Sequence[PairRef],
    frames_of: Callable[[PairRef], Sequence[np.ndarray] | None],
    notify: Notify = silent,
) -> None:
    """Average the depth of each finished frame with its neighbours' where they agree, and update its report.

    Args:
        options: options of the run, with ``out``.
        refs: the frames, each with a result.
        frames_of: returns left and right view of a pair of frames, ``None`` for a pair of files.
        notify: receives a line with the frames at which scenes start.

    Raises:
        InputError: unreadable or unwritable files.
    """
    assert options.out is not None
    folders = [options.out / ref.name for ref in refs]
    results = [_Result(folder, read_report(folder)) for folder in folders]

    def image(i: int) -> np.ndarray:
        results[i].add(f"{name}.npy" for name in ALONE)
        return read_pair(options_of(refs[i], options), frames_of(refs[i]), packing=refs[i].packing).left

    try:
        with warnings.catch_warnings(action="ignore"):  # the run of the pair has issued them
            # Smoothing may replace a depth by one with a larger sigma, so the thresholds apply again.
            holes = thresholds(options) if options.holes else None
            scenes = write_smoothed([result.frame for result in results], image, holes)
        for result, scene in zip(results, scenes, strict=True):
            names = [*(f"{name}.npy" for name in AGREED), *FIGURES]
            if options.reproject is not None:
                maps = valid_depth(result.folder), known_sigma(result.folder)
                result.report["reproject"] = write_reprojected(
                    result.folder, *maps, Camera(result.frame.K), options.target_camera()
                )
                names += DEPTH_REPROJECTED + SIGMA_REPROJECTED
            result.add(names, temporal_smoothing={"scene": scene})
    except OSError as error:
        raise InputError(
            f"--temporal-smoothing failed ({reason_of(error)}). Run the same command again to resume."
        ) from error
    begins = [ref.name for k, ref in enumerate(refs) if k and scenes[k] != scenes[k - 1]]
    if begins:
        notify(
            f"--temporal-smoothing: scenes start at {some_names(begins)}; depth is not averaged across them."
        )
