"""Pairs that an earlier run has finished, by their reports."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from geodiff_plugin._checks import bad_value
from geodiff_plugin.config import Affects, affected
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.jobs.changes import input_change, option_changes
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.report import read_report
from geodiff_plugin.options import flag_of

Row = dict[str, Any]


def file_digests(options: DepthOptions) -> dict[str, str]:
    """SHA-256 by path of the readable files that a pair is made from."""
    digests = {}
    for path in options.read_files():
        with suppress(OSError):  # its reader says why
            digests[str(path)] = file_digest(path)
    return digests


def changed_options(options: DepthOptions, made: Mapping[str, Any]) -> list[str]:
    """In words, how the options that a result was made with differ from these, where that changes it.

    Of an option that ``made`` does not know, as it is a newer one, nothing is said.
    """
    wanted, of_fields = options.as_json(), DepthOptions.__dataclass_fields__
    names = [name for name in wanted if name in made and affected(of_fields[name]) is not Affects.NOTHING]
    before, now = ({flag_of(of_fields[name]): values[name] for name in names} for values in (made, wanted))
    return option_changes(before, now)


def finished_row(options: DepthOptions) -> Row | None:
    """The row of a pair that an earlier run has finished; ``None`` where it is still to be done.

    A result of other options, or of files whose content has changed since, is an error.
    """
    assert options.out is not None
    report = read_report(options.out)
    try:
        made, row = report["arguments"], row_of(report)
        # The report is written last and names every file, so a folder that holds all of them is whole.
        if not all((options.out / name).stat().st_size > 0 for name in report["files"]["names"]):
            return None
    except (OSError, KeyError, TypeError):
        return None
    changes = changed_options(options, made)
    digests = report.get("pair", {}).get("sha256", {})
    changed = [path for path, digest in file_digests(options).items() if digests.get(path, digest) != digest]
    changes += map(input_change, changed)
    if changes:
        cure = "Name another --out, add --overwrite to repeat all pairs, or remove this folder to repeat one."
        got = f"{options.out}, {', '.join(changes)}"
        bad_value("--out", "a folder of results of the same options and files", got, cure)
    return row


def row_of(report: dict[str, Any]) -> Row:
    """What the table says of a pair, and why it is not to be trusted."""
    depth, verdict = report["depth"], report["verdict"]
    return {
        "near_m": depth["min_m"],
        "median_m": depth["median_m"],
        "far_m": depth["max_m"],
        "verdict": verdict["status"],
        "confidence": verdict["indicators"]["confidence"] if verdict["status"] == "trusted" else None,
        "seconds": round(sum(report["seconds"].values()), 3),
        "message": " ".join(report["warnings"]) or None,
        "reasons": " ".join(verdict["reasons"]),
        "codes": " ".join(message["code"] for message in report.get("messages", ())) or None,
    }
