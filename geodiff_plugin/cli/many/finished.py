"""Pairs that an earlier run has finished.

Data flow: the folder of a pair, what is asked of it -> its report, nothing, or why it is not what is asked.
Paper: none.

Nothing here imports torch.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import bad_value
from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.many.digests import file_digests
from geodiff_plugin.cli.messages import in_options

__all__ = ["distrust", "finished_report"]

#: As they are typed, where that is not the name with dashes.
TYPED = {"left": "LEFT", "right": "RIGHT", "k": "--K", "e": "--E", "k_right": "--K-right"}
#: Options by which a finished result is no other one.
NOT_OF_THE_RESULT = {"out", "overwrite", "quiet", "json", "show", "strict", "device"}


def finished_report(arguments: DepthArguments) -> dict[str, Any] | None:
    """The report of a pair that is finished; ``None`` where it is still to be done.

    The report is written last and names every file, so a folder that holds all of them is whole.

    Args:
        arguments: of this pair alone.

    Raises:
        ValueError: it was made with other options, or from files whose content has changed since.
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
    _check_files(arguments, report)
    return report


def distrust(arguments: DepthArguments, report: dict[str, Any]) -> str | None:
    """Why ``--strict`` refuses the result of a finished pair; ``None`` where it is trusted.

    Args:
        arguments: of this pair alone.
        report: of ``finished_report``.
    """
    judgement = report["judgement"]
    if judgement["trusted"]:
        return None
    return in_options(f"The depth in {arguments.out} is not to be trusted: {' '.join(judgement['reasons'])}")


def _check_files(arguments: DepthArguments, report: dict[str, Any]) -> None:
    """Refuse a result of files that have changed; only a run over many pairs notes what they held."""
    made = report.get("pair", {}).get("sha256", {})
    changed = [path for path, digest in file_digests(arguments).items() if made.get(path, digest) != digest]
    if changed:
        got = f"{arguments.out}, made before {' and '.join(changed)} changed"
        cure = "Name another --out, add --overwrite to repeat all pairs, or remove this folder to repeat one."
        bad_value("--out", "a folder of results of the same files", got, cure)


def _as_option(name: str, value: Any) -> str:
    """An option, or one of the views, as it stands on the command line."""
    option = TYPED.get(name, f"--{name.replace('_', '-')}")
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
