"""The files of one pair, read into images, cameras and a guidance (S3.3), before weights load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin._camera_checks import (
    check_calibrated_size,
    check_intrinsics,
    check_intrinsics_fit,
    check_pose,
)
from geodiff_plugin._checks import bad_value, noted, refuse, warn
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.guidance import GeometryGuidance, assumed_centre
from geodiff_plugin.evidence.prepare import cleaned
from geodiff_plugin.formats import read_calibration, read_image, read_matrix, read_points, rig_from_parameters
from geodiff_plugin.formats.colmap import check_colmap_names
from geodiff_plugin.formats.depth import depth_of_disparity, read_confidence, read_map
from geodiff_plugin.formats.images import (
    intrinsics_from_exif,
    intrinsics_from_fov,
    pages_of_both,
    warn_of_other_lens,
)
from geodiff_plugin.formats.jps import has_right_view_first
from geodiff_plugin.formats.lenses import (
    distortion_from_text,
    undistorted,
    undistorted_pixels,
    undistorted_points,
)
from geodiff_plugin.formats.lidar import LIDAR_SUFFIX, read_lidar
from geodiff_plugin.formats.reading import is_as_stored
from geodiff_plugin.formats.recordings import both_halves
from geodiff_plugin.formats.rigs import intrinsics, is_distorted
from geodiff_plugin.jobs.options import DepthOptions, unique_names
from geodiff_plugin.jobs.rectified import fitting_rig
from geodiff_plugin.messages import Message, distinct
from geodiff_plugin.types import Distortion, Rig

Size = tuple[int, int]


@dataclass(frozen=True, eq=False)
class PairInputs:
    """The left view ``(H, W, 3)`` in [0, 1], the cameras of both, and the guidance, with all other views.

    ``undistorted`` says whether lens distortion was taken out; ``prior_map`` is ``(h, w)``, NaN unknown;
    ``notes`` are for the user, such as the focal length that EXIF gave.
    """

    left: np.ndarray
    rig: Rig
    guidance: GeometryGuidance
    undistorted: bool = False
    prior_map: np.ndarray | None = None
    notes: tuple[Message, ...] = ()


@dataclass(frozen=True, eq=False)
class _Cameras:
    """K ``(3, 3)`` of every view, left one first, and where they are not estimated the rig and the poses."""

    Ks: list[np.ndarray]
    rig: Rig | None = None
    poses: tuple[np.ndarray, ...] = ()
    notes: tuple[Message, ...] = ()


def read_pair(
    options: DepthOptions, frames: Sequence[np.ndarray] | None = None, names: tuple[str, str] | None = None
) -> PairInputs:
    """Read images and cameras of checked options, and see that they fit each other.

    Args:
        options: which files, and how the cameras are given.
        frames: views that are no files, left and right, ``(H, W, 3)`` float32 in [0, 1].
        names: of the left and the right image in the calibration, where they are not those of the files.

    Raises:
        InputError: a file that cannot be read, or cameras that do not fit the images.
    """
    config = options.config()
    images = _read_images(options) if frames is None else list(frames)
    sizes = [(image.shape[1], image.shape[0]) for image in images]
    with noted() as warned:  # of the calibration; what forbids trust in it forbids trust in the result
        if options.estimate_pose:
            cameras = _cameras_without_poses(options, sizes)
        else:
            cameras = _cameras_with_poses(options, images, names, of_files=frames is None)
    lenses = lenses_of(options, cameras.rig)
    images = [pinhole(*each, config) for each in zip(images, cameras.Ks, lenses, strict=False)]
    points = _read_known(options, cameras.Ks[0], lenses[0], sizes[0], cameras.rig)
    known: dict[str, Any] = {"cropped": options.cropped, "points": points}
    if options.points_confidence is not None:
        known["points_confidence"] = read_confidence(options.points_confidence, "--points-confidence")
    if cameras.rig is None:
        known["known_length"] = _known_length(options, cameras.Ks[0], lenses[0])
        known["baseline_m"] = options.baseline
        guidance = GeometryGuidance.from_photographs(images, K=cameras.Ks, **known, config=config)
        rig = replace(guidance.rigs[0], size_left=sizes[0], size_right=sizes[1], source="estimated")
    else:
        rig, guidance = cameras.rig, _posed_guidance(options, images, cameras, known)
    doubts = [message for message in warned if message.forbids_trust]
    guidance.warned = list(distinct(doubts, guidance.warned))
    undistorted_any = any(lens is not None for lens in lenses)
    if "colmap" in options.export and not undistorted_any:  # before the work that it would lose
        check_colmap_names(unique_names(options.photographs().values()))
    prior_map = None if options.prior_map is None else read_map(options.prior_map, "--prior-map")
    return PairInputs(images[0], rig, guidance, undistorted_any, prior_map, cameras.notes)


def _read_images(options: DepthOptions) -> list[np.ndarray]:
    """The views as they lie in their files, left one first, ``(H, W, 3)`` float32 in [0, 1]."""
    as_stored = bool(options.calib) and is_as_stored(options.calib)
    first = _read_both(options, as_stored) if options.both_in_one else []
    others = list(options.photographs().items())[len(first) :]
    return [*first, *(_read_view(path, name, as_stored) for name, path in others)]


def _cameras_without_poses(options: DepthOptions, sizes: Sequence[Size]) -> _Cameras:
    way, notes = options.cameras_way(), list[Message]()
    paths = options.photographs().values()
    Ks = []
    for i, path in enumerate(paths):
        K, said = _intrinsics(options, way, path, i, sizes[i])
        Ks.append(K)
        notes += said
    return _Cameras(Ks, notes=tuple(notes))


def _cameras_with_poses(
    options: DepthOptions, images: Sequence[np.ndarray], names: tuple[str, str] | None, of_files: bool
) -> _Cameras:
    sizes = [(image.shape[1], image.shape[0]) for image in images]
    rig = read_rig(options, sizes[0], sizes[1] if len(sizes) > 1 else None, names)
    if of_files:
        rig = rig if options.disparity is not None else fitting_rig(rig, images)
        for K, (name, path) in zip((rig.K_left, rig.K_right), options.photographs().items(), strict=False):
            warn_of_other_lens(path, K, name)
    further = [_read_view_K(path) for path in options.view_k] or [rig.K_left] * len(options.view)
    poses = (check_pose(read_matrix(path, "--view-E"), f"--view-E {path}") for path in options.view_e)
    return _Cameras([rig.K_left, rig.K_right, *further][: len(sizes)], rig, (np.eye(4), rig.E, *poses))


def _posed_guidance(
    options: DepthOptions, images: Sequence[np.ndarray], cameras: _Cameras, known: dict[str, Any]
) -> GeometryGuidance:
    """The guidance of a left image alone, which has known depths, or of posed views."""
    rig, config = cameras.rig, options.config()
    assert rig is not None
    if len(images) == 1:
        if not options.cropped:
            height, width = images[0].shape[:2]
            check_intrinsics_fit(rig.K_left, width, height, "K", "LEFT")
        guidance = GeometryGuidance(None, rig.K_left, **known, config=config)
    else:
        known = known | {"unit": rig.unit, "measured_baseline": rig.measured}
        posed = list(zip(images, cameras.Ks, cameras.poses, strict=True))
        guidance = GeometryGuidance.from_views(posed, **known, config=config)
    right_given = options.k_right is not None or options.cx_right is not None
    if options.cameras_way() in ("parameters", "matrices") and not right_given:
        guidance.assumed = assumed_centre(guidance.rigs)
    guidance.assumed = [*guidance.assumed, *_filled_in(options)]
    return guidance


def _lens_of(options: DepthOptions, size: Size) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy as given; fy is fx, and the principal point the middle of the image, where not."""
    assert options.fx is not None

    def or_else(given: float | None, stand_in: float) -> float:
        return stand_in if given is None else given

    middle_x, middle_y = ((side - 1) / 2 for side in size)
    fy, cx, cy = or_else(options.fy, options.fx), or_else(options.cx, middle_x), or_else(options.cy, middle_y)
    return options.fx, fy, cx, cy


