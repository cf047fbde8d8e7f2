"""Recognises pairs finished by an earlier run, by their reports."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats import read_report
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import file_digests
from geodiff_plugin.settings import Affects, settings_of

Row = dict[str, Any]


def option_changes(made: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """List the options, by flag, whose values differ in ``made``; ``None`` is an omitted option."""
    changes = []
    for flag, value in wanted.items():
        was = made.get(flag)
        if was != value:
            typed = f"the default of {flag}" if was is None else f"{flag} {was}"
            changes.append(f"made with {typed} instead of {'the default' if value is None else value}")
    return changes


def input_change(name: str) -> str:
    """Return the message about an input whose content has changed."""
    return f"made before {name} changed"


def changed_options(options: DepthOptions, made: Mapping[str, Any]) -> list[str]:
    """Describe how the options of a result differ from these, among options that affect it.

    Skips options that ``made`` lacks because it is from an older version.
    """
    wanted = options.as_json()
    compared = [
        (name, option.flag)
        for name, option in settings_of(DepthOptions).items()
        if name in made and option.affects is not Affects.NOTHING
    ]
    before, now = ({flag: values[name] for name, flag in compared} for values in (made, wanted))
    return option_changes(before, now)


def finished_row(options: DepthOptions) -> Row | None:
    """Return the row of a pair finished by an earlier run; ``None`` if it still has to be processed.

    Raises an error if the result is of other options, or of files whose content has changed.
    """
    assert options.out is not None
    report = read_report(options.out)
    row = _row_if_complete(options.out, report)
    if row is None:
        return None
    changes = changed_options(options, report["arguments"])
    changes += map(input_change, _changed_inputs(options, report))
    if changes:
        hint = (
            "Choose a different --out, add --overwrite to repeat all pairs, or remove this folder to "
            "repeat one."
        )
        got = f"{options.out}, {', '.join(changes)}"
        bad_value("--out", "a folder with results of the same options and files", got, hint)
    return row


def _row_if_complete(folder: Path, report: dict[str, Any]) -> Row | None:
    """Return the row of a report; ``None`` if the report is unreadable, or any of its files is missing.

    The report is written last and lists all files, so a folder that has all of them is complete.
    """
    if "arguments" not in report:
        return None
    try:
        row = row_of(report)
        has_files = all((folder / name).stat().st_size > 0 for name in report["files"]["names"])
    except (OSError, KeyError, TypeError):
        return None
    return row if has_files else None


def _changed_inputs(options: DepthOptions, report: dict[str, Any]) -> list[str]:
    """Return the input files whose content has changed since a report, if it states their digests."""
    digests = report.get("pair", {}).get("sha256", {})
    return [path for path, digest in file_digests(options).items() if digests.get(path, digest) != digest]


def _confidence(report: dict[str, Any]) -> float | None:
    """Return the mean confidence of a report; ``None`` if it is unknown or the depth is not trusted."""
    verdict = report["verdict"]
    alone: float | None = verdict["facts"].get("matched_fraction", {}).get("confidence")
    if verdict["status"] != "trusted" or alone is None:
        return None
    smoothed: float | None = report.get("temporal_smoothing", {}).get("confidence_mean")
    return alone if smoothed is None else smoothed


def _texts(report: dict[str, Any], *severities: str) -> list[str]:
    """Return the messages of a report's findings with one of these severities."""
    return [each["text"] for each in report.get("findings", ()) if each["severity"] in severities]


def depth_columns(report: dict[str, Any]) -> Row:
    """Return the columns of a table row that describe the depth: nearest, median, farthest, confidence."""
    depth = report["depth"]
    return {
        "near_m": depth["min_m"],
        "median_m": depth["median_m"],
        "far_m": depth["max_m"],
        "confidence": _confidence(report),
    }


def row_of(report: dict[str, Any]) -> Row:
    """Return the table row of a report, including why the pair is not trusted."""
    verdict = report["verdict"]
    return {
        **depth_columns(report),
        "verdict": verdict["status"],
        "seconds": round(sum(report["seconds"].values()), 3),
        "message": " ".join(_texts(report, "warning", "remark")) or None,
        "reasons": " ".join(verdict["reasons"]),
        "codes": " ".join(message["code"] for message in report.get("findings", ())) or None,
    }
