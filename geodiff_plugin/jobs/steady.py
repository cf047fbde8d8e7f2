"""Depth of the frames of a video, averaged where neighbours agree (``geodiff depth --steady``)."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from geodiff_plugin._checks import InputError
from geodiff_plugin.capture.results import AGREED, ALONE, FinishedFrame, read_agreed, write_steady
from geodiff_plugin.formats.out import REPORT, reason_of, write_text
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef, options_of
from geodiff_plugin.jobs.reading import read_pair
from geodiff_plugin.jobs.report import read_report
from geodiff_plugin.jobs.telling import Tell, silent
from geodiff_plugin.jobs.writing import write_into

#: Scenes of which the beginning is told.
MOST_SCENES = 9


def write_steady_frames(
    options: DepthOptions,
    refs: Sequence[PairRef],
    views: Callable[[PairRef], Sequence[np.ndarray] | None],
    tell: Tell = silent,
) -> None:
    """Average the depth of every finished frame with its neighbours' where they agree, and report it.

    ``views`` gives left and right view of a pair of frames, ``None`` for one of files; ``tell`` hears where
    scenes begin.
    """
    assert options.out is not None
    folders = [options.out / ref.name for ref in refs]
    reports = [read_report(folder) for folder in folders]

    def note(i: int, files: Iterable[str], **entries: Any) -> None:
        """List the files, which a later run with --overwrite then replaces."""
        reports[i]["files"]["names"] = sorted({*reports[i]["files"]["names"], *files})
        write_text(folders[i] / REPORT, json.dumps(reports[i] | entries, indent=2) + "\n")

    def picture(i: int) -> np.ndarray:
        note(i, [f"{name}.npy" for name in ALONE])
        return read_pair(options_of(refs[i], options), views(refs[i])).left

    try:
        frames = [
            FinishedFrame(folder, np.reshape(report["K"], (3, 3)), report["unit"])
            for folder, report in zip(folders, reports, strict=True)
        ]
        with warnings.catch_warnings(action="ignore"):  # the run of the pair has warned
            scenes = write_steady(frames, picture)
        for i, scene in enumerate(scenes):
            if options.into is not None:
                depth, confidence = read_agreed(folders[i])
                known = depth * (confidence > 0)
                reports[i]["into"] = write_into(folders[i], known, frames[i].K, options.into)
            note(i, [f"{name}.npy" for name in AGREED], steady={"scene": scene})
    except OSError as error:
        raise InputError(f"--steady ended ({reason_of(error)}); the same command resumes.") from error
    begins = [ref.name for k, ref in enumerate(refs) if k and scenes[k] != scenes[k - 1]]
    if begins:
        tell(
            f"--steady: scenes begin at {', '.join(begins[:MOST_SCENES])}; depth is not averaged across them."
        )