def _filled_in(options: DepthOptions) -> tuple[Message, ...]:
    """What stands in for numbers of ``--fx`` and its like that were left out."""
    if options.fx is None:
        return ()
    said = ["fy is assumed to be fx"] if options.fy is None else []
    missing = [name for name in ("cx", "cy") if getattr(options, name) is None]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        said.append(f"{' and '.join(missing)} {verb} assumed to be the middle of the image")
    if not said:
        return ()
    typed = ", ".join(f"--{name}" for name in ("fy", "cx", "cy") if getattr(options, name) is None)
    return (Message("camera.filled-in", f"{'; '.join(said)}. Give the calibrated numbers ({typed})."),)


def _read_both(options: DepthOptions, as_stored: bool) -> list[np.ndarray]:
    """Both views of the one file that LEFT names."""
    if options.side_by_side:
        halves = list(both_halves(_read_view(options.left, "LEFT", as_stored), "LEFT"))
        return halves[::-1] if has_right_view_first(options.left, "LEFT") else halves
    pages = zip(pages_of_both(options.left, "LEFT"), ("LEFT", "RIGHT"), strict=True)
    left, right = (_read_view(options.left, name, as_stored, page) for page, name in pages)
    if left.shape != right.shape:
        sizes = " and ".join("{1}x{0}".format(*view.shape) for view in (left, right))
        bad_value("LEFT", "a file with two pictures of one size", f"{sizes} in {options.left}")
    return [left, right]


