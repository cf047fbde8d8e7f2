"""``geodiff depth`` on a recorded bag: its pairs through the run over many, then one bag of depth images."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.options import PARAMETERS, DepthOptions
from geodiff_plugin.cli.pairs import start_many
from geodiff_plugin.cli.terminal import say
from geodiff_plugin.formats.bags import BAG_SUFFIXES, Stamp, list_pairs, stereo_calibration, write_depth_bag
from geodiff_plugin.formats.out import write_text


def run_bag(options: DepthOptions) -> None:
    """Depth of every pair of a bag.

    The results lie in a folder beside ``--out``, named ``NAME-frames``, from which the same command goes on
    after it was interrupted; the bag is written when all pairs are done, without those that failed.

    Args:
        options: as typed; LEFT is a bag.

    Raises:
        InputError: naming the option or the file.
    """
    out, topics = options.out or Path("depth.mcap"), options.bag_topics()
    if out.suffix not in BAG_SUFFIXES or out.is_dir():
        bad_value("--out", f"a file that ends in {' or '.join(BAG_SUFFIXES)}, as LEFT is a bag", out)
    if out.exists() and not options.overwrite:
        bad_value("--out", "a new file", f"{out}, which exists", "Name another, or add --overwrite.")
    pairs, frame_id = list_pairs(options.left, topics, options.tolerance), "left"
    frames = out.with_name(f"{out.stem}-frames")
    if not options.calib and all(getattr(options, name) is None for name in (*PARAMETERS, "k", "e")):
        texts, frame_id = stereo_calibration(options.left, topics)
        files = [_written(frames / f"camera_info_{n}.yaml", text) for n, text in enumerate(texts)]
        options = replace(options, calib=tuple(files))
    refs = start_many(replace(options, out=frames))
    from geodiff_plugin.cli.many import run_many

    failed: str | int | None = None
    try:
        run_many(replace(options, out=frames), refs)
    except SystemExit as leaving:  # some pairs failed, and the table says which
        failed = leaving.code

    def results() -> Iterator[tuple[Stamp, np.ndarray, np.ndarray]]:
        for ref, (stamp, _) in zip(refs, pairs, strict=True):
            report = frames / ref.name / "report.json"
            if report.exists():
                K = np.reshape(json.loads(report.read_text(encoding="utf-8"))["K"], (3, 3))
                yield stamp, np.load(frames / ref.name / "depth.npy", allow_pickle=False), K

    count = write_depth_bag(out, results(), frame_id, options.encoding)
    if not options.quiet:
        say(f"{out}: {count} depth images ({options.encoding}) of {len(pairs)} pairs")
    if failed is not None:
        sys.exit(failed)


def _written(path: Path, text: str) -> Path:
    """A file with this text; one that has it already stays, so that results that were made by it count."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        write_text(path, text)
    return path
