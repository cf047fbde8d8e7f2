"""Depth of every pair of a bag, as a bag (``geodiff depth LEFT.mcap``)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats import recordings
from geodiff_plugin.formats.out import check_new_file, write_text
from geodiff_plugin.formats.target import frame_of_target, read_target_camera
from geodiff_plugin.jobs.finished import Row
from geodiff_plugin.jobs.many import depth_pairs
from geodiff_plugin.jobs.options import PARAMETERS, DepthOptions
from geodiff_plugin.jobs.pairs import start_many
from geodiff_plugin.jobs.report import read_report
from geodiff_plugin.jobs.telling import Tell, silent
from geodiff_plugin.jobs.writing import INTO


@dataclass(frozen=True)
class BagResult:
    """The bag that was written, how many depth images it holds, and the row of every pair.

    ``frames`` is the folder with the results of the pairs.
    """

    path: Path
    frames: Path
    images: int
    rows: list[Row]


def depth_bag(options: DepthOptions, *, tell: Tell = silent, progress: bool = False) -> BagResult:
    """What ``geodiff depth`` does with a bag: its pairs into the folder ``NAME-frames``, then one bag.

    Args:
        options: of the command; ``out`` is the bag to be written, ``depth.mcap`` by default. Its images
            are of the camera ``into``, if one is given.
        tell: takes the lines for the user.
        progress: whether a bar on stderr counts the pairs.
    """
    out, topics = options.out or Path("depth.mcap"), options.bag_topics()
    if out.suffix not in recordings.BAG_SUFFIXES or out.is_dir():
        expected = f"a file that ends in {' or '.join(recordings.BAG_SUFFIXES)}, as LEFT is a bag"
        bad_value("--out", expected, out)
    options.refuse(["shard", "engine"], "{} cannot be used with a bag, which is written as one.")
    check_new_file(out, options.overwrite)
    pairs = recordings.list_pairs(options.left, topics, options.tolerance)
    frames = out.with_name(f"{out.stem}-frames")
    options, frame_id = _with_its_cameras(replace(options, out=frames), frames)
    refs = start_many(options, tell)
    rows = depth_pairs(options, refs, tell=tell, progress=progress)

    camera = None if options.into is None else read_target_camera(options.into)

    def results() -> Iterator[recordings.BagFrame]:
        for ref, (stamp, _) in zip(refs, pairs, strict=True):
            if report := read_report(frames / ref.name):
                folder = frames / ref.name
                K = report["K"] if camera is None else camera.K
                depth_m = _valid_depth(folder) if camera is None else _loaded(folder / INTO[0])
                yield recordings.BagFrame(stamp, depth_m, np.reshape(K, (3, 3)))

    frame_id = frame_id if options.into is None else frame_of_target(options.into)
    count = recordings.write_depth_bag(out, results(), frame_id, options.encoding)
    return BagResult(out, frames, count, rows)


def _loaded(path: Path) -> np.ndarray:
    values: np.ndarray = np.load(path, allow_pickle=False)
    return values


def _valid_depth(folder: Path) -> np.ndarray:
    """The depth of a result's folder, ``(H, W)`` metres, 0 where its confidence is 0: there is none."""
    depth_m, confidence = _loaded(folder / "depth.npy"), folder / "confidence.npy"
    return depth_m * (_loaded(confidence) > 0) if confidence.is_file() else depth_m


def _with_its_cameras(options: DepthOptions, folder: Path) -> tuple[DepthOptions, str]:
    """The calibration of a bag in files of a folder unless cameras are given, and its frame's name."""
    if options.calib or any(getattr(options, name) is not None for name in (*PARAMETERS, "k", "e")):
        return options, "left"
    texts, frame_id = recordings.stereo_calibration(options.left, options.bag_topics())
    files = tuple(folder / f"camera_info_{number}.yaml" for number in range(len(texts)))
    for file, text in zip(files, texts, strict=True):
        if not file.is_file() or file.read_text(encoding="utf-8") != text:  # else results were made by it
            write_text(file, text)
    return replace(options, calib=files), frame_id
