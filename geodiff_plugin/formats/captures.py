"""Reads captures: posed frames of one moving camera from phones, trackers, SLAM and COLMAP."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from geodiff_plugin._internal.checks import InputError, MissingFileError, bad_value
from geodiff_plugin.cameras import Camera
from geodiff_plugin.findings import Finding, some_names
from geodiff_plugin.formats.colmap import read_colmap_capture
from geodiff_plugin.formats.datasets import (
    MVSNET_FOLDER,
    read_euroc,
    read_kitti_odometry,
    read_log,
    read_tartanair,
)
from geodiff_plugin.formats.files import PathLike, check_file, is_reoriented, stored_size, upright_size
from geodiff_plugin.formats.image_files import colmap_mask, find_mask
from geodiff_plugin.formats.images import intrinsics_from_exif, intrinsics_from_fov
from geodiff_plugin.formats.kapture import read_kapture
from geodiff_plugin.formats.layouts import (
    NO_POSE,
    Candidate,
    CaptureFormat,
    CaptureFrame,
    Layout,
    unique_names,
)
from geodiff_plugin.formats.openmvg import read_alicevision, read_openmvg
from geodiff_plugin.formats.phones import (
    POLYCAM,
    SCANNER_APP,
    read_arkitscenes,
    read_record3d,
    read_stray,
)
from geodiff_plugin.formats.photogrammetry import read_bundler, read_metashape, read_nvm, read_opensfm
from geodiff_plugin.formats.radiance import (
    NERFIES,
    read_llff,
    read_neus,
    read_nsvf,
    read_sdfstudio,
    read_splat_cameras,
)
from geodiff_plugin.formats.realityscan import read_realityscan
from geodiff_plugin.formats.rigs import RATIO_TOLERANCE, RawCamera, lens_of, reading_file, resized
from geodiff_plugin.formats.sequences import (
    read_replica,
    read_tracked,
    read_tum,
    read_unposed_images,
    read_video,
)
from geodiff_plugin.formats.transforms import read_transforms
from geodiff_plugin.formats.unread import poses_in_folder, raise_unknown, raise_unread_capture

#: Maximum number of reasons for skipped frames in findings.
MAX_REASONS = 3
#: Hints for a capture of one frame, and for a file that lists none.
ONE_FRAME = "A single frame has no second view. Use geodiff depth with known points, or record more frames."
NO_FRAMES = "Its file lists no images; it may have been written before alignment."
#: Smaller copies of an image have at most half its sides. A size that differs by less than this fraction
#: indicates a different image, such as the one before undistortion.
NEAR_SIZE = 0.1
#: Maximum difference of sides due to rounding, in pixels.
ROUNDING_PX = 1

COLMAP_CAMERAS = ("**/cameras.bin", "**/cameras.txt")
COLMAP_IMAGES = ("**/images.bin", "**/images.txt")
#: All layouts; the first match reads the path.
LAYOUTS = (
    CaptureFormat("a transforms.json", ("transforms*.json",), read_transforms, names_images=True),
    CaptureFormat("a COLMAP model", (COLMAP_CAMERAS, COLMAP_IMAGES), read_colmap_capture, names_images=True),
    CaptureFormat("3D Gaussian splatting", ("cameras.json",), read_splat_cameras, names_images=True),
    CaptureFormat("Polycam's raw data", ("keyframes/*cameras", "keyframes/*images"), POLYCAM),
    CaptureFormat("Record3D", ("metadata.json", "rgb"), read_record3d),
    CaptureFormat("Stray Scanner", ("odometry.csv", "camera_matrix.csv", "rgb.mp4"), read_stray),
    CaptureFormat("3D Scanner App", ("frame_*.jpg", "frame_*.json"), SCANNER_APP),
    CaptureFormat("ARKitScenes", ("**/lowres_wide", "**/lowres_wide.traj"), read_arkitscenes),
    CaptureFormat("7-Scenes", ("frame-*.color.*", "frame-*.pose.txt"), read_tracked),
    CaptureFormat("ScanNet", ("color", "pose", "intrinsic"), read_tracked),
    CaptureFormat("TUM RGB-D", ("rgb.txt", "groundtruth.txt"), read_tum),
    CaptureFormat("Replica", ("results/frame*", "traj.txt"), read_replica),
    CaptureFormat("EuRoC", ("*/cam0/sensor.yaml", "*/cam0/data.csv"), read_euroc),
    CaptureFormat("TartanAir", ("image_left", "pose_left.txt"), read_tartanair),
    CaptureFormat("KITTI odometry", ("image_[0-3]", "calib.txt", "poses.txt"), read_kitti_odometry),
    CaptureFormat("MVSNet", ("cams/*_cam.txt", "*images"), MVSNET_FOLDER),
    CaptureFormat("NSVF", ("rgb", "pose", "intrinsics*"), read_nsvf),
    CaptureFormat("NeuS", ("cameras*.npz", "image"), read_neus),
    CaptureFormat("SDFStudio", ("meta_data.json",), read_sdfstudio, names_images=True),
    CaptureFormat("Nerfies", ("camera/*.json", "rgb/[0-9]*x"), NERFIES),
    CaptureFormat("LLFF", ("poses_bounds.npy", "images"), read_llff),
    CaptureFormat("kapture", ("**/sensors.txt", "**/records_camera.txt"), read_kapture, names_images=True),
    CaptureFormat("OpenMVG", ("sfm_data*.json",), read_openmvg, names_images=True),
    CaptureFormat("Meshroom", ("*.sfm",), read_alicevision, names_images=True),
    CaptureFormat("RealityScan", ("*.xmp",), read_realityscan),
    CaptureFormat("Metashape", ("*.xml",), read_metashape, names_images=True),
    CaptureFormat("OpenSfM", ("*reconstruction*.json",), read_opensfm, names_images=True),
    CaptureFormat("Bundler", ("*.out", "list*.txt"), read_bundler, names_images=True),
    CaptureFormat("VisualSFM", ("*.nvm",), read_nvm, names_images=True),
    CaptureFormat("Tanks and Temples", ("*.log",), read_log),
    CaptureFormat("a video", ("*.mp4",), read_video, has_poses=False),
    CaptureFormat("images", ("*.jpg",), read_unposed_images, has_poses=False),
)


@dataclass(frozen=True, eq=False)
class TypedCamera:
    """Camera options of the user: K in pixels, or a horizontal field of view in degrees."""

    K: np.ndarray | None = None
    fov: float | None = None


class FoundFrames(NamedTuple):
    """Result of ``read_capture``, passed to ``Capture``."""

    frames: list[CaptureFrame]  # in order
    kind: str  # kind of its layout
    unit: str | None  # unit of its poses: ``"m"``, or ``None`` if unknown
    findings: list[Finding]  # for the user


def read_capture(
    path: PathLike,
    *,
    K: np.ndarray | None = None,
    fov: float | None = None,
    trajectory: PathLike | None = None,
    images: PathLike | None = None,
    mask: PathLike | None = None,
) -> FoundFrames:
    """Read the frames of a capture, with their common properties.

    ``K`` and ``fov`` (horizontal, degrees) are for layouts without intrinsics, and override the files'.
    ``trajectory`` has lines ``seconds tx ty tz qx qy qz qw`` of a video, camera-to-world, OpenCV's axes.
    ``images`` is a folder that contains the images, possibly in subfolders. ``mask`` is a folder with the
    mask of each frame, or one mask for all frames (default: the masks in the capture).
    """
    source = Path(path)
    if not os.path.exists(source):
        bad_value("PATH", "a capture", f"{source}, which does not exist", error=MissingFileError)
    with reading_file(source, "capture"):
        layout = _layout(source, *(None if path is None else Path(path) for path in (trajectory, images)))
        typed = TypedCamera(K, fov)
        finished = [_finished(candidate, layout.as_stored, typed) for candidate in layout.candidates]
    tracked = any(each.frame.E is not None and not each.problem for each in finished)
    if tracked:
        finished = [each if each.frame.E is not None else _left_out(each, NO_POSE) for each in finished]
    frames = [each.frame for each in finished if not each.problem]
    is_typed = K is not None or fov is not None
    reported = [
        finding for finding in layout.findings if not (is_typed and finding.code == "capture.assumed-k")
    ]
    findings = [*_reasons(finished), *reported, *_stored_orientation(frames)]
    findings += [] if is_typed else _other_sizes(finished)
    if layout.has_poses and frames and not tracked:
        sentence = f"No frame of {layout.kind} has a pose. Poses are estimated, without a unit."
        findings.append(Finding("capture.no-poses", sentence))
    if len(frames) < 2:
        hint = " ".join(findings) or (ONE_FRAME if frames else NO_FRAMES)
        bad_value("a capture", "at least two frames", f"{len(frames)} in {source}", hint)
    named = zip(frames, unique_names(frames), strict=True)
    frames = [replace(frame, name=name) for frame, name in named]
    if mask is None:
        frames, of_masks = _with_own_masks(frames)
        findings += of_masks
    else:
        frames = _with_masks(frames, Path(mask))
    return FoundFrames(frames, layout.kind, layout.unit if tracked else None, findings)


def _with_own_masks(frames: Sequence[CaptureFrame]) -> tuple[list[CaptureFrame], list[Finding]]:
    """Return the frames with the masks that the capture has, by its file or in COLMAP's folder."""
    masked = [replace(frame, mask=_own_mask(frame)) for frame in frames]
    pairs = zip(frames, masked, strict=True)
    missing = [named.name for named, found in pairs if named.mask is not None and found.mask is None]
    findings = list[Finding]()
    if missing:
        sentence = f"{some_names(missing)}: the mask does not exist, so all of their pixels count as valid."
        findings.append(Finding("capture.no-mask", sentence))
    count = sum(frame.mask is not None for frame in masked)
    if count:
        sentence = (
            f"{count} of {len(frames)} frames have a mask in the capture: its black pixels influence nothing "
            "and get no depth."
        )
        findings.append(Finding("capture.masks", sentence))
    return masked, findings


