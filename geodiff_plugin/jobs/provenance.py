"""Records the inputs of the frames of a capture, to recognise finished frames of another run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, Self

from geodiff_plugin import __version__
from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.capture.results import clear_frame
from geodiff_plugin.findings import some_names
from geodiff_plugin.formats import REPORT, CaptureFrame, find_map, read_report, write_text
from geodiff_plugin.jobs.finished import input_change, option_changes
from geodiff_plugin.jobs.journal import Record, fingerprint
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.settings import Affects, names_affecting, settings_of

#: Name of the file with the record.
RECORD = "made_from.json"
#: Name of the summary of a run over a capture.
SUMMARY = "capture.json"
#: Options that affect the poses, and the depth of a frame. Files count by their content.
OF_POSES, OF_FRAME = (names_affecting(CaptureOptions, part) for part in (Affects.POSES, Affects.RESULT))
#: Value in the record for an option that was not given.
UNSET = str(None)
#: Kinds of inputs of a frame; the first three determine the poses.
KINDS = {
    "image": "image",
    "camera": "camera",
    "mask": "mask",
    "points": "known points",
    "depth": "measured depth",
    "prior_map": "prior map",
}
OF_POSES_KINDS = ("image", "camera", "mask")


@dataclass(frozen=True)
class Provenance:
    """Settings by option, and digests of the inputs of every frame, by kind and name."""

    version: str
    settings: dict[str, str]
    frames: dict[str, dict[str, str]]

    @classmethod
    def of(cls, capture: Capture, options: CaptureOptions) -> Self:
        """Return the record of a run that is about to start, before the capture is rescaled."""
        declared = settings_of(CaptureOptions)
        settings = {declared[name].flag: str(getattr(options, name)) for name in (*OF_POSES, *OF_FRAME)}
        each = {frame.name: _digests(frame, capture.unit, options.prior_map) for frame in capture.frames}
        by_kind = {kind: {name: those[kind] for name, those in each.items()} for kind in KINDS}
        return cls(__version__, settings, by_kind)

    @classmethod
    def read(cls, out: Path) -> Self | None:
        """Read the record of the frames in a folder; ``None`` if it has none."""
        try:
            record = json.loads((out / RECORD).read_text(encoding="utf-8"))
            return cls(record["version"], dict(record["settings"]), dict(record["frames"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, out: Path) -> None:
        """Write the record to a folder."""
        write_text(out / RECORD, json.dumps(vars(self), indent=1) + "\n")

    def for_poses(self) -> Provenance:
        """Return the part that the poses depend on."""
        flags = [settings_of(CaptureOptions)[name].flag for name in OF_POSES]
        settings = {flag: self.settings.get(flag, "") for flag in flags}
        frames = {kind: self.frames.get(kind, {}) for kind in OF_POSES_KINDS}
        return Provenance(self.version, settings, frames)

    @property
    def key(self) -> str:
        """Return a digest of the record."""
        return fingerprint(vars(self))

    def differences(self, made: Provenance) -> list[str]:
        """Describe how the recorded inputs differ from this run's."""
        changes = []
        if made.version != self.version:
            changes.append(f"made by version {made.version} instead of {self.version}")
        changes += option_changes(_given(made.settings), _given(self.settings))
        for kind, wanted_of in self.frames.items():
            was_of = made.frames.get(kind, {})
            if kind == OF_POSES_KINDS[0] and set(was_of) != set(wanted_of):
                changes.append(
                    f"made of {len(was_of)} frames instead of {len(wanted_of)}, or of frames with other names"
                )
            changed = [name for name in wanted_of if was_of.get(name, wanted_of[name]) != wanted_of[name]]
            if changed:
                changes.append(input_change(f"the {KINDS[kind]} of {some_names(changed)}"))
        return changes


def _given(settings: Mapping[str, str]) -> dict[str, str | None]:
    """Replace the value of options that were not given by ``None``."""
    return {flag: None if value == UNSET else value for flag, value in settings.items()}


def _digests(frame: CaptureFrame, unit: str | None, prior_maps: Path | None) -> dict[str, str]:
    """Return a digest per kind of input of a frame; ``unit`` is the unit of its pose."""
    camera = frame.camera
    lens = None if camera.lens is None else (camera.lens.model, camera.lens.coefficients)
    prior_map = None if prior_maps is None else find_map(prior_maps, frame.name)
    return {
        "image": fingerprint(frame.image),
        "camera": fingerprint(frame.E, unit, camera.K, camera.size, lens, frame.as_stored, frame.index),
        "mask": fingerprint(frame.mask),
        "points": fingerprint(frame.points),
        "depth": fingerprint(frame.depth, frame.depth_per_m),
        "prior_map": fingerprint(prior_map),
    }


def prepare_frames(made_from: Provenance, out: Path, names: Sequence[str], overwrite: bool) -> None:
    """Write the record; raise if the folder has frames of other settings or inputs, or delete them first."""
    finished = _finished(out)
    earlier = Provenance.read(out)
    others = [name for name, key in finished.items() if key != made_from.key]
    if others and not overwrite:
        differences = [] if earlier is None else made_from.differences(earlier)
        others = [name for name in others if name in names or differences]
        if others:
            _raise_mismatch(out, differences or [f"with other settings or inputs of {some_names(others)}"])
    for name in others:
        clear_frame(out / name)
    if earlier != made_from:
        (out / SUMMARY).unlink(missing_ok=True)  # the summary describes the deleted frames
        made_from.write(out)


def check_poses(made_from: Provenance, out: Path, overwrite: bool) -> None:
    """Raise if the poses would be solved again under finished frames made with other poses."""
    earlier = Provenance.read(out)
    if earlier is None or overwrite or not _finished(out):
        return
    if differences := made_from.for_poses().differences(earlier.for_poses()):
        _raise_mismatch(out, differences)


def _finished(out: Path) -> dict[str, str | None]:
    """Return the key of every finished frame in a folder."""
    reports: dict[str, Record] = {
        path.parent.name: read_report(path.parent) for path in out.glob(f"*/{REPORT}")
    }
    return {name: report.get("made_from") for name, report in reports.items() if "frame" in report}


def _raise_mismatch(out: Path, differences: Sequence[str]) -> NoReturn:
    hint = "Choose a different --out, or add --overwrite to repeat all frames."
    bad_value(
        "--out",
        "a folder with frames of the same settings and inputs",
        f"{out}, {', '.join(differences)}",
        hint,
    )
