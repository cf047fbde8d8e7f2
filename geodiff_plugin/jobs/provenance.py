"""What the frames of a capture were made from: by it a finished frame is told from one of another run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, Self

from geodiff_plugin import __version__
from geodiff_plugin._checks import bad_value
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.capture.results import clear_frame
from geodiff_plugin.config import Affects, affected
from geodiff_plugin.formats.files import find_map
from geodiff_plugin.formats.layouts import CaptureFrame
from geodiff_plugin.formats.out import REPORT, write_text
from geodiff_plugin.jobs.changes import input_change, option_changes
from geodiff_plugin.jobs.journal import Record, fingerprint
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.jobs.report import read_report
from geodiff_plugin.options import flag_of

#: The record of what the frames of a folder were made from.
RECORD = "made_from.json"
#: The summary of a run over a capture.
SUMMARY = "capture.json"
#: Options by which the poses, and the depth of a frame, are made. Files count by their content.
OF_POSES, OF_FRAME = (
    [name for name, field in CaptureOptions.__dataclass_fields__.items() if affected(field) is part]
    for part in (Affects.POSES, Affects.RESULT)
)
#: An option that was not typed, as the record has it.
UNSET = str(None)
#: What is read of every frame, in words; the first two determine the poses.
KINDS = {
    "image": "image",
    "camera": "camera",
    "points": "known points",
    "depth": "measured depth",
    "prior_map": "prior map",
}
OF_POSES_KINDS = ("image", "camera")
#: Frames that a difference names.
MOST_NAMES = 3


@dataclass(frozen=True)
class Provenance:
    """Settings by their options, and digests of what is read of every frame, by kind and name."""

    version: str
    settings: dict[str, str]
    frames: dict[str, dict[str, str]]

    @classmethod
    def of(cls, capture: Capture, options: CaptureOptions) -> Self:
        """Of a run that is about to begin; before the capture is rescaled."""
        fields = CaptureOptions.__dataclass_fields__
        settings = {flag_of(fields[name]): str(getattr(options, name)) for name in (*OF_POSES, *OF_FRAME)}
        each = {frame.name: _digests(frame, capture.unit, options.prior_map) for frame in capture.frames}
        by_kind = {kind: {name: those[kind] for name, those in each.items()} for kind in KINDS}
        return cls(__version__, settings, by_kind)

    @classmethod
    def read(cls, out: Path) -> Self | None:
        """Of the frames that are in a folder; ``None`` where no record says it."""
        try:
            record = json.loads((out / RECORD).read_text(encoding="utf-8"))
            return cls(record["version"], dict(record["settings"]), dict(record["frames"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, out: Path) -> None:
        """Leave the record in a folder."""
        write_text(out / RECORD, json.dumps(vars(self), indent=1) + "\n")

    def for_poses(self) -> Provenance:
        """The part that the poses depend on."""
        flags = [flag_of(CaptureOptions.__dataclass_fields__[name]) for name in OF_POSES]
        settings = {flag: self.settings.get(flag, "") for flag in flags}
        frames = {kind: self.frames.get(kind, {}) for kind in OF_POSES_KINDS}
        return Provenance(self.version, settings, frames)

    @property
    def key(self) -> str:
        """A digest of all of it."""
        return fingerprint(vars(self))

    def differences(self, made: Provenance) -> list[str]:
        """In words, how what was made differs from what this run would make."""
        said = []
        if made.version != self.version:
            said.append(f"made by version {made.version} instead of {self.version}")
        said += option_changes(_typed(made.settings), _typed(self.settings))
        for kind, wanted_of in self.frames.items():
            was_of = made.frames.get(kind, {})
            if kind == OF_POSES_KINDS[0] and set(was_of) != set(wanted_of):
                said.append(f"made of {len(was_of)} frames instead of {len(wanted_of)}, or of other names")
            changed = [name for name in wanted_of if was_of.get(name, wanted_of[name]) != wanted_of[name]]
            if changed:
                some = ", ".join(changed[:MOST_NAMES]) + ", ..." * (len(changed) > MOST_NAMES)
                said.append(input_change(f"the {KINDS[kind]} of {some}"))
        return said


def _typed(settings: Mapping[str, str]) -> dict[str, str | None]:
    """Settings with ``None`` for an option that was not typed."""
    return {flag: None if value == UNSET else value for flag, value in settings.items()}


def _digests(frame: CaptureFrame, unit: str | None, prior_maps: Path | None) -> dict[str, str]:
    """A digest of everything that is read of a frame, by kind; ``unit`` is that of its pose."""
    lens = None if frame.lens is None else (frame.lens.model, frame.lens.coefficients)
    prior_map = None if prior_maps is None else find_map(prior_maps, frame.name)
    return {
        "image": fingerprint(frame.image),
        "camera": fingerprint(frame.E, unit, frame.K, frame.size, lens, frame.as_stored, frame.index),
        "points": fingerprint(frame.points),
        "depth": fingerprint(frame.depth, frame.depth_per_m),
        "prior_map": fingerprint(prior_map),
    }


def begin_frames(made_from: Provenance, out: Path, names: Sequence[str], overwrite: bool) -> None:
    """Refuse frames of other settings or inputs in a folder, or clear them away; leave the record."""
    finished = _finished(out)
    earlier = Provenance.read(out)
    others = [name for name, key in finished.items() if key != made_from.key]
    if others and not overwrite:
        differences = [] if earlier is None else made_from.differences(earlier)
        others = [name for name in others if name in names or differences]
        if others:
            _refuse(
                out, differences or [f"where {', '.join(others[:MOST_NAMES])} has other settings or inputs"]
            )
    for name in others:
        clear_frame(out / name)
    if earlier != made_from:
        (out / SUMMARY).unlink(missing_ok=True)  # of the frames that were
        made_from.write(out)


def check_poses(made_from: Provenance, out: Path, overwrite: bool) -> None:
    """Refuse to solve the poses anew under finished frames that were made with others."""
    earlier = Provenance.read(out)
    if earlier is None or overwrite or not _finished(out):
        return
    if differences := made_from.for_poses().differences(earlier.for_poses()):
        _refuse(out, differences)


def _finished(out: Path) -> dict[str, str | None]:
    """The key of every frame that a folder holds."""
    reports: dict[str, Record] = {
        path.parent.name: read_report(path.parent) for path in out.glob(f"*/{REPORT}")
    }
    return {name: report.get("made_from") for name, report in reports.items() if "frame" in report}


def _refuse(out: Path, differences: Sequence[str]) -> NoReturn:
    cure = "Name another --out, or add --overwrite to repeat all frames."
    bad_value(
        "--out",
        "a folder of frames of the same settings and inputs",
        f"{out}, {', '.join(differences)}",
        cure,
    )
