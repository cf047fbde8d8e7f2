"""A pair as a row of a dataset: how it is read, and the columns of its result. Nothing here imports Ray."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.depth import depth_mm
from geodiff_plugin.formats.files import save_png
from geodiff_plugin.jobs.finished import Row, file_digests, row_of
from geodiff_plugin.jobs.options import DepthOptions, check_files
from geodiff_plugin.jobs.pairs import PairRef, options_of
from geodiff_plugin.jobs.reading import PairInputs, read_pair
from geodiff_plugin.jobs.records import JobLog, PairRun
from geodiff_plugin.jobs.report import build_report, single_map
from geodiff_plugin.jobs.views import Views

#: Columns with the two images, as paths or as the bytes of image files.
IMAGES = ("left", "right")
#: Columns with a matrix, the option that each stands for, and its shape.
MATRICES = {"K_left": ("k", (3, 3)), "K_right": ("k_right", (3, 3)), "E": ("e", (4, 4))}
#: Columns of a result and their types in Arrow; all are ``None`` but ``error`` where a pair has failed.
COLUMNS = {
    "depth_mm": "binary",
    "confidence": "binary",
    **dict.fromkeys(("height", "width"), "int32"),
    **dict.fromkeys(("fx", "fy", "cx", "cy"), "float64"),
    "unit": "string",
    **dict.fromkeys(("near_m", "median_m", "far_m"), "float64"),
    **dict.fromkeys(("verdict", "codes"), "string"),
    "seconds": "float64",
    "error": "string",
}


@dataclass(frozen=True, eq=False)
class ReadPair:
    """A pair between its reading and its guided call; ``entries`` are added to its report."""

    options: DepthOptions
    inputs: PairInputs
    log: JobLog
    entries: Row


@dataclass(frozen=True, eq=False)
class GuidedPair:
    """A pair after its guided call."""

    run: PairRun
    entries: Row


def check_names(options: Row) -> None:
    """Refuse options that ``DepthOptions`` does not have."""
    known = {each.name for each in fields(DepthOptions)}
    if unknown := sorted(set(options) - known):
        bad_value("an option", "one of geodiff_plugin.jobs.DepthOptions", ", ".join(unknown))


def read_columns(base: DepthOptions, row: Row) -> ReadPair:
    """Read a pair from the columns of its row, which replace the options of all rows.

    Bytes and matrices pass through a temporary folder, so that every input has one reader, with its checks.

    Raises:
        InputError: what ``geodiff depth`` says of such a pair.
    """
    known = {each.name for each in fields(DepthOptions)} | set(MATRICES)
    given = {name: value for name, value in row.items() if name in known and value is not None}
    with tempfile.TemporaryDirectory() as folder:
        options = replace(base, **dict(_as_option(*each, Path(folder)) for each in given.items()))
        options.check_all()
        options.cameras_way()
        check_files(options)
        return _read(options, {})


def _as_option(name: str, value: Any, folder: Path) -> tuple[str, Any]:
    """A column as an option and its value."""
    if isinstance(value, bytes):
        (folder / name).write_bytes(value)
        return name, folder / name
    if name in MATRICES:
        option, shape = MATRICES[name]
        np.save(folder / f"{name}.npy", np.asarray(value, np.float64).reshape(shape))
        return option, folder / f"{name}.npy"
    if name == "calib":
        return name, tuple(map(Path, [value] if isinstance(value, str) else value))
    return name, Path(value) if name in IMAGES else value


def read_ref(options: DepthOptions, ref: PairRef) -> ReadPair:
    """Read a pair that a command has found, with the options of that command."""
    own = options_of(ref, options)
    if ref.frame is None:
        own.check_all()
        own.cameras_way()
    check_files(own, photographs=ref.frame is None)
    digests = file_digests(own)  # before the files are read: what changes later is another version
    entries = {"pair": {"name": ref.name, "frame": ref.frame, "sha256": digests}}
    return _read(own, entries, _views(options).of(ref))


@cache
def _views(options: DepthOptions) -> Views:
    """The videos of a command, opened once in each process."""
    return Views(options)


def _read(options: DepthOptions, entries: Row, views: Sequence[np.ndarray] | None = None) -> ReadPair:
    log = JobLog()
    with log.stage("calibration"):
        inputs = read_pair(options, views)
    return ReadPair(options, inputs, log, entries)


def result_columns(pair: GuidedPair) -> Row:
    """``COLUMNS`` of a pair: maps as PNG, the camera of these maps, and what the table of a run says."""
    run = pair.run
    report = build_report(run)
    report["seconds"] = run.log.seconds
    told, K = row_of(report), np.asarray(run.output.K)[0].astype(float)
    depth_m, confidence = single_map(run.output.prediction), run.output.confidence
    named = ("near_m", "median_m", "far_m", "verdict", "codes", "seconds")
    return {name: told[name] for name in named} | {
        "depth_mm": _png(depth_mm(depth_m * single_map(run.output.valid))),
        "confidence": None if confidence is None else _png(_in_255ths(single_map(confidence))),
        "height": depth_m.shape[0],
        "width": depth_m.shape[1],
        **{"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]},
        "unit": run.output.unit,
        "error": None,
    }


def _in_255ths(share: np.ndarray) -> np.ndarray:
    return np.rint(share * 255).astype(np.uint8)


def _png(values: np.ndarray) -> bytes:
    file = BytesIO()
    save_png(Image.fromarray(values), file)
    return file.getvalue()