def _own_mask(frame: CaptureFrame) -> Path | None:
    """Return the mask that the capture's file names, if it exists; without a name, the one for COLMAP."""
    if frame.mask is None:
        return colmap_mask(frame.image)
    return frame.mask if os.path.isfile(frame.mask) else None


def _with_masks(frames: Sequence[CaptureFrame], given: Path) -> list[CaptureFrame]:
    """Return the frames with masks from a folder, or with one mask for all of them."""
    if not os.path.isdir(given):
        file = check_file(given, "mask (--mask)", "an image, or a folder of masks")
        return [replace(frame, mask=file) for frame in frames]
    found = [find_mask(given, frame.image if frame.index is None else Path(frame.name)) for frame in frames]
    missing = [frame.name for frame, file in zip(frames, found, strict=True) if file is None]
    if missing:
        expected = "a folder with a mask for each frame, of its name, or one mask"
        bad_value("mask (--mask)", expected, f"{given} without masks for {some_names(missing)}")
    return [replace(frame, mask=file) for frame, file in zip(frames, found, strict=True)]


def _layout(source: Path, trajectory: Path | None, images: Path | None) -> Layout:
    """Return the result of the first reader that recognises a path."""
    if trajectory is not None:
        return _layout_of_video(source, trajectory)
    raise_unread_capture(source)
    for kind in LAYOUTS:
        layout = kind.read(source, images) if kind.names_images else kind.read(source)
        if layout is not None:
            return _checked_layout(layout, kind, source, images)
    raise_unknown(source, LAYOUTS)


