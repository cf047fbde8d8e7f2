"""Captures: the posed frames of one moving camera, as phones, trackers, SLAM and COLMAP leave them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from geodiff_plugin._checks import InputError, MissingFileError, bad_value
from geodiff_plugin.formats.colmap import read_colmap_capture
from geodiff_plugin.formats.datasets import (
    read_euroc,
    read_kitti_odometry,
    read_log,
    read_mvsnet_folder,
    read_tartanair,
)
from geodiff_plugin.formats.files import PathLike, is_turned, stored_size, upright_size
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
    read_arkitscenes,
    read_polycam,
    read_record3d,
    read_scanner_app,
    read_stray,
)
from geodiff_plugin.formats.photogrammetry import read_bundler, read_metashape, read_nvm, read_opensfm
from geodiff_plugin.formats.radiance import (
    read_llff,
    read_nerfies,
    read_neus,
    read_nsvf,
    read_sdfstudio,
    read_splat_cameras,
)
from geodiff_plugin.formats.realityscan import read_realityscan
from geodiff_plugin.formats.rigs import RATIO_TOLERANCE, Camera, lens_of, reading_whole, resized
from geodiff_plugin.formats.sequences import (
    read_photographs,
    read_replica,
    read_tracked,
    read_tum,
    read_video,
)
from geodiff_plugin.formats.transforms import read_transforms
from geodiff_plugin.formats.unknown import poses_beside, refuse_foreign, refuse_unknown
from geodiff_plugin.messages import Message

#: A note names so many of the frames that are left out, at most.
MOST_NAMES = 5
#: Letters of a name in a note, at most: a file may give a frame a name of any length.
LONGEST_NAME = 60
#: It gives so many of their reasons, at most.
MOST_REASONS = 3
#: What to say of a capture of one frame, and of a file that names none.
ONE_FRAME = "One frame has no second view: use geodiff depth with known points, or record more."
NO_FRAMES = "Its file names no images: was it written before they were placed?"
#: Smaller copies of an image have half its sides or less; one that differs by less than this share is another
#: picture, such as the one before its lens distortion was removed.
NEAR_SIZE = 0.1
#: Sides of one picture may differ by rounding, pixels.
ROUNDING_PX = 1

COLMAP_CAMERAS = ("**/cameras.bin", "**/cameras.txt")
COLMAP_IMAGES = ("**/images.bin", "**/images.txt")
#: Every layout; the first that recognises a path reads it.
LAYOUTS = (
    CaptureFormat("a transforms.json", ("transforms*.json",), read_transforms, names_images=True),
    CaptureFormat("a COLMAP model", (COLMAP_CAMERAS, COLMAP_IMAGES), read_colmap_capture, names_images=True),
    CaptureFormat("3D Gaussian splatting", ("cameras.json",), read_splat_cameras, names_images=True),
    CaptureFormat("Polycam's raw data", ("keyframes/*cameras", "keyframes/*images"), read_polycam),
    CaptureFormat("Record3D", ("metadata.json", "rgb"), read_record3d),
    CaptureFormat("Stray Scanner", ("odometry.csv", "camera_matrix.csv", "rgb.mp4"), read_stray),
    CaptureFormat("3D Scanner App", ("frame_*.jpg", "frame_*.json"), read_scanner_app),
    CaptureFormat("ARKitScenes", ("**/lowres_wide", "**/lowres_wide.traj"), read_arkitscenes),
    CaptureFormat("7-Scenes", ("frame-*.color.*", "frame-*.pose.txt"), read_tracked),
    CaptureFormat("ScanNet", ("color", "pose", "intrinsic"), read_tracked),
    CaptureFormat("TUM RGB-D", ("rgb.txt", "groundtruth.txt"), read_tum),
    CaptureFormat("Replica", ("results/frame*", "traj.txt"), read_replica),
    CaptureFormat("EuRoC", ("*/cam0/sensor.yaml", "*/cam0/data.csv"), read_euroc),
    CaptureFormat("TartanAir", ("image_left", "pose_left.txt"), read_tartanair),
    CaptureFormat("KITTI odometry", ("image_[0-3]", "calib.txt", "poses.txt"), read_kitti_odometry),
    CaptureFormat("MVSNet", ("cams/*_cam.txt", "*images"), read_mvsnet_folder),
    CaptureFormat("NSVF", ("rgb", "pose", "intrinsics*"), read_nsvf),
    CaptureFormat("NeuS", ("cameras*.npz", "image"), read_neus),
    CaptureFormat("SDFStudio", ("meta_data.json",), read_sdfstudio, names_images=True),
    CaptureFormat("Nerfies", ("camera/*.json", "rgb/[0-9]*x"), read_nerfies),
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
    CaptureFormat("images", ("*.jpg",), read_photographs, has_poses=False),
)


@dataclass(frozen=True, eq=False)
class TypedCamera:
    """What the user says of the cameras: K in pixels, or a horizontal field of view in degrees."""

    K: np.ndarray | None = None
    fov: float | None = None


class FoundFrames(NamedTuple):
    """What ``read_capture`` finds, as ``Capture`` takes it."""

    frames: list[CaptureFrame]  # in order
    kind: str  # of its layout
    unit: str | None  # of its poses: ``"m"``, or ``None`` if unknown
    notes: list[Message]  # for the user


def read_capture(
    path: PathLike,
    *,
    K: np.ndarray | None = None,
    fov: float | None = None,
    trajectory: PathLike | None = None,
    images: PathLike | None = None,
) -> FoundFrames:
    """The frames of a capture, and what is known of all of them.

    ``K`` and ``fov`` (horizontal, degrees) are for layouts without intrinsics, and go before the files'.
    ``trajectory`` has a video's lines ``seconds tx ty tz qx qy qz qw``, camera-to-world, OpenCV's axes.
    ``images`` is the folder in or below which the images lie that a file of cameras names.
    """
    source = Path(path)
    if not os.path.exists(source):
        bad_value("PATH", "a capture", f"{source}, which does not exist", error=MissingFileError)
    with reading_whole(source, "capture"):
        layout = _layout(source, *(None if path is None else Path(path) for path in (trajectory, images)))
        typed = TypedCamera(K, fov)
        finished = [_finished(candidate, layout.as_stored, typed) for candidate in layout.candidates]
    tracked = any(each.frame.E is not None and not each.problem for each in finished)
    if tracked:
        finished = [each if each.frame.E is not None else _left_out(each, NO_POSE) for each in finished]
    frames = [each.frame for each in finished if not each.problem]
    is_typed = K is not None or fov is not None
    said = [note for note in layout.notes if not (is_typed and note.code == "capture.assumed-k")]
    notes = [*_reasons(finished), *said, *_turned(frames)]
    notes += [] if is_typed else _other_sizes(finished)
    if layout.has_poses and frames and not tracked:
        sentence = f"No frame of {layout.kind} has a pose: they are solved for, without a unit."
        notes.append(Message("capture.no-poses", sentence))
    if len(frames) < 2:
        cure = " ".join(notes) or (ONE_FRAME if frames else NO_FRAMES)
        bad_value("a capture", "at least two frames", f"{len(frames)} in {source}", cure)
    named = zip(frames, unique_names(frames), strict=True)
    frames = [replace(frame, name=name) for frame, name in named]
    return FoundFrames(frames, layout.kind, layout.unit if tracked else None, notes)


def _layout(source: Path, trajectory: Path | None, images: Path | None) -> Layout:
    """What the first reader that recognises a path finds there."""
    if trajectory is not None:
        layout = read_video(source, trajectory)
        if layout is None:
            bad_value("trajectory (--trajectory)", "left out where the capture is not a video", trajectory)
        return layout
    refuse_foreign(source)
    for each in LAYOUTS:
        layout = each.read(source, images) if each.names_images else each.read(source)
        if layout is None:
            continue
        if images is not None and not each.names_images:
            expected = "left out where no file names the images"
            bad_value("images (--images)", expected, f"{images} for {each.summary}")
        beside = () if each.has_poses or source.is_file() else poses_beside(source, LAYOUTS)
        return replace(layout, notes=(*layout.notes, *beside), has_poses=each.has_poses)
    refuse_unknown(source, LAYOUTS)


def _left_out(candidate: Candidate, problem: str) -> Candidate:
    return replace(candidate, problem=candidate.problem or problem)


def _finished(candidate: Candidate, as_stored: bool, typed: TypedCamera) -> Candidate:
    """The frame with its size and K, or what is wrong with it."""
    if candidate.problem:
        return candidate
    if not os.path.isfile(candidate.frame.image):
        return _left_out(candidate, "no image file")
    try:
        return replace(candidate, frame=_with_camera(candidate.frame, candidate.camera, as_stored, typed))
    except InputError as error:
        return _left_out(candidate, str(error))


def _with_camera(
    frame: CaptureFrame, camera: Camera | None, as_stored: bool, typed: TypedCamera
) -> CaptureFrame:
    """The frame with its size and K: as typed, else the file's camera scaled to the image, else by EXIF."""
    name, size = frame.image.name, frame.size
    if frame.index is None:
        as_stored = as_stored and not _of_shown_pixels(frame.image, camera)
        size = (stored_size if as_stored else upright_size)(frame.image, f"{frame.image}")
    if typed.K is not None:
        K = typed.K
    elif typed.fov is not None:
        K = intrinsics_from_fov(typed.fov, size)
    elif camera is not None:
        K = resized(camera, size, name, "Is it a crop? Give --K.").K
    elif frame.index is not None:
        bad_value("K", "given by --K or --fov", "none", "A video does not say its focal length.")
    else:
        # The reason begins with the frame's name, and is the same for all frames.
        K = intrinsics_from_exif(frame.image, "the image", as_stored=as_stored)[0]
    lens = None if camera is None else lens_of(camera, name)
    depth = frame.depth if frame.depth is not None and os.path.isfile(frame.depth) else None
    return replace(frame, size=size, K=np.asarray(K, float), lens=lens, depth=depth, as_stored=as_stored)


