"""Cameras of a pair from any option: files, parameters, matrices, field of view or EXIF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._internal.camera_checks import check_calibrated_size, check_intrinsics, check_pose
from geodiff_plugin._internal.checks import InputError, captured_warnings, raise_input_error
from geodiff_plugin.cameras import Camera, Distortion, Size
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import (
    Packing,
    distortion_from_text,
    intrinsics,
    intrinsics_from_exif,
    intrinsics_from_fov,
    is_distorted,
    read_calibration,
    read_intrinsics,
    read_matrix,
    rig_from_parameters,
    warn_of_other_lens,
    with_baseline,
)
from geodiff_plugin.jobs.camera_sources import CalibrationFile, FieldOfView, Matrices, Parameters
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.rectified import select_rig
from geodiff_plugin.types import Rig

#: Maximum ratio of fx to fy of square pixels. Anamorphic and binned ones differ by more.
SQUARE_RATIO = 1.2


@dataclass(frozen=True, eq=False)
class OriginalImages:
    """Images of a pair and its further views before undistortion, left one first.

    ``images`` are ``(H, W, 3)`` float32 in [0, 1]. ``names`` are the names of the left and right image in the
    calibration, if they differ from the files'. ``from_files`` is false for frames of a video. ``packing`` is
    how one image holds the first two, if it does.
    """

    images: list[np.ndarray]
    names: tuple[str, str] | None = None
    from_files: bool = True
    packing: Packing | None = None

    @property
    def sizes(self) -> list[Size]:
        """``(width, height)`` of every image."""
        return [(image.shape[1], image.shape[0]) for image in self.images]

    @property
    def shown_sizes(self) -> list[Size]:
        """``(width, height)`` of every image before it was squeezed into a frame, for which its camera is."""
        of_both = [] if self.packing is None else [self.packing.shown_size(size) for size in self.sizes[:2]]
        return [*of_both, *self.sizes[len(of_both) :]]


@dataclass(frozen=True, eq=False)
class ViewCameras:
    """Cameras of all views.

    Attributes:
        views: K, image size and lens of every view, left one first.
        rig: cameras of the left and right view; ``None`` if the poses have to be estimated.
        poses: ``(4, 4)`` camera-to-world pose of every view; empty if they have to be estimated.
        findings: assumptions, and reasons in the calibration not to trust the result.
    """

    views: tuple[Camera, ...]
    rig: Rig | None = None
    poses: tuple[np.ndarray, ...] = ()
    findings: tuple[Finding, ...] = ()

    @property
    def left(self) -> Camera:
        """Camera of the left view."""
        return self.views[0]

    @property
    def distorted(self) -> bool:
        """Whether any lens has distortion."""
        return any(camera.lens is not None for camera in self.views)


def read_cameras(options: DepthOptions, taken: OriginalImages) -> ViewCameras:
    """Read the cameras of images from the options.

    Raises:
        InputError: unreadable files, or cameras that do not match the images.
    """
    with captured_warnings() as warned:
        cameras = (_unposed if options.estimate_pose else _posed)(options, taken)
    lenses = lenses_of(options, cameras.rig)  # includes the lens of a missing right view
    views = [replace(camera, lens=lens) for camera, lens in zip(cameras.views, lenses, strict=False)]
    reasons = (finding for finding in warned if finding.is_reason)
    inferred = [] if taken.packing is None or taken.packing.finding is None else [taken.packing.finding]
    return replace(cameras, views=tuple(views), findings=(*reasons, *inferred, *cameras.findings))


def _unposed(options: DepthOptions, taken: OriginalImages) -> ViewCameras:
    """Return the intrinsics of views whose poses have to be estimated."""
    views = zip(options.image_files().values(), taken.shown_sizes, strict=True)
    found = [_intrinsics_of_view(options, number, path, size) for number, (path, size) in enumerate(views)]
    sizes = zip(found, taken.shown_sizes, taken.sizes, strict=True)
    cameras = tuple(Camera(K, shown).resized(size) for (K, _), shown, size in sizes)
    return ViewCameras(cameras, findings=tuple(finding for _, assumed in found for finding in assumed))


def _posed(options: DepthOptions, taken: OriginalImages) -> ViewCameras:
    """Return the cameras of views with given poses, or of a left image alone."""
    sizes = taken.sizes
    shown = taken.shown_sizes
    rig = read_rig(options, shown[0], shown[1] if len(shown) > 1 else None, taken.names)
    if taken.packing is not None:
        rig = rig.resized(sizes[0], sizes[1])
    if taken.from_files:
        rig = rig if options.disparity is not None else select_rig(rig, taken.images)
        for camera, (name, path) in zip((rig.left, rig.right), options.image_files().items(), strict=False):
            warn_of_other_lens(path, camera.K, name)
    further = [_read_view_K(path) for path in options.view_k] or [rig.K_left] * len(options.view)
    poses = [check_pose(read_matrix(path, "--view-E"), f"--view-E {path}") for path in options.view_e]
    if options.e is not None and options.baseline is not None:  # one tracker's poses have one scale
        given_m = np.linalg.norm(read_matrix(options.e, "--E")[:3, 3])
        for E in poses:
            E[:3, 3] *= np.linalg.norm(rig.E[:3, 3]) / given_m
    Ks = [rig.K_left, rig.K_right, *further]
    cameras = tuple(
        Camera(K, size) for K, size in zip(Ks, sizes, strict=False)
    )  # only the left one for a left image alone
    return ViewCameras(cameras, rig, (np.eye(4), rig.E, *poses)[: len(sizes)])


def read_rig(
    options: DepthOptions,
    left_size: Size,
    right_size: Size | None = None,
    names: tuple[str, str] | None = None,
) -> Rig:
    """Return the left and right camera from any source, for images of these ``(width, height)``.

    ``names`` are the names of the images in the calibration, if they differ from the files'.
    """
    rig = _given_rig(options, left_size, names)
    hint = "Use the images it was made for, or scale K accordingly and pass --fx --fy --cx --cy --baseline."
    check_calibrated_size(left_size, rig.size_left, f"the left image {options.left}", rig.source, hint)
    if right_size is not None:
        name = f"the right image {options.right}"
        check_calibrated_size(right_size, rig.size_right, name, rig.source, hint)
    return rig.sized(left_size, right_size)


def settled_packing(options: DepthOptions, packing: Packing, size: Size) -> Packing:
    """Return the layout of a frame whose views have a ``(width, height)``, given the cameras as well.

    Cameras state whether an inferred layout is right: they are for images of a size, with or without a
    squeeze, or fx and fy differ because they are for squeezed views.
    """
    if packing.finding is None:
        return packing
    with suppress(InputError), captured_warnings():  # reported when the cameras are read
        if options.estimate_pose:
            camera = Camera(_intrinsics_of_view(options, 0, options.left, size)[0])
        else:
            camera = _given_rig(options, size).left
        stored, squeezed = packing.squeezed(False), packing.squeezed(True)
        columns, rows = squeezed.stretch
        squeeze = camera.K[0, 0] * columns / (camera.K[1, 1] * rows)
        if camera.size == size or abs(math.log(squeeze)) < math.log(SQUARE_RATIO):
            return stored.stated_by_cameras(size)
        if camera.size == squeezed.shown_size(size):
            return squeezed.stated_by_cameras(size)
    return packing


def _given_rig(options: DepthOptions, left_size: Size, names: tuple[str, str] | None = None) -> Rig:
    """Return the rig of the options, whose cameras may be for images of another size."""
    match options.camera_source():
        case CalibrationFile():
            return _rig_of_file(options, left_size, names)
        case Parameters() as parameters:
            return _rig_of_parameters(parameters, left_size)
        case Matrices() as matrices:
            return _rig_of_matrices(matrices)
        case source:  # --fov and EXIF need --estimate-pose
            raise AssertionError(source)


def _rig_of_file(options: DepthOptions, left_size: Size, names: tuple[str, str] | None) -> Rig:
    """Return the rig of the ``--calib`` files."""
    if names is None and options.right is not None:
        names = str(options.left), str(options.right)
    of: dict[str, Any] = {"image_names": names, "image_size": left_size, "baseline_m": options.baseline}
    of["is_alone"] = options.right is None
    return read_calibration(options.calib, options.camera_pair(), str(options.left), distorted=True, **of)


def _rig_of_parameters(given: Parameters, left_size: Size) -> Rig:
    """Return the rig of ``--fx`` etc.; for a left image alone both cameras are the same."""
    baseline_m = 1.0 if given.baseline is None else given.baseline
    rig = rig_from_parameters(*_lens_of(given, left_size), baseline_m, cx_right=given.cx_right)
    return replace(rig, E=np.eye(4)) if given.baseline is None else rig


def _rig_of_matrices(given: Matrices) -> Rig:
    """Return the rig of ``--K``, ``--K-right`` and ``--E``; a left image alone has two equal cameras.

    Poses are usually estimated by a tracker; ``--baseline`` is the measured length of the translation of E.
    """
    K = _read_K(given.k, "--K")
    K_right = K if given.k_right is None else _read_K(given.k_right, "--K-right")
    E = np.eye(4) if given.e is None else check_pose(read_matrix(given.e, "--E"), "--E")
    rig = Rig(Camera(K), Camera(K_right), E, source=str(given.k), measured=given.e is None)
    return rig if given.e is None or given.baseline is None else with_baseline(rig, given.baseline)


def _intrinsics_of_view(
    options: DepthOptions, number: int, path: Path, size: Size
) -> tuple[np.ndarray, Sequence[Finding]]:
    """Return K of a view without a pose (number 0 is the left one), and the assumptions made.

    K is taken from the options, otherwise from the EXIF data of the file.
    """
    if number > 1 and options.view_k:
        return _read_view_K(options.view_k[number - 2]), ()
    match options.camera_source():
        case Matrices(k_right=Path() as k_right) if number == 1:
            return _read_K(k_right, "--K-right"), ()
        case Matrices(k=k):
            return _read_K(k, "--K"), ()
        case Parameters() as parameters:
            return intrinsics(*_lens_of(parameters, size)), assumed_parameters(parameters)
        case FieldOfView(fov=degrees):
            return intrinsics_from_fov(degrees, size), ()
    return intrinsics_from_exif(path, path.name)


def _read_K(path: Path, option: str, name: str | None = None) -> np.ndarray:
    """Read and check the K file of an option; errors use ``name``, by default the option."""
    return check_intrinsics(read_intrinsics(path, option), name or option)


def _read_view_K(path: Path) -> np.ndarray:
    """Read K from a ``--view-K`` file; errors state the file, because the option may be repeated."""
    return _read_K(path, "--view-K", f"--view-K {path}")


def _lens_of(given: Parameters, size: Size) -> tuple[float, float, float, float]:
    """Return fx, fy, cx and cy; defaults are fy = fx and the image centre."""
    middle_x, middle_y = ((side - 1) / 2 for side in size)
    fy = given.fx if given.fy is None else given.fy
    cx = middle_x if given.cx is None else given.cx
    cy = middle_y if given.cy is None else given.cy
    return given.fx, fy, cx, cy


def assumed_parameters(given: Parameters) -> tuple[Finding, ...]:
    """Report the defaults of ``--fy``, ``--cx`` and ``--cy`` that were used."""
    missing = [name for name in ("fy", "cx", "cy") if getattr(given, name) is None]
    if not missing:
        return ()
    sentences = ["fy is assumed equal to fx"] if "fy" in missing else []
    if centre := [name for name in missing if name != "fy"]:
        verb = "is" if len(centre) == 1 else "are"
        sentences.append(f"{' and '.join(centre)} {verb} assumed at the image centre")
    flags = ", ".join(f"--{name}" for name in missing)
    return (
        Finding("camera.assumed-intrinsics", f"{'; '.join(sentences)}. Pass calibrated values with {flags}."),
    )


def lenses_of(options: DepthOptions, rig: Rig | None = None) -> tuple[Distortion | None, ...]:
    """Return the lens distortion of every view, left one first; ``None`` without distortion.

    A further view without ``--view-distortion`` uses the left camera's lens, as it uses its K.

    Raises:
        InputError: distortion contradicts other options or the rig.
    """
    typed = [distortion_from_text(text) for text in options.distortion]
    further = [distortion_from_text(text, "--view-distortion") for text in options.view_distortion]
    _check_typed_lenses(typed, rig)
    pair = (None, None) if rig is None else (rig.left.lens, rig.right.lens)
    if typed:
        pair = typed[0], typed[-1]
    if options.view_k and not further and any(is_distorted(lens) for lens in pair):
        hint = "Pass each lens with --view-distortion (0,0,0,0 for no distortion)"
        raise_input_error(f"--view-K is set, and LEFT has lens distortion. {hint}.")
    if is_distorted(pair[0]):
        names = ("points_confidence", "disparity", "prior_map")
        hint = "Rectify the images, or pass a map of undistorted.png, which a first run writes"
        options.raise_input_error(names, f"{{}} cannot be used with lens distortion. {hint}.")
    lenses = [*pair, *further] if further else [*pair, *(pair[0] for _ in options.view)]
    return tuple(lens if is_distorted(lens) else None for lens in lenses)


def _check_typed_lenses(typed: Sequence[Distortion | None], rig: Rig | None) -> None:
    """Reject more than two ``--distortion``, and lens distortion with a rectified rig."""
    if len(typed) > 2:
        raise_input_error(
            f"--distortion was passed {len(typed)} times. Pass it once for both lenses, or once per lens."
        )
    if rig is not None and rig.rectified and any(is_distorted(lens) for lens in typed):
        rectified = f"--distortion is set, but {rig.source} is for rectified images"
        hint = "Pass the rectified images, or the raw images with --K, --K-right and --E."
        raise_input_error(f"{rectified}. {hint}")