def _read_view(path: Path, name: str, as_stored: bool, page: int = 0) -> np.ndarray:
    called = name if name in ("LEFT", "RIGHT") else f"--view {path}"
    image, notes = read_image(path, called, as_stored=as_stored, page=page)
    for note in notes:
        warn(note)
    return image


def read_rig(
    options: DepthOptions,
    left_size: Size,
    right_size: Size | None = None,
    names: tuple[str, str] | None = None,
) -> Rig:
    """The cameras, whichever way they are given, for images of these ``(width, height)`` and names."""
    if names is None and options.right is not None:
        names = str(options.left), str(options.right)
    way = options.cameras_way()
    if way == "file":
        of: dict[str, Any] = {"image_names": names, "image_size": left_size, "baseline_m": options.baseline}
        rig = read_calibration(options.calib, options.camera_pair(), str(options.left), distorted=True, **of)
    elif way == "parameters":
        baseline_m = 1.0 if options.baseline is None else options.baseline
        rig = rig_from_parameters(*_lens_of(options, left_size), baseline_m, cx_right=options.cx_right)
        rig = replace(rig, E=np.eye(4)) if options.baseline is None else rig
    else:
        assert options.k is not None
        K = _read_K(options.k, "--K")
        K_right = K if options.k_right is None else _read_K(options.k_right, "--K-right")
        E = np.eye(4) if options.e is None else check_pose(read_matrix(options.e, "--E"), "--E")
        rig = Rig(K, K_right, E, source=str(options.k), measured=options.e is None)
    cure = "Use the images that it is for, or scale K with them and give --fx --fy --cx --cy --baseline."
    check_calibrated_size(left_size, rig.size_left, f"the left image {options.left}", rig.source, cure)
    if right_size is not None:
        name = f"the right image {options.right}"
        check_calibrated_size(right_size, rig.size_right, name, rig.source, cure)
    return replace(rig, size_left=left_size, size_right=right_size)


def _read_K(path: Path, option: str, name: str | None = None) -> np.ndarray:
    """The K in the file of an option, checked; errors call it ``name``, by default as the option."""
    return check_intrinsics(read_matrix(path, option), name or option)


def _read_view_K(path: Path) -> np.ndarray:
    """The same of ``--view-K``, which may be repeated: errors say which file is meant."""
    return _read_K(path, "--view-K", f"--view-K {path}")


def _intrinsics(
    options: DepthOptions, way: str, path: Path, i: int, size: Size
) -> tuple[np.ndarray, Sequence[Message]]:
    """K of photograph ``i`` without a pose, 0 being the left one, and what is assumed for it.

    It comes from the options, else from the photograph's EXIF.
    """
    if i > 1 and options.view_k:
        return _read_view_K(options.view_k[i - 2]), ()
    if i == 1 and options.k_right is not None:
        return _read_K(options.k_right, "--K-right"), ()
    if options.k is not None:
        return _read_K(options.k, "--K"), ()
    if way == "parameters":
        return intrinsics(*_lens_of(options, size)), _filled_in(options)
    if options.fov is not None:
        return intrinsics_from_fov(options.fov, size), ()
    return intrinsics_from_exif(path, path.name)


