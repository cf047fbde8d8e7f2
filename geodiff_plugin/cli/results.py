"""Implement ``geodiff video``, ``merge``, ``submit`` and ``convert``, which print one line each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from geodiff_plugin.cli.run import answer_rows
from geodiff_plugin.jobs import BENCHMARKS, merge_shards, say, write_submission, write_video
from geodiff_plugin.priors.convert import convert_prior


def run_video(
    frames: Sequence[Path], out: Path, fps: float, near: float | None, far: float | None, overwrite: bool
) -> None:
    """Write the video and print its length."""
    seconds = write_video(frames, out, fps, near, far, overwrite)
    print(f"{len(frames)} frame{'s' * (len(frames) > 1)}, {seconds:.1f} s -> {out}")


def run_merge(folder: Path, json: bool) -> None:
    """Merge the tables and print the same output as an unsharded run."""
    answer_rows(merge_shards(folder), folder, as_json=json)


def run_submit(results: Sequence[Path], to: str, out: Path, method: str) -> None:
    """Write the submission files and print their location."""
    count = write_submission(results, to, out, method)
    say(f"{out}: {count} pairs for {to} ({BENCHMARKS[to]})")


def run_convert(paths: Sequence[Path], part: str | None = None, space: str | None = None) -> None:
    """Convert the weights and print the output folder."""
    kind = convert_prior(paths, part, space)
    source, target = paths[-2:]
    print(f"{source} ({kind}) -> {target}; use it with --prior {target}")
