"""Pairs that an earlier run has finished.

Data flow: the folder of a pair, what is asked of it -> its report, nothing, or why it cannot be gone on with.
Paper: none.

Nothing here imports torch.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.arguments import DepthArguments

__all__ = ["finished_report"]

#: Options by which a finished result is no other one.
NOT_OF_THE_RESULT = {"out", "overwrite", "quiet", "json", "show", "strict", "device"}


def finished_report(arguments: DepthArguments) -> dict[str, Any] | None:
    """The report of a pair that is finished; ``None`` where it is still to be done.

    The report is written last and names every file, so a folder that holds all of them is whole.

    Args:
        arguments: of this pair alone.

    Raises:
        ValueError: it was made with other options.
    """
    report = _report(arguments.out)
    if report is None:
        return None
    wanted, made = arguments.as_json(), report["arguments"]
    others = sorted(
        name
        for name in wanted
        if name not in NOT_OF_THE_RESULT and wanted[name] != made.get(name, wanted[name])
    )
    if others:
        earlier, now = (", ".join(_as_option(name, of[name]) for name in others) for of in (made, wanted))
        cure = "Name another --out, or add --overwrite."
        got = f"{arguments.out}, made {earlier} and now asked for {now}"
        bad_value("--out", "a folder of results of the same options", got, cure)
    return report


def _as_option(name: str, value: Any) -> str:
    """An option as it stands on the command line."""
    option = f"--{name.replace('_', '-')}"
    if value is None or value is False or value == []:
        return f"without {option}"
    shown = " ".join(map(str, value)) if isinstance(value, list) else str(value)
    return f"with {option}" if value is True else f"with {option} {shown}"


def _report(folder: Path) -> dict[str, Any] | None:
    """What ``report.json`` says, where it can be read and every file that it names is there."""
    try:
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        names, _ = report["files"]["names"], report["arguments"]
        whole = all((folder / name).stat().st_size > 0 for name in names)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return report if whole else None
