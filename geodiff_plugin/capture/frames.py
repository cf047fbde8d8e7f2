"""``Capture``: frames of a moving camera, joint pose estimation, and depth of any frame."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any, Self

import cv2
import numpy as np
import torch

from geodiff_plugin._internal.checks import bad_value, check_choice, check_number
from geodiff_plugin._internal.threads import available_cores
from geodiff_plugin.cameras import PosedCamera
from geodiff_plugin.capture import NEIGHBOURS, POINTS
from geodiff_plugin.capture.masks import MaskedImage, masked_grey, masked_image, valid_in_files
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import (
    CaptureFrame,
    VideoReader,
    read_capture,
    read_image,
    read_measured,
    undistorted,
)
from geodiff_plugin.pose.multiview import GivenFrames, SolvedCapture, solve_capture
from geodiff_plugin.pose.overlays import overlay_finding, reduced, sampled_frames, static_pixels
from geodiff_plugin.result.output import MetricDepthOutput

#: Status of solves that refined the given poses, or estimated them.
ADJUSTED = ("solved", "estimated")
#: Minimum number of frames that observe a point used as known depth: two rays alone cannot contradict each
#: other.
MIN_FRAMES = 3
#: Angle of two rays in degrees at which a match is worth most.
BEST_ANGLE_DEG = 6.0
#: Standard deviation of the worth below that angle in degrees, where depth becomes inaccurate.
NARROWER_DEG = 2.5
#: Standard deviation of the worth above that angle in degrees, where the views differ in appearance.
WIDER_DEG = 10.0
#: Weight of a point for further neighbours if a chosen neighbour already observes it.
REPEATED_WEIGHT = 0.5
#: Minimum worth of a neighbour relative to the best one.
MIN_WORTH_RATIO = 0.15
#: Minimum number of shared points of neighbouring frames.
MIN_SHARED = 12


class Capture:
    """Frames of one moving camera with their poses.

    >>> capture = Capture.open("scan")
    >>> out = capture.depth(pipe, "frame_0010")

    ``frames`` are in order, with ``names``; ``kind`` is their layout; ``unit`` is ``"m"``, or ``None`` if no
    length is known; ``findings`` are messages for the user; ``solved`` is the result of ``solve``;
    ``metres_per_unit`` is the factor of ``rescale``. Set ``scale_measured`` if that factor comes from a
    measured length: an uncertain scale of the poses then does not make the result untrusted.
    """

    def __init__(
        self, frames: Sequence[CaptureFrame], kind: str, unit: str | None, findings: Sequence[Finding]
    ) -> None:
        self.frames = list(frames)
        self.kind = kind
        self.unit = unit
        self.findings = list(findings)
        self.names = [frame.name for frame in frames]
        if len(set(self.names)) < len(self.names):  # duplicate names would be ambiguous
            bad_value("the frames", "uniquely named", ", ".join(self.names))
        self.metres_per_unit = 1.0
        self.solved: SolvedCapture | None = None
        self.scale_measured = False
        self._way: str | None = None  # how the poses were solved
        self._video: VideoReader | None = None

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        K: np.ndarray | None = None,
        fov: float | None = None,
        trajectory: str | os.PathLike[str] | None = None,
        images: str | os.PathLike[str] | None = None,
        mask: str | os.PathLike[str] | None = None,
    ) -> Self:
        """Read a capture from a file or folder; detects the layout (docs/how-to/captures.md lists them).

        If it has no intrinsics, pass ``K (3, 3)`` in pixels or a horizontal field of view in degrees;
        ``trajectory`` is the trajectory of a video in TUM format. ``images`` is the folder of the images
        named by a file of cameras, if they are not next to it, or if there are several copies. ``mask`` is a
        folder with the mask of each frame, or one mask for all frames, white where pixels are valid; by
        default the capture's own masks (``masks/`` for COLMAP, ``mask_path`` for nerfstudio).

        Raises:
            FileNotFoundError: the path does not exist.
            InputError: not a capture, or fewer than two frames.
        """
        return cls(*read_capture(path, K=K, fov=fov, trajectory=trajectory, images=images, mask=mask))

    def __len__(self) -> int:
        return len(self.names)

    def frame(self, name: str) -> CaptureFrame:
        """Return the frame with a name; raise ``InputError`` if there is none."""
        if name not in self.names:
            some = ", ".join(self.names[:3])
            hint = "Use file stems as names, or FIRST:LAST for numbers."
            bad_value("a frame", f"a name of the capture, such as {some}", repr(name), hint)
        return self.frames[self.names.index(name)]

    def choose(self, wanted: str | None) -> list[str]:
        """Return the names for ``NAME,NAME`` or ``FIRST:LAST:STEP``; all for ``None``."""
        wanted = ":" if wanted is None else wanted
        if ":" not in wanted:
            return [self.frame(name.strip()).name for name in wanted.split(",") if name.strip()]
        match = re.fullmatch(r"(\d*):(\d*)(?::0*([1-9]\d*))?", wanted)
        every = (0, len(self) - 1, 1)
        numbers = match and [int(n or default) for n, default in zip(match.groups(), every, strict=True)]
        if not numbers or not numbers[0] <= numbers[1] < len(self):
            expected = f"NAME,NAME or FIRST:LAST:STEP, increasing numbers from 0 to {len(self) - 1}"
            bad_value("frames (--frames)", expected, repr(wanted))
        first, last, step = numbers
        return self.names[first : last + 1 : step]

    @property
    def poses(self) -> np.ndarray | None:
        """Return ``(N, 4, 4)`` camera-to-world poses as given, or ``None``."""
        Es = [frame.E for frame in self.frames]
        return None if any(E is None for E in Es) else np.stack([E for E in Es if E is not None])

    def solve(self, poses: str | None = None, *, threads: int | None = None) -> SolvedCapture:
        """Solve the poses of all frames (extra ``capture``): ``"refined"`` (default) or ``"given"``.

        The result is cached until the other kind is requested. ``threads`` is the number of threads for
        features, matching and adjustment (default: all cores).

        Raises:
            InputError: pycolmap is missing, or frames without poses cannot be connected.
        """
        check_choice(poses or "refined", "poses", ("refined", "given"))
        if self.solved is None or poses not in (None, self._way):
            self._way = poses or "refined"
            self.solved = None  # its overlays are found again
            chosen = sampled_frames(len(self))
            samples = list[np.ndarray]()
            solved = solve_capture(
                self._greys({self.names[i] for i in chosen}, samples),
                GivenFrames(self.names, [frame.camera for frame in self.frames], self.poses),
                poses=self._way,
                threads=threads or available_cores(),
            )
            overlays = static_pixels(samples)
            findings = () if overlays is None else (overlay_finding(overlays),)
            self.solved = replace(solved, overlays=overlays, findings=(*solved.findings, *findings))
        return self.solved

    def _greys(self, chosen: Collection[str], samples: list[np.ndarray]) -> Iterator[np.ndarray]:
        """Yield the frames for ``solve_capture``, and collect small images of the chosen ones."""
        for name in self.names:
            grey = masked_grey(self._masked(name))
            if name in chosen:
                samples.append(reduced(grey))
            yield grey

    @property
    def reasons(self) -> list[Finding]:
        """Return findings on the capture and its poses that make the depth of all frames untrusted."""
        reasons = [each for each in (*self.findings, *self.solve().findings) if each.is_reason]
        known = self.scale_measured or self.unit is None
        return [reason for reason in reasons if not (known and reason.code == "capture.scale")]

    def rescale(self, factor: float) -> None:
        """Multiply all lengths by a factor > 0 that converts them to metres."""
        check_number(factor, "metres per unit", 1e-12, 1e12)
        frames = []
        solved = self.solved
        longer = np.ones((4, 4))
        longer[:3, 3] = factor
        for frame in self.frames:
            points = None if frame.points is None else frame.points * factor
            frames.append(replace(frame, E=None if frame.E is None else frame.E * longer, points=points))
        self.frames, self.unit = frames, "m"
        self.metres_per_unit *= factor
        if solved is not None:
            given = None if solved.E_given is None else solved.E_given * longer
            self.solved = replace(solved, E=solved.E * longer, E_given=given, points=solved.points * factor)

    def camera(self, name: str) -> PosedCamera:
        """Return the solved camera of a frame's ``image``, posed in the capture's world frame."""
        frame = self.frame(name)
        solved = self.solve()
        number = self.names.index(name)
        return PosedCamera(solved.K[number], frame.size, E=solved.E[number])

    def image(self, name: str) -> np.ndarray:
        """Return ``(H, W, 3)`` float32 in [0, 1], undistorted, in the pixels of its camera."""
        return undistorted(self._stored_image(name), self.frame(name).camera)

    def valid(self, name: str) -> np.ndarray | None:
        """Return the valid pixels ``(H, W)`` bool of a frame's ``image``; ``None`` if all are.

        They are white in its mask, not transparent, and seen by the lens. Without a mask, static overlays are
        not valid either once the poses are solved. A guided call detects constant borders in addition.
        """
        frame = self.frame(name)
        if frame.camera.lens is None and self._overlays is None:  # the image is not needed
            valid = valid_in_files(frame)
            return None if valid is None else valid.numpy()
        return self._masked(name).valid

    @property
    def _overlays(self) -> np.ndarray | None:
        return None if self.solved is None else self.solved.overlays

    def _stored_image(self, name: str) -> np.ndarray:
        """Return the image ``(H, W, 3)`` with its lens distortion."""
        frame = self.frame(name)
        if frame.index is None:
            return read_image(frame.image, f"frame {name}", as_stored=frame.as_stored)[0]
        if self._video is None:
            self._video = VideoReader(frame.image, f"the video {frame.image}")
        return self._video.read(frame.index)

    def _masked(self, name: str) -> MaskedImage:
        """Return ``image`` and ``valid`` of a frame, which is read once."""
        return masked_image(self.frame(name), self._stored_image(name), self._overlays)

    def neighbours(self, name: str, count: int = NEIGHBOURS) -> list[str]:
        """Choose at most ``count`` frames as right views of a frame, best first."""
        check_number(count, "neighbours", 1, 32, integer=True)
        solved = self.solve()
        number = self.names.index(self.frame(name).name)
        return [self.names[i] for i in choose_neighbours(solved, number, count)]

    def guidance(
        self, name: str, neighbours: Sequence[str] | int = NEIGHBOURS, **parameters: Any
    ) -> GeometryGuidance:
        """Build the guidance of a frame, with neighbours (by name or number) as right views and solved poses.

        Further arguments are parameters of ``GeometryGuidance``.

        Raises:
            InputError: no frame shares points with it, or a frame without pose.
        """
        solved = self.solve()
        names = self.neighbours(name, neighbours) if isinstance(neighbours, int) else list(neighbours)
        if not names:
            bad_value(f"frame {name}", "connected to other frames by shared points", "no shared points")
        i = self.names.index(name)
        rights = [self.names.index(other) for other in names]
        read = [self._masked(self.names[j]) for j in rights]
        views: list[tuple[Any, ...]] = [(None, solved.K[i], np.eye(4))]
        views += [(image, solved.K[j], solved.pose(i, j)) for j, (image, _) in zip(rights, read, strict=True)]
        settings: dict[str, Any] = {"mask": self.valid(name), "right_mask": tuple(valid for _, valid in read)}
        if solved.status in ADJUSTED:
            settings["pose"] = "given"
        size = self.frame(name).size
        guidance = GeometryGuidance.from_views(views, left_size=size, unit=self.unit, **settings | parameters)
        guidance.calibrated = True  # K is from the capture, or as given for all frames
        guidance.add_findings(self.reasons)
        return guidance

    def check_points(self, points: str, scaled: bool = False) -> None:
        """Raise ``InputError`` if no frame has such depths, or they will not be in metres (``scaled``)."""
        check_choice(points, "points", POINTS)
        if points == "model":
            are_known = any(frame.points is not None for frame in self.frames)
        elif points == "depth":
            are_known = any(frame.depth is not None for frame in self.frames)
        else:
            return
        if not are_known:
            bad_value("points (--points)", "known depths of the capture", repr(points))
        if self.unit is None and not scaled:
            hint = "Pass --metres-per-unit, --known-length or --distance."
            bad_value(
                "points (--points)", "used with a capture of known scale", "a capture without a unit", hint
            )

    def known_depths(self, name: str, points: str) -> np.ndarray | None:
        """Return known depths of a frame for ``GeometryGuidance(points=...)``, or ``None``.

        Raises:
            InputError: the capture has no such points, or no unit.
        """
        self.check_points(points)
        frame = self.frame(name)
        if points == "none":
            return None
        if points == "tracks":
            return self._tracked(self.names.index(frame.name))
        if points == "depth":
            depth_m, known = self.measured_depth(name)
            depth_m = np.where(known, depth_m, 0.0).astype(np.float32)
            return cv2.resize(depth_m, frame.size, interpolation=cv2.INTER_NEAREST)
        if frame.points is None or frame.E is None:
            return None
        return _in_camera(frame.points, frame.E)

    def _tracked(self, number: int) -> np.ndarray | None:
        """Return ``(n, 3)`` solved points in a frame's camera that at least three frames agree on."""
        solved = self.solve()
        if solved.status not in ADJUSTED or not solved.connected[number]:
            return None
        every = np.concatenate([points for _, points in solved.seen])
        seen = solved.seen[number][1]
        frames = np.bincount(every, minlength=len(solved.points))
        xyz = _in_camera(solved.points[seen[frames[seen] >= MIN_FRAMES]], solved.E[number])
        ahead = xyz[xyz[:, 2] > 0]
        return ahead if len(ahead) else None

    def measured_depth(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the capture's depth map of a frame, ``(h, w)`` metres, and its mask of known pixels."""
        frame = self.frame(name)
        if frame.depth is None:
            bad_value("points", "depth maps of the capture", f"none for {name}")
        return read_measured(frame.depth, frame.depth_per_m, f"the depth map of {name}")

    def depth(
        self,
        pipe: Any,
        name: str,
        neighbours: Sequence[str] | int = NEIGHBOURS,
        *,
        seed: int = 0,
        points: str = "tracks",
        parameters: dict[str, Any] | None = None,
        **call: Any,
    ) -> MetricDepthOutput:
        """Estimate the depth of a frame with a guided pipeline.

        Args:
            pipe: pipeline from ``enable_geometry_guidance``.
            name: name of the frame.
            neighbours: names of neighbours, or their number.
            seed: seed of the noise.
            points: known depths: ``"tracks"`` (points of the solve if it refined the poses), ``"none"``,
                ``"model"`` (points of a COLMAP model) or ``"depth"`` (the capture's depth map).
            parameters: parameters of ``GeometryGuidance``.
            **call: further arguments of the pipeline's call.
        """
        measured = self.known_depths(name, points)
        given = {} if measured is None else {"points": measured}
        guidance = self.guidance(name, neighbours, **given | (parameters or {}))
        generator = torch.Generator("cpu").manual_seed(seed)
        return pipe(self.image(name), guidance=guidance, generator=generator, **call)


def _in_camera(points: np.ndarray, E: np.ndarray) -> np.ndarray:
    """Transform world points ``(n, 3)`` to the frame of a camera, float32."""
    T = np.linalg.inv(E)
    return (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)


def choose_neighbours(
    solved: SolvedCapture, frame: int, count: int, among: Collection[int] | None = None
) -> list[int]:
    """Choose at most ``count`` neighbours of a frame, best first, optionally only ``among`` given numbers.

    Each shared point counts by the angle of its two rays, and less if earlier neighbours observe it, so that
    the neighbours together cover the frame. Without shared points, chooses the frames nearest in order.

    Source: Yao et al. 2018 (MVSNet), S5.1: the piecewise Gaussian of the angle.
    """
    values = _values(solved, frame)
    chosen: list[int] = []
    first = 0.0
    left = np.ones(values.shape[1])
    out = (values > 0).sum(1) < MIN_SHARED
    out |= [among is not None and i not in among for i in range(len(out))]
    while len(chosen) < count:
        gains = np.where(out, -1.0, values @ left)
        best = int(np.argmax(gains))
        if gains[best] <= MIN_WORTH_RATIO * first:
            break
        first = first or float(gains[best])
        chosen.append(best)
        out[best] = True
        left = left * np.where(values[best] > 0, REPEATED_WEIGHT, 1.0)
    return chosen if chosen or among is not None else _nearest(solved, frame, count)


def _values(solved: SolvedCapture, frame: int) -> np.ndarray:
    """Return ``(N, P)``: the worth of the frame's points for every other frame, 0 if unobserved."""
    _, points = solved.seen[frame]
    values = np.zeros((len(solved.E), len(points)))
    rays = solved.points[points] - solved.E[frame, :3, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for other, (E, (_, seen)) in enumerate(zip(solved.E, solved.seen, strict=True)):
        if other == frame or not np.isfinite(E).all():
            continue
        back = solved.points[points] - E[:3, 3]
        back /= np.linalg.norm(back, axis=1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip((rays * back).sum(1), -1, 1)))
        width = np.where(angle < BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG)
        worth = np.exp(-0.5 * ((angle - BEST_ANGLE_DEG) / width) ** 2)
        values[other] = worth * np.isin(points, seen)
    return values


def _nearest(solved: SolvedCapture, frame: int, count: int) -> list[int]:
    """Return nearby frames that look in a similar direction, for a frame that shares no points."""
    E = solved.E if solved.E_given is None else solved.E_given
    if not np.isfinite(E[frame]).all():
        return []
    distances = np.linalg.norm(E[:, :3, 3] - E[frame, :3, 3], axis=1)
    angles = np.degrees(np.arccos(np.clip(E[:, :3, 2] @ E[frame, :3, 2], -1, 1)))
    fits = np.isfinite(distances) & (distances > 0) & (angles < 30)
    order = [int(i) for i in np.argsort(np.abs(np.arange(len(E)) - frame)) if fits[i]]
    return order[:count]