def _layout_of_video(source: Path, trajectory: Path) -> Layout:
    """Return the frames of a video with the poses of a trajectory."""
    layout = read_video(source, trajectory)
    if layout is None:
        bad_value("trajectory (--trajectory)", "omitted unless the capture is a video", trajectory)
    return layout


def _checked_layout(layout: Layout, kind: CaptureFormat, source: Path, images: Path | None) -> Layout:
    """Check that a layout has a use for the folder ``images``; add a finding on poses that are not read."""
    if images is not None and not kind.names_images:
        expected = "omitted unless a file lists the images"
        bad_value("images (--images)", expected, f"{images} for {kind.summary}")
    if kind.has_poses or source.is_file():
        return replace(layout, has_poses=kind.has_poses)
    unused = poses_in_folder(source, LAYOUTS)
    return replace(layout, findings=(*layout.findings, *unused), has_poses=False)


def _left_out(candidate: Candidate, problem: str) -> Candidate:
    return replace(candidate, problem=candidate.problem or problem)


def _finished(candidate: Candidate, as_stored: bool, typed: TypedCamera) -> Candidate:
    """Return the frame with its size and K, or with its problem."""
    if candidate.problem:
        return candidate
    if not os.path.isfile(candidate.frame.image):
        return _left_out(candidate, "no image file")
    try:
        return replace(candidate, frame=_with_camera(candidate.frame, candidate.camera, as_stored, typed))
    except InputError as error:
        return _left_out(candidate, str(error))


