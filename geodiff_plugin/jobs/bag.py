"""Writes the depth of every pair of a bag to a bag (``geodiff depth LEFT.mcap``)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats import check_new_file, frame_of_target, read_report, recordings, write_text
from geodiff_plugin.jobs.camera_sources import given_camera_options
from geodiff_plugin.jobs.finished import Row
from geodiff_plugin.jobs.many import depth_pairs
from geodiff_plugin.jobs.notices import Notify, silent
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import start_many
from geodiff_plugin.jobs.report import known_sigma, valid_depth
from geodiff_plugin.jobs.writing import DEPTH_REPROJECTED, SIGMA_REPROJECTED


@dataclass(frozen=True)
class BagResult:
    """Result of a bag: the written bag, its number of depth images, and the row of every pair.

    ``frames`` is the folder with the results of the pairs.
    """

    path: Path
    frames: Path
    images: int
    rows: list[Row]


def depth_bag(options: DepthOptions, *, notify: Notify = silent, progress: bool = False) -> BagResult:
    """Implement ``geodiff depth`` for a bag: write its pairs to the folder ``NAME-frames``, then one bag.

    Args:
        options: options of the command; ``out`` is the bag to write, ``depth.mcap`` by default. Its images
            are in the camera ``reproject``, if given.
        notify: receives messages for the user.
        progress: whether to count the pairs with a progress bar on stderr.
    """
    out = options.out or Path("depth.mcap")
    topics = options.bag_topics()
    if out.suffix not in recordings.BAG_SUFFIXES or out.is_dir():
        expected = f"a file name ending in {' or '.join(recordings.BAG_SUFFIXES)}, because LEFT is a bag"
        bad_value("--out", expected, out)
    options.raise_input_error(
        ["shard", "engine"], "{} cannot be used with a bag, which is written by one process."
    )
    check_new_file(out, options.overwrite)
    pairs = recordings.list_pairs(options.left, topics, options.tolerance)
    frames = out.with_name(f"{out.stem}-frames")
    options, frame_id = _with_its_cameras(replace(options, out=frames), frames)
    refs = start_many(options, notify)
    rows = depth_pairs(options, refs, notify=notify, progress=progress)

    camera = None if options.reproject is None else options.target_camera()

    def results() -> Iterator[recordings.BagFrame]:
        for ref, (stamp, _) in zip(refs, pairs, strict=True):
            if report := read_report(frames / ref.name):
                folder = frames / ref.name
                if camera is None:
                    K, depth_m = np.reshape(report["K"], (3, 3)), valid_depth(folder)
                    sigma_m = known_sigma(folder)
                else:
                    K, depth_m = camera.K, np.load(folder / DEPTH_REPROJECTED[0])
                    sigma_m = known_sigma(folder, SIGMA_REPROJECTED[0])
                yield recordings.BagFrame(stamp, depth_m, K, sigma_m)

    frame_id = frame_id if options.reproject is None else frame_of_target(options.reproject)
    count = recordings.write_depth_bag(out, results(), frame_id, options.encoding)
    return BagResult(out, frames, count, rows)


def _with_its_cameras(options: DepthOptions, folder: Path) -> tuple[DepthOptions, str]:
    """Write the calibration of a bag to a folder unless cameras are given; also return its frame name."""
    if given_camera_options(options):
        return options, "left"
    texts, frame_id = recordings.stereo_calibration(options.left, options.bag_topics())
    files = tuple(folder / f"camera_info_{number}.yaml" for number in range(len(texts)))
    for file, text in zip(files, texts, strict=True):
        if (
            not file.is_file() or file.read_text(encoding="utf-8") != text
        ):  # rewriting it would invalidate finished results
            write_text(file, text)
    return replace(options, calib=files), frame_id