def _of_shown_pixels(image: Path, camera: Camera | None) -> bool:
    """Whether a camera's size says that it is one of the image as EXIF turns it, and not as it is stored."""
    if camera is None or camera.size is None or not is_turned(image):
        return False
    width, height = camera.size
    off = [abs(width / height / (w / h) - 1) for w, h in (stored_size(image, ""), upright_size(image, ""))]
    return bool(off[0] > RATIO_TOLERANCE > off[1])


def _turned(frames: Sequence[CaptureFrame]) -> list[Message]:
    """What to say of images whose EXIF orientation is not applied."""
    stored = [frame for frame in frames if frame.as_stored and frame.index is None]
    turned = [frame.name for frame in stored if is_turned(frame.image)]
    if not turned:
        return []
    said = "their EXIF data say that they are shown turned, but their cameras are those of the stored pixels"
    sentence = f"{_some(turned)}: {said}, and so is the depth that comes out."
    return [Message("capture.stored-pixels", sentence)]


def _other_sizes(candidates: Sequence[Candidate]) -> list[Message]:
    """What to say of images that are nearly, but not quite, of the size that their cameras are for."""
    names, sizes = list[str](), ""
    for each in candidates:
        if each.problem or each.camera is None or each.camera.size is None:
            continue
        got, expected = (np.array(size, float) for size in (each.frame.size, each.camera.size))
        off_px = np.abs(got - expected)
        if off_px.max() > ROUNDING_PX and (off_px < NEAR_SIZE * expected).all():
            names.append(each.frame.name)
            image, camera = ("{:.0f}x{:.0f}".format(*size) for size in (got, expected))
            sizes = sizes or f"an image of {image} where its camera is for {camera}"
    if not names:
        return []
    said = f"{_some(names)}: {sizes}"
    cure = "Is it the one before its lens distortion was removed? Then say where the others lie (--images)."
    return [Message("capture.other-size", f"{said}. {cure}")]


def _reasons(candidates: Sequence[Candidate]) -> list[Message]:
    """Sentences on the frames that are left out, by reason."""
    names: dict[str, list[str]] = {}
    for each in candidates:
        if each.problem:
            names.setdefault(each.problem, []).append(each.frame.name)
    reasons = [f"{_some(those)}: {why.rstrip('.')}; {len(those)} skipped." for why, those in names.items()]
    more = sum(map(len, list(names.values())[MOST_REASONS:]))
    reasons = reasons[:MOST_REASONS]
    if more:
        reasons.append(f"{more} more skipped for like reasons.")
    return [Message("capture.skipped", reason) for reason in reasons]


def _some(names: Sequence[str]) -> str:
    shown = [
        name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]}..." for name in names[:MOST_NAMES]
    ]
    if len(names) > MOST_NAMES:
        shown.append("...")
    return ", ".join(shown)