def _with_camera(
    frame: CaptureFrame, camera: RawCamera | None, as_stored: bool, typed: TypedCamera
) -> CaptureFrame:
    """Return the frame with size, K, lens and depth file; ``camera`` is the one in the capture's files."""
    if frame.index is None:
        as_stored = as_stored and not _of_shown_pixels(frame.image, camera)
        size_of_image = stored_size if as_stored else upright_size
        size = size_of_image(frame.image, f"{frame.image}")
    else:
        assert camera is not None  # the camera has the video's size
        size = camera.size
    K = _intrinsics(frame, camera, size, as_stored, typed)
    lens = None if camera is None else lens_of(camera, frame.image.name)
    has_depth = frame.depth is not None and os.path.isfile(frame.depth)
    return replace(
        frame,
        camera=Camera(np.asarray(K, float), size, lens),
        depth=frame.depth if has_depth else None,
        as_stored=as_stored,
    )


def _intrinsics(
    frame: CaptureFrame, camera: RawCamera | None, size: tuple[int, int], as_stored: bool, typed: TypedCamera
) -> np.ndarray:
    """Return a frame's K: from options, the file's camera scaled to the image, or EXIF, in this order."""
    if typed.K is not None:
        return typed.K
    if typed.fov is not None:
        return intrinsics_from_fov(typed.fov, size)
    if camera is not None and camera.K is not None:
        return resized(camera, size, frame.image.name, "For a crop, pass --K.").K
    if frame.index is not None:
        bad_value("K", "set by --K or --fov", "none", "A video has no focal length.")
    # The message starts with the frame's name and must be equal for all frames.
    return intrinsics_from_exif(frame.image, "the image", as_stored=as_stored)[0]


def _of_shown_pixels(image: Path, camera: RawCamera | None) -> bool:
    """Whether a camera's size matches the image in its EXIF orientation, and not as stored."""
    if camera is None or camera.size is None or not is_reoriented(image):
        return False
    width, height = camera.size
    off = [abs(width / height / (w / h) - 1) for w, h in (stored_size(image, ""), upright_size(image, ""))]
    return bool(off[0] > RATIO_TOLERANCE > off[1])


def _stored_orientation(frames: Sequence[CaptureFrame]) -> list[Finding]:
    """Return a finding on images whose EXIF orientation is not applied."""
    stored = [frame for frame in frames if frame.as_stored and frame.index is None]
    ignored = [frame.name for frame in stored if is_reoriented(frame.image)]
    if not ignored:
        return []
    text = "their EXIF orientation is ignored, because their cameras refer to the stored pixels"
    sentence = f"{some_names(ignored)}: {text}; so does the depth."
    return [Finding("capture.stored-pixels", sentence)]


def _other_sizes(candidates: Sequence[Candidate]) -> list[Finding]:
    """Return a finding on images whose size is close to, but not equal to, their cameras' size."""
    names = list[str]()
    sizes = ""
    for each in candidates:
        if each.problem or each.camera is None or each.camera.size is None:
            continue
        got, expected = (np.array(size, float) for size in (each.frame.size, each.camera.size))
        off_px = np.abs(got - expected)
        if off_px.max() > ROUNDING_PX and (off_px < NEAR_SIZE * expected).all():
            names.append(each.frame.name)
            image, camera = ("{:.0f}x{:.0f}".format(*size) for size in (got, expected))
            sizes = sizes or f"an image of {image}, a camera for {camera}"
    if not names:
        return []
    text = f"{some_names(names)}: {sizes}"
    hint = "If these are images before undistortion, pass the folder of the undistorted ones (--images)."
    return [Finding("capture.size-mismatch", f"{text}. {hint}")]


def _reasons(candidates: Sequence[Candidate]) -> list[Finding]:
    """Summarise skipped frames by reason."""
    names: dict[str, list[str]] = {}
    for each in candidates:
        if each.problem:
            names.setdefault(each.problem, []).append(each.frame.name)
    reasons = [
        f"{some_names(those)}: {why.rstrip('.')}; {len(those)} skipped." for why, those in names.items()
    ]
    more = sum(map(len, list(names.values())[MAX_REASONS:]))
    reasons = reasons[:MAX_REASONS]
    if more:
        reasons.append(f"{more} more skipped for similar reasons.")
    return [Finding("capture.skipped", reason) for reason in reasons]
