"""Reads the files of one pair into images, cameras and a guidance (S3.3), before weights load."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from geodiff_plugin._internal.camera_checks import check_intrinsics_fit
from geodiff_plugin._internal.checks import InputError, UnknownPoseError, bad_value, warn, with_code
from geodiff_plugin.evidence.guidance import GeometryGuidance, assumed_centre
from geodiff_plugin.evidence.prepare import pinhole
from geodiff_plugin.evidence.unposed import focal_source
from geodiff_plugin.formats import (
    Packing,
    check_colmap_names,
    find_packing,
    is_as_stored,
    pages_of_both,
    read_image,
    read_jps,
    read_map,
    recordings,
)
from geodiff_plugin.jobs.camera_sources import Matrices, Parameters
from geodiff_plugin.jobs.cameras import (
    OriginalImages,
    ViewCameras,
    assumed_parameters,
    read_cameras,
    settled_packing,
)
from geodiff_plugin.jobs.known import KnownGeometry, read_known
from geodiff_plugin.jobs.masks import find_overlays, read_masks, undistorted_masks
from geodiff_plugin.jobs.options import AUTO, DepthOptions, unique_names
from geodiff_plugin.jobs.pairs import PairRef, file_digests
from geodiff_plugin.jobs.records import JobLog, PairInputs, PairOrigin, ReadPair
from geodiff_plugin.pose.overlays import overlay_finding
from geodiff_plugin.types import Rig

#: Valid pixels ``(H, W)`` bool of every view, left one first; ``None`` for all.
Masks = list[np.ndarray | None]


def read_pair(
    options: DepthOptions,
    frames: Sequence[np.ndarray] | None = None,
    names: tuple[str, str] | None = None,
    packing: Packing | None = None,
    overlays: np.ndarray | None = None,
) -> PairInputs:
    """Read images and cameras of checked options, and check that they match.

    Args:
        options: files, and the source of the cameras.
        frames: left and right view if they are not files, ``(H, W, 3)`` float32 in [0, 1].
        names: names of the left and right image in the calibration, if they differ from the files'.
        packing: how one image or video holds both views, if the run has determined it.
        overlays: static pixels ``(h, w)`` bool of the views of a video, at any size.

    Raises:
        InputError: unreadable files, or cameras that do not match the images.
    """
    config = options.config()  # raises if options contradict each other, before files are read
    if frames is None:
        images, packing = _read_images(options, packing)
    else:
        images = list(frames)
    if packing is not None:
        packing = settled_packing(options, packing, (images[0].shape[1], images[0].shape[0]))
    taken = OriginalImages(images, names, from_files=frames is None, packing=packing)
    cameras = read_cameras(options, taken)
    known = read_known(options, cameras)
    stored_masks = read_masks(
        options, images, cameras.views, from_files=frames is None, packing=packing, overlays=overlays
    )
    masks = undistorted_masks(stored_masks, images, cameras.views)
    views = [
        pinhole(image, camera, config, mask)
        for image, camera, mask in zip(images, cameras.views, stored_masks, strict=True)
    ]
    make_guidance = _unposed_guidance if options.estimate_pose else _posed_guidance
    guidance = make_guidance(options, views, cameras, known, masks)
    guidance.add_findings([*cameras.findings, *([] if overlays is None else [overlay_finding(overlays)])])
    guidance.calibrated = not isinstance(options.camera_source(), Parameters)
    if "colmap" in options.export and not cameras.distorted:  # before work that this error would waste
        check_colmap_names(unique_names(options.image_files().values()))
    prior_map = None if options.prior_map is None else read_map(options.prior_map, "--prior-map")
    rig = cameras.rig or _estimated_rig(guidance, cameras)
    return PairInputs(views[0], rig, guidance, cameras.distorted, prior_map, cameras.views, stored_masks)


def begin_pair(
    options: DepthOptions,
    frames: Sequence[np.ndarray] | None = None,
    origin: PairOrigin | None = None,
    packing: Packing | None = None,
    overlays: np.ndarray | None = None,
) -> ReadPair:
    """Call ``read_pair`` inside a new log."""
    log = JobLog()
    with log.stage("calibration"):
        inputs = read_pair(options, frames, packing=packing, overlays=overlays)
    return ReadPair(options, inputs, log, origin)


def _read_images(options: DepthOptions, packing: Packing | None) -> tuple[list[np.ndarray], Packing | None]:
    """Return the images as stored in their files, left one first, ``(H, W, 3)`` float32 in [0, 1].

    If one image holds both views, also return how.
    """
    as_stored = bool(options.calib) and is_as_stored(options.calib)
    first: list[np.ndarray] = []
    if options.side_by_side and options.both_in_one:
        image = _read_view(options.left, "LEFT", as_stored)
        first, packing = _split(image, options, packing)
    elif options.both_in_one:
        first = _read_both(options, as_stored)
    others = list(options.image_files().items())[len(first) :]
    return [*first, *(_read_view(path, name, as_stored) for name, path in others)], packing


def _split(
    image: np.ndarray, options: DepthOptions, packing: Packing | None
) -> tuple[list[np.ndarray], Packing]:
    """Return both views of an image, and how it holds them, unless the run has determined it."""
    stored = read_jps(options.left, "LEFT")
    if packing is None:
        layout = str(options.side_by_side) if options.side_by_side != AUTO else stored.layout
        packing = Packing(layout) if layout else find_packing([image], "LEFT", options.left)
    views = list(packing.split(image, "LEFT"))
    return views[::-1] if stored.right_first else views, packing


def _read_both(options: DepthOptions, as_stored: bool) -> list[np.ndarray]:
    """Return both views from the file of LEFT, which has an image for each."""
    pages = zip(pages_of_both(options.left, "LEFT"), ("LEFT", "RIGHT"), strict=True)
    left, right = (_read_view(options.left, name, as_stored, page) for page, name in pages)
    if left.shape != right.shape:
        sizes = " and ".join("{1}x{0}".format(*view.shape) for view in (left, right))
        bad_value("LEFT", "a file with two images of the same size", f"{sizes} in {options.left}")
    return [left, right]


def _read_view(path: Path, name: str, as_stored: bool, page: int = 0) -> np.ndarray:
    called = name if name in ("LEFT", "RIGHT") else f"--view {path}"
    image, notes = read_image(path, called, as_stored=as_stored, page=page)
    for note in notes:
        warn(note)
    return image


def _common_arguments(options: DepthOptions, known: KnownGeometry, masks: Masks) -> dict[str, Any]:
    """Return the arguments shared by all constructors of a guidance."""
    points = {"points": known.points, "points_confidence": known.points_confidence}
    config = options.config()
    if not config.refine_edges:
        options.raise_input_error(
            ["min_confidence", "max_sigma"],
            "{} needs a confidence, which is not computed with refine_edges=False. Use a preset that "
            "computes it, such as --preset default or fast.",
        )
    valid: dict[str, Any] = {"mask": masks[0], "right_mask": tuple(masks[1:]) or None, "fill": options.fill}
    if options.holes:
        valid |= {"min_confidence": options.min_confidence, "max_sigma": options.max_sigma}
    return {"config": config, "cropped": options.cropped, **points, **valid}


def _unposed_guidance(
    options: DepthOptions, views: list[np.ndarray], cameras: ViewCameras, known: KnownGeometry, masks: Masks
) -> GeometryGuidance:
    """Return the guidance of views whose poses are estimated."""
    lengths: dict[str, Any] = {"baseline_m": options.baseline, "known_length": known.length}
    common = _common_arguments(options, known, masks) | {"matcher": options.matcher}
    Ks = [camera.K for camera in cameras.views]
    try:
        return GeometryGuidance.from_unposed_images(views, K=Ks, **lengths, **common)
    except UnknownPoseError as error:
        text = f"{error}{focal_source(cameras.findings)}"
        raise with_code(UnknownPoseError(text), error.code) from None


def _estimated_rig(guidance: GeometryGuidance, cameras: ViewCameras) -> Rig:
    """Return the estimated rig of the first two views."""
    left, right = cameras.views[:2]
    return replace(guidance.rigs[0].sized(left.size, right.size), source="estimated")


def _posed_guidance(
    options: DepthOptions, views: list[np.ndarray], cameras: ViewCameras, known: KnownGeometry, masks: Masks
) -> GeometryGuidance:
    """Return the guidance of posed views, or of a left image alone with known depths."""
    rig = cameras.rig
    common = _common_arguments(options, known, masks)
    assert rig is not None
    if len(views) == 1:
        if not options.cropped:
            height, width = views[0].shape[:2]
            check_intrinsics_fit(rig.K_left, width, height, "K", "LEFT")
        guidance = GeometryGuidance(None, rig.K_left, **common)
    else:
        of_rig: dict[str, Any] = {"unit": rig.unit, "measured_baseline": rig.measured}
        Ks = (camera.K for camera in cameras.views)
        posed = list(zip(views, Ks, cameras.poses, strict=True))
        guidance = GeometryGuidance.from_views(posed, **of_rig, **common)
    source = options.camera_source()
    match source:
        case Parameters(cx_right=None) | Matrices(k_right=None):
            guidance.add_findings(assumed_centre(guidance.rigs))
    if isinstance(source, Parameters):
        guidance.add_findings(assumed_parameters(source))
    return guidance


class PairReader:
    """Reads the pairs of a run over many, and opens each video or bag once.

    Args:
        options: options of the run.
    """

    def __init__(self, options: DepthOptions) -> None:
        self._options = options
        self._videos = dict[Path, recordings.VideoReader | recordings.BagReader]()
        self._open = ExitStack()
        self._overlays = dict[Path, np.ndarray | None]()  # of each video or bag

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the videos."""
        self._open.close()

    def frames_of(self, ref: PairRef) -> Sequence[np.ndarray] | None:
        """Return left and right view of a pair of frames, ``(H, W, 3)`` in [0, 1]; ``None`` for files."""
        if (frame := ref.frame) is None:
            return None
        for path in {ref.left, ref.right or ref.left} - set(self._videos):
            bag = (self._options.bag_topics(), self._options.tolerance) if recordings.is_bag(path) else None
            reader: Any = recordings.VideoReader(path) if bag is None else recordings.BagReader(path, *bag)
            self._videos[path] = self._open.enter_context(reader)
        left = self._videos[ref.left].read(frame)
        if ref.right is None:
            return (ref.packing or Packing()).split(left, "LEFT")
        return left, self._videos[ref.right].read(frame if ref.right_frame is None else ref.right_frame)

    def read(self, ref: PairRef, options: DepthOptions) -> ReadPair:
        """Read images, cameras and guidance of a pair; ``options`` are the options of that pair.

        Raises:
            InputError: unreadable files, or cameras that do not match the images.
        """
        digests = file_digests(options)  # before reading, so that a later change is detected
        origin = PairOrigin(ref.name, ref.frame, digests)
        pair = begin_pair(options, self.frames_of(ref), origin, ref.packing, self._overlays_of(ref))
        if ref.findings:
            pair.inputs.guidance.add_findings(ref.findings)
        return pair

    def _overlays_of(self, ref: PairRef) -> np.ndarray | None:
        """Return the static pixels ``(h, w)`` bool of a video or bag, unless masks are given."""
        if ref.frame is None or self._options.mask or self._options.right_mask:
            return None
        if ref.left not in self._overlays:
            with PairReader(self._options) as samples:
                self._overlays[ref.left] = find_overlays(partial(samples._frame_of, ref))
        return self._overlays[ref.left]

    def _frame_of(self, ref: PairRef, frame: int) -> Sequence[np.ndarray] | None:
        """Return both views of another frame of the same video or bag.

        Returns ``None`` after the last frame, and no views for a damaged one, which ``find_overlays`` skips.
        """
        right = ref.right_frame
        if right is not None:
            right = max(0, right + frame - (ref.frame or 0))
        try:
            return self.frames_of(replace(ref, frame=frame, right_frame=right))
        except recordings.EndOfRecordingError:
            return None
        except InputError:
            return ()
