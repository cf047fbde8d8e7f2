"""Define the ways to give the cameras of a pair, with the options that each accepts and requires.

The fields of a record are options of ``DepthOptions``. The checks of their combinations, and the rules in
``jobs.options``, follow from ``SOURCES``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

from geodiff_plugin._internal.checks import raise_input_error
from geodiff_plugin.settings import settings_of


@dataclass(frozen=True, kw_only=True)
class CameraSource:
    """One way to give the cameras.

    Attributes:
        title: name in error messages.
        intrinsics: options required for K.
        pose: further options required for the pose of the right camera.
        of_second_view: options that require a second view.
        only_posed: options that cannot be combined with pose estimation.
        only_estimated: options that require pose estimation.
        for_crops: options required for a cropped image, whose principal point is shifted; ``None`` if this
            source does not support cropped images.
    """

    title: ClassVar[str]
    intrinsics: ClassVar[tuple[str, ...]] = ()
    pose: ClassVar[tuple[str, ...]] = ()
    of_second_view: ClassVar[tuple[str, ...]] = ()
    only_posed: ClassVar[tuple[str, ...]] = ()
    only_estimated: ClassVar[tuple[str, ...]] = ()
    for_crops: ClassVar[tuple[str, ...] | None] = ()

    @classmethod
    def takes(cls) -> tuple[str, ...]:
        """Return all options of the source."""
        return tuple(field.name for field in fields(cls))


@dataclass(frozen=True, kw_only=True)
class CalibrationFile(CameraSource):
    """``--calib``: files or a folder with both cameras; a given baseline overrides theirs."""

    title = "file"
    intrinsics = ("calib",)
    only_posed = ("calib", "cameras")

    calib: tuple[Path, ...]
    cameras: str | None
    baseline: float | None


@dataclass(frozen=True, kw_only=True)
class Parameters(CameraSource):
    """``--fx``, ``--fy``, ``--cx``, ``--cy`` in pixels, and the baseline of a rectified pair in metres."""

    title = "parameters"
    intrinsics = ("fx",)
    pose = ("baseline",)
    of_second_view = ("baseline", "cx_right")
    only_posed = ("cx_right",)
    for_crops = ("cx", "cy")

    fx: float
    fy: float | None
    cx: float | None
    cy: float | None
    cx_right: float | None
    baseline: float | None


@dataclass(frozen=True, kw_only=True)
class Matrices(CameraSource):
    """``--K`` and ``--E``: files with a 3x3 and a 4x4 matrix; a measured baseline sets the length of E."""

    title = "matrices"
    intrinsics = ("k",)
    pose = ("e",)
    of_second_view = ("e", "k_right")
    only_posed = ("e",)

    k: Path
    e: Path | None
    k_right: Path | None
    baseline: float | None


@dataclass(frozen=True, kw_only=True)
class FieldOfView(CameraSource):
    """``--fov``: horizontal field of view in degrees; the poses are estimated."""

    title = "--fov"
    intrinsics = ("fov",)
    only_estimated = ("fov",)
    for_crops = None

    fov: float


@dataclass(frozen=True, kw_only=True)
class Exif(CameraSource):
    """No option: the focal length from EXIF; the poses are estimated."""

    title = "EXIF"
    for_crops = None


#: All sources in the order of messages. The last one is used if no option gives K.
SOURCES = (CalibrationFile, Parameters, Matrices, FieldOfView, Exif)


def given_camera_options(options: Any) -> set[str]:
    """Return the names of the given camera options."""
    names = {name for source in SOURCES for name in source.takes()}
    return {name for name in names if getattr(options, name) not in (None, ())}


def find_source(options: Any) -> CameraSource:
    """Return how ``DepthOptions`` gives the cameras, or K if the poses are estimated.

    Raises:
        InputError: The cameras are missing, incomplete, or given in several ways.
    """
    given, taken, known = given_camera_options(options), _taken(options), _choices(options)
    if len(taken) > 1:
        what = "K is" if options.estimate_pose else "The cameras are"
        ways = " and ".join(source.title for source in taken)
        raise_input_error(f"{what} specified in several ways ({ways}). Pass only one of: {known}.")
    if not taken and not options.estimate_pose:
        unposed = ", or --estimate-pose --baseline METRES for images without poses"
        known += unposed if options.right is not None else ""
        raise_input_error(f"The cameras are missing. Metric depth needs {known}.")
    source = taken[0] if taken else SOURCES[-1]
    needed = _needs(source, options)
    if missing := [name for name in needed if name not in given]:
        present = _typed(
            options, (name for name in dict.fromkeys((*needed, *source.takes())) if name in given)
        )
        instead = " For images without poses add --estimate-pose." if given == {"baseline"} else ""
        raise_input_error(f"{present} needs {_typed(options, missing)} as well.{instead}")
    if options.cropped:
        _check_crop(source, options)
    return source(**{name: getattr(options, name) for name in source.takes()})


def _taken(options: Any) -> list[type[CameraSource]]:
    """Return the sources to which the given options belong."""
    given = given_camera_options(options)
    own = [source for source in SOURCES if given & _own(source)]
    # A baseline belongs to another given source if that source accepts one.
    rest = given.difference(*(source.takes() for source in own))
    return [source for source in SOURCES if source in own or rest & {*_needs(source, options)}]


def _own(source: type[CameraSource]) -> set[str]:
    """Return the options that no other source accepts."""
    return set(source.takes()).difference(*(other.takes() for other in SOURCES if other is not source))


def _needs(source: type[CameraSource], options: Any) -> tuple[str, ...]:
    """Return the required options of a source."""
    alone = options.right is None and options.disparity is None
    return source.intrinsics + (() if options.estimate_pose or alone else source.pose)


def _choices(options: Any) -> str:
    """List the available sources by their required options."""
    if options.estimate_pose:
        sources = [source for source in SOURCES if not set(source.intrinsics) & set(source.only_posed)]
    else:
        sources = [source for source in SOURCES if set(source.intrinsics) - set(source.only_estimated)]
    return ", or ".join(_typed(options, _needs(source, options)) or source.title for source in sources)


def _typed(options: Any, names: Iterable[str]) -> str:
    flags = (settings_of(type(options))[name].flag for name in names)
    return " ".join(f"{flag} FILE" if flag == "--calib" else flag for flag in flags)


def _check_crop(source: type[CameraSource], options: Any) -> None:
    """Raise an error for a source that does not determine the principal point of a cropped image."""
    if source.for_crops is None and not options.view_k:
        why = f"{source.title} does not determine the principal point of a cropped image"
        raise_input_error(f"--cropped needs --K, or --fx --fy --cx --cy: {why}.")
    if any(getattr(options, name) is None for name in source.for_crops or ()):
        names = _typed(options, source.for_crops or ())
        raise_input_error(
            f"--cropped needs {names} as well: the principal point is not at the centre of a cropped image."
        )
