"""Check whether the field of view of the left image is plausible."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from geodiff_plugin.cameras import field_of_view_deg
from geodiff_plugin.findings import REASON, REMARK, Finding, FindingKind
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.search_range import SearchRange
from geodiff_plugin.trust.stages import ResultStage

UNUSUAL = FindingKind(
    "camera.field-of-view",
    REMARK,
    "The field of view is unusual",
    cause="K is for a different image size, or the lens is a telephoto or fisheye lens.",
    hint="Check K. Ignore this message if the lens has this field of view.",
)
UNCONFIRMED = FindingKind(
    "camera.unconfirmed-field-of-view",
    REASON,
    "The field of view is unusual, and K is not from a calibration file",
    cause="The focal length is in millimetres or for a different image size, or the lens is a telephoto or "
    "fisheye lens.",
    hint="Specify fx in pixels. If it is correct, confirm it with a calibration file (--calib, --K), or by "
    "setting the depth range of the scene (depth_range, --near, --far).",
)


@dataclass(frozen=True)
class ViewAngle:
    """The field of view of the left camera."""

    degrees: float  # horizontal angle


class FieldOfView(Check[ViewAngle]):
    """Detects a K in millimetres or for another image size.

    An unusual field of view is confirmed by a calibration file or by a depth range that contains the matches.
    """

    kinds = (UNUSUAL, UNCONFIRMED)
    #: Plausible horizontal fields of view, degrees (135 mm and 10 mm focal length in 35 mm equivalent).
    MIN_DEGREES, MAX_DEGREES = 15.0, 120.0

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> ViewAngle | None:
        fx = float(stage.native.left.camera.K[0, 0])
        return ViewAngle(field_of_view_deg(stage.native.size[1], fx))

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and not cls.MIN_DEGREES <= fact.degrees <= cls.MAX_DEGREES:
            unusual = f"K implies a field of view of {fact.degrees:.0f} degrees, which is unusual."
            if facts.call.calibrated or SearchRange.confirms_unit(facts):
                yield Finding(UNUSUAL, f"{unusual} Check that it is for this image size.")
            else:
                yield Finding(
                    UNCONFIRMED,
                    f"{unusual} Check fx: in pixels it is millimetres * image width / sensor width. If it is "
                    "correct, confirm it with a calibration file (--calib, --K) or the depth range (--near, "
                    "--far).",
                )
