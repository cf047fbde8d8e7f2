"""Averages the depth of video frames where neighbours agree (``geodiff depth --temporal-smoothing``)."""

from __future__ import annotations

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
from geodiff_plugin.jobs.report import report_text, smoothed_entries
from geodiff_plugin.jobs.writing import (
    DEPTH_REPROJECTED,
    PREVIEWS,
    SIGMA_REPROJECTED,
    thresholds,
    write_previews,
    write_reprojected,
)
from geodiff_plugin.types import DepthFrame


@dataclass
class _Result:
    """The result of a frame: its folder, and the content of its report."""

    folder: Path
    report: dict[str, Any]

    @property
    def frame(self) -> FinishedFrame:
        """Return folder, K and unit of its maps."""
        return FinishedFrame.of(self.folder, self.report)

    def add(self, names: Iterable[str], **entries: Any) -> None:
        """Add entries to the report, and files to its list, so that a run with --overwrite replaces them."""
        files = self.report["files"]
        files["names"] = sorted({*files["names"], *names})
        self.report |= entries
        write_text(self.folder / REPORT, report_text(self.report) + "\n")


def write_smoothed_frames(
    options: DepthOptions,
    refs: Sequence[PairRef],
    frames_of: Callable[[PairRef], Sequence[np.ndarray] | None],
    notify: Notify = silent,
) -> list[dict[str, Any]]:
    """Average the depth of each finished frame with its neighbours' where they agree.

    Its maps and the files drawn from them are written again, its report last.

    Args:
        options: options of the run, with ``out``.
        refs: the frames, each with a result.
        frames_of: returns left and right view of a pair of frames, ``None`` for a pair of files.
        notify: receives a line with the frames at which scenes start.

    Returns:
        The reports of the frames.

    Raises:
        InputError: unreadable or unwritable files.
    """
    assert options.out is not None
    folders = [options.out / ref.name for ref in refs]
    results = [_Result(folder, read_report(folder)) for folder in folders]

    def left(i: int) -> np.ndarray:
        return read_pair(options_of(refs[i], options), frames_of(refs[i]), packing=refs[i].packing).left

    def image(i: int) -> np.ndarray:
        results[i].add(_npy(ALONE))
        return left(i)

    scenes = list[int]()
    try:
        with warnings.catch_warnings(action="ignore"):  # the run of the pair has issued them
            # Smoothing may replace a depth by one with a larger sigma, so the thresholds apply again.
            holes = thresholds(options) if options.holes else None
            smoothed = write_smoothed([result.frame for result in results], image, holes)
            for i, (scene, maps) in enumerate(smoothed):
                _update(results[i], scene, maps, left(i), options)
                scenes.append(scene)
    except OSError as error:
        raise InputError(
            f"--temporal-smoothing failed for {error.filename or options.out} ({reason_of(error)}). Run the "
            "same command again to resume."
        ) from error
    begins = [ref.name for k, ref in enumerate(refs) if k and scenes[k] != scenes[k - 1]]
    if begins:
        notify(
            f"--temporal-smoothing: scenes start at {some_names(begins)}; depth is not averaged across them."
        )
    return [result.report for result in results]


def _npy(maps: Iterable[str]) -> list[str]:
    """Return the files of maps."""
    return [f"{name}.npy" for name in maps]


def _update(result: _Result, scene: int, maps: DepthFrame, left: np.ndarray, options: DepthOptions) -> None:
    """Write the files of a frame that depend on its smoothed maps, then its report."""
    frame, report = result.frame, result.report
    written = [*_npy(AGREED), *FIGURES, *PREVIEWS]
    entries = smoothed_entries(report, maps, options.holes)
    report["files"] |= write_previews(frame, maps, left, thresholds(options))
    if options.reproject is not None:
        depth_m, target = maps.depth * (maps.confidence > 0), options.target_camera()
        entries["reproject"] = write_reprojected(result.folder, depth_m, maps.sigma, Camera(frame.K), target)
        written += DEPTH_REPROJECTED + SIGMA_REPROJECTED
    unchanged = sorted({*report["files"]["names"]} - {*written, *_npy(ALONE), REPORT})
    entries["temporal_smoothing"] |= {"scene": scene, "unchanged_files": unchanged}
    result.add(written, **entries)
