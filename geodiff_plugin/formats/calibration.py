"""Interface of a calibration format: how its text is recognised, and how it becomes a rig.

Data flow: the text of one or two files -> ``Rig``.
Paper: S3.3 (known cameras).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from geodiff_plugin.types import Rig

__all__ = ["CalibrationFile", "CalibrationFormat", "CameraChoice"]


@dataclass(frozen=True)
class CalibrationFile:
    """One file as it was read.

    Attributes:
        path: where it lies, for messages.
        text: its content.
    """

    path: Path
    text: str


@dataclass(frozen=True)
class CameraChoice:
    """Which two cameras of a file with more than two, and at which resolution.

    Attributes:
        cameras: numbers of the left and the right camera, or ``None`` to choose by the folder or the file.
        image_folder_hint: name or path of the left image's folder (or of the image), or ``None``.
        image_names: names or paths of the left and the right image, or ``None``.
        image_size: ``(width, height)`` of the left image, or ``None``; chooses among a file's resolutions.
    """

    cameras: tuple[int, int] | None = None
    image_folder_hint: str | None = None
    image_names: tuple[str, str] | None = None
    image_size: tuple[int, int] | None = None


@dataclass(frozen=True)
class CalibrationFormat:
    """One entry of ``CALIBRATION_FORMATS``.

    Attributes:
        summary: the format and its mark, for the list in the error about an unknown one.
        matches: ``(text, path) -> bool``; looks at the content, never needs the name of the file.
        read: ``(files, choice) -> Rig``.
        file_counts: how many files may describe one pair.
        uses_cameras: whether a file may hold more than two cameras, so that ``cameras`` has a meaning.
        has_unit: whether its lengths have a known unit (or are taken as metres); a warning says where not.
        by_image: whether it has a pose for each of many images, which are found by their names.
    """

    summary: str
    matches: Callable[[str, Path], bool]
    read: Callable[[tuple[CalibrationFile, ...], CameraChoice], Rig]
    file_counts: tuple[int, ...] = (1,)
    uses_cameras: bool = False
    has_unit: bool = True
    by_image: bool = False
