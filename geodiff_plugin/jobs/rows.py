"""A pair as a row of a dataset: reading it, and the columns of its result. Nothing here imports Ray."""

from __future__ import annotations

import tempfile
from dataclasses import fields, replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats import depth_mm, save_png, sigma_mm
from geodiff_plugin.jobs.finished import Row, row_of
from geodiff_plugin.jobs.options import DepthOptions, check_files
from geodiff_plugin.jobs.pairs import PairRef, options_of
from geodiff_plugin.jobs.reading import PairReader, begin_pair
from geodiff_plugin.jobs.records import PairRun, ReadPair
from geodiff_plugin.jobs.report import build_report, single_map

#: Columns with the two images, as paths or bytes of image files.
IMAGES = ("left", "right")
#: Columns with their masks, the same.
MASKS = ("mask", "right_mask")
#: Columns with a matrix, with the corresponding option and shape.
MATRICES = {"K_left": ("k", (3, 3)), "K_right": ("k_right", (3, 3)), "E": ("e", (4, 4))}
#: Columns of a result and their Arrow types; all but ``error`` are ``None`` if a pair failed.
COLUMNS = {
    "depth_mm": "binary",
    "confidence": "binary",
    "sigma_mm": "binary",
    **dict.fromkeys(("height", "width"), "int32"),
    **dict.fromkeys(("fx", "fy", "cx", "cy"), "float64"),
    "unit": "string",
    **dict.fromkeys(("near_m", "median_m", "far_m"), "float64"),
    **dict.fromkeys(("verdict", "codes"), "string"),
    "seconds": "float64",
    "error": "string",
}


def check_names(options: Row) -> None:
    """Raise an error for options that ``DepthOptions`` does not have."""
    known = {each.name for each in fields(DepthOptions)}
    if unknown := sorted(set(options) - known):
        bad_value("an option", "one of geodiff_plugin.jobs.DepthOptions", ", ".join(unknown))


def read_columns(base: DepthOptions, row: Row) -> ReadPair:
    """Read a pair from the columns of its row, which override the options of all rows.

    Writes bytes and matrices to a temporary folder, so that each kind of input has one reader with its
    checks.

    Raises:
        InputError: the errors of ``geodiff depth`` for such a pair.
    """
    known = {each.name for each in fields(DepthOptions)} | set(MATRICES)
    given = {name: value for name, value in row.items() if name in known and value is not None}
    with tempfile.TemporaryDirectory() as folder:
        options = replace(base, **dict(_as_option(*each, Path(folder)) for each in given.items()))
        options.check_all()
        options.camera_source()
        check_files(options)
        return begin_pair(options)


def _as_option(name: str, value: Any, folder: Path) -> tuple[str, Any]:
    """Convert a column to an option and its value."""
    if isinstance(value, bytes):
        (folder / name).write_bytes(value)
        return name, folder / name
    if name in MATRICES:
        option, shape = MATRICES[name]
        np.save(folder / f"{name}.npy", np.asarray(value, np.float64).reshape(shape))
        return option, folder / f"{name}.npy"
    if name == "calib":
        return name, tuple(map(Path, [value] if isinstance(value, str) else value))
    return name, Path(value) if name in (*IMAGES, *MASKS) else value


def read_ref(options: DepthOptions, ref: PairRef) -> ReadPair:
    """Read a pair found by a command, with the options of that command."""
    own = options_of(ref, options)
    if ref.frame is None:
        own.check_all()
        own.camera_source()
    check_files(own, images=ref.frame is None)
    return _reader(options).read(ref, own)


@cache
def _reader(options: DepthOptions) -> PairReader:
    """Return the reader of a command's pairs, one per process, with its open videos."""
    return PairReader(options)


def result_columns(run: PairRun) -> Row:
    """Return ``COLUMNS`` of a pair: maps as PNG, their camera, and the fields of the run's table."""
    report = build_report(run)
    report["seconds"] = run.log.seconds
    reported = row_of(report)
    K = np.asarray(run.output.K)[0].astype(float)
    depth_m = single_map(run.output.prediction)
    confidence, sigma = run.output.confidence, run.output.sigma
    named = ("near_m", "median_m", "far_m", "verdict", "codes", "seconds")
    return {name: reported[name] for name in named} | {
        "depth_mm": _png(depth_mm(depth_m * single_map(run.output.valid))),
        "confidence": None if confidence is None else _png(_in_255ths(single_map(confidence))),
        "sigma_mm": None if sigma is None else _png(sigma_mm(single_map(sigma))),
        "height": depth_m.shape[0],
        "width": depth_m.shape[1],
        **{"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]},
        "unit": run.output.unit,
        "error": None,
    }


def _in_255ths(fraction: np.ndarray) -> np.ndarray:
    return np.rint(fraction * 255).astype(np.uint8)


def _png(values: np.ndarray) -> bytes:
    file = BytesIO()
    save_png(Image.fromarray(values), file)
    return file.getvalue()