def _known_length(options: DepthOptions, K: np.ndarray, lens: Distortion | None) -> tuple[float, ...] | None:
    """``X1,Y1,X2,Y2,METRES`` as typed, its ends moved to the image without lens distortion."""
    if options.known_length is None:
        return None
    try:
        x1, y1, x2, y2, metres = (float(part) for part in options.known_length.split(","))
    except ValueError:  # not numbers, or not five of them
        cure = "Two pixels of LEFT and the distance of the two places, such as 100,200,400,210,1.5."
        bad_value("--known-length", "X1,Y1,X2,Y2,METRES", repr(options.known_length), cure)
    if lens is not None:
        (x1, y1), (x2, y2) = undistorted_pixels(np.array([[x1, y1], [x2, y2]]), K, lens).tolist()
    return x1, y1, x2, y2, metres


def _read_known(
    options: DepthOptions, K: np.ndarray, lens: Distortion | None, size: Size, rig: Rig | None = None
) -> np.ndarray | None:
    """The depths of ``--points`` or ``--disparity``, a map ``(H, W)`` in metres or points ``(N, 3)``.

    A map becomes points behind a lens with distortion: its pixels are those of the image as it was taken.
    """
    if options.disparity is not None:
        if rig is None:
            refuse("--disparity needs a calibrated rectified rig: it cannot be used with --estimate-pose.")
        per_px = options.points_scale
        return depth_of_disparity(options.disparity, rig, size, "--disparity", per_px=per_px)
    if options.points is None:
        return None
    if options.points.suffix.lower() == LIDAR_SUFFIX:
        known = _read_lidar(options, options.points)
    else:
        known = read_points(options.points, "--points", scale=options.points_scale)
    if lens is None or known.shape[1] == 3:
        return known
    if known.shape[::-1] != size:
        expected, got = ("{}x{}".format(*of) for of in (size, known.shape[::-1]))
        cure = "A map belongs to the image as it was taken, pixel by pixel; else give points (N, 3)."
        bad_value("--points", f"a map of the left image's {expected} pixels", got, cure)
    return undistorted_points(known, K, lens)


def _read_lidar(options: DepthOptions, path: Path) -> np.ndarray:
    """Points of KITTI's lidar in the left camera's frame, by the calibration of both."""
    if options.points_scale is not None:
        bad_value("--points-scale", "left out for points of a lidar, in metres", options.points_scale)
    return read_lidar(path, options.calib, options.camera_pair(), str(options.left), "--points")


def pinhole(
    image_01: np.ndarray, K: np.ndarray, lens: Distortion | None, config: GuidanceConfig
) -> np.ndarray:
    """The image ``(H, W, 3)`` as a pinhole camera would have taken it."""
    if lens is None:
        return image_01
    # Before it is resampled: after it the blocks of its compression are no longer found.
    (ready,) = cleaned([torch.from_numpy(image_01).permute(2, 0, 1)], config)
    return undistorted(ready.permute(1, 2, 0).contiguous().numpy(), K, lens)


def lenses_of(options: DepthOptions, rig: Rig | None = None) -> tuple[Distortion | None, ...]:
    """Distortion of every photograph's lens, the left one first; ``None`` for a lens without distortion.

    A further view without ``--view-distortion`` has the left one's lens, as it has its K.
    """
    typed = [distortion_from_text(text) for text in options.distortion]
    if len(typed) > 2:
        refuse(f"--distortion is given {len(typed)} times: give it once for both lenses, or once for each.")
    if rig is not None and rig.rectified and any(is_distorted(lens) for lens in typed):
        rectified = f"--distortion is given, but {rig.source} is for rectified images"
        cure = "Give the rectified images; or the raw ones, with their cameras as --K, --K-right and --E."
        refuse(f"{rectified}. {cure}")
    pair = (None, None) if rig is None else rig.distortion
    if typed:
        pair = typed[0], typed[-1]
    further = [distortion_from_text(text, "--view-distortion") for text in options.view_distortion]
    if options.view_k and not further and any(is_distorted(lens) for lens in pair):
        cure = "give the lens of each by --view-distortion, 0,0,0,0 for one without distortion"
        refuse(f"--view-K is given, and the lens of LEFT distorts: {cure}.")
    if is_distorted(pair[0]):
        names = ("points_confidence", "disparity", "prior_map")
        cure = "rectify the images, or give a map of undistorted.png, which a first run writes"
        options.refuse(names, f"{{}} cannot be used with a lens that distorts: {cure}.")
    lenses = [*pair, *further] if further else [*pair, *(pair[0] for _ in options.view)]
    return tuple(lens if is_distorted(lens) else None for lens in lenses)
