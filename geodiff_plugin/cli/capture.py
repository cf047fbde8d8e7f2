"""``geodiff capture``: depth of the frames of a walk with a camera."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from geodiff_plugin.capture.options import CaptureOptions
from geodiff_plugin.capture.run import run_capture
from geodiff_plugin.cli.outputs import write_maps
from geodiff_plugin.cli.terminal import collected_warnings, say


def run_and_report(options: CaptureOptions) -> None:
    """Depth of every frame, the answer on stdout, and exit code 1 where a frame failed."""
    with collected_warnings():
        report = run_capture(options, write_maps, say)
    print(json.dumps(report, indent=2) if options.json else _summary(report, options.out))
    if any("error" in frame for frame in report["frames"]):
        sys.exit(1)


def _summary(report: dict[str, Any], out: Path) -> str:
    depths = sorted(frame["depth"]["median"] for frame in report["frames"] if "error" not in frame)
    line = f"{len(depths)} of {len(report['frames'])} frames"
    if depths:
        unit = "m" if report["unit"] else "units of the poses"
        line += f", median depth {depths[len(depths) // 2]:.2f} {unit}"
    return f"{line} -> {out}/"
