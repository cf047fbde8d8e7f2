"""``Capture``: the frames of a walk with a camera, their poses solved together, depth of any of them."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any, Self

import cv2
import numpy as np
import torch

from geodiff_plugin._checks import bad_value, check_choice, check_number
from geodiff_plugin._threads import available_cores
from geodiff_plugin.capture import NEIGHBOURS, POINTS
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.formats.captures import read_capture
from geodiff_plugin.formats.depth import read_measured
from geodiff_plugin.formats.images import read_image
from geodiff_plugin.formats.layouts import CaptureFrame
from geodiff_plugin.formats.lenses import undistorted
from geodiff_plugin.formats.recordings import VideoReader
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.multiview import GivenFrames, SolvedCapture, solve_capture
from geodiff_plugin.result.output import MetricDepthOutput

#: What a solve is called that moved the given poses, or estimated them.
ADJUSTED = ("solved", "estimated")
#: Its points count as known depths if so many frames see them: two rays alone do not contradict each other.
FEWEST_FRAMES = 3
#: Angle of two rays, degrees, at which a match is worth most.
BEST_ANGLE_DEG = 6.0
#: How fast it is worth less below that angle, degrees: depth becomes inexact.
NARROWER_DEG = 2.5
#: How fast it is worth less above it, degrees: the views look different.
WIDER_DEG = 10.0
#: A point that a chosen neighbour sees already counts so much for the next one.
SEEN_AGAIN = 0.5
#: A neighbour must be worth this share of the best one.
LEAST_SHARE = 0.15
#: Shared points below which two frames are no neighbours.
FEWEST_SHARED = 12


class Capture:
    """Frames of one moving camera with their poses.

    >>> capture = Capture.open("scan")
    >>> out = capture.depth(pipe, "frame_0010")

    ``frames`` are in order, with ``names``; ``kind`` is their layout, ``unit`` ``"m"``, or ``None`` where no
    length is known; ``notes`` are for the user; ``solved`` is the result of ``solve``; ``metres_per_unit`` is
    by what ``rescale`` has multiplied the lengths that the capture came with. ``scale_measured`` is to be set
    where that factor is from a measured length: then an uncertain scale of the poses is no reason against
    trust.
    """

    def __init__(
        self, frames: Sequence[CaptureFrame], kind: str, unit: str | None, notes: Sequence[Message]
    ) -> None:
        self.frames, self.kind, self.unit, self.notes = list(frames), kind, unit, list(notes)
        self.names = [frame.name for frame in frames]
        if len(set(self.names)) < len(self.names):  # one would be taken for the other
            bad_value("the frames", "of different names", ", ".join(self.names))
        self.metres_per_unit = 1.0
        self.solved: SolvedCapture | None = None
        self.scale_measured = False
        self._way: str | None = None  # how it was solved
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
    ) -> Self:
        """Read a capture, a file or folder whose layout is recognised (docs/how-to/captures.md lists them).

        Where it has no intrinsics they are ``K (3, 3)`` pixels, or by a horizontal field of view in degrees;
        ``trajectory`` is of a video, in TUM's form. ``images`` is the folder of the images that a file of
        cameras names, where they lie neither beside it nor near it, or in several copies.

        Raises:
            FileNotFoundError: nothing there.
            InputError: nothing that is a capture, or fewer than two frames.
        """
        return cls(*read_capture(path, K=K, fov=fov, trajectory=trajectory, images=images))

    def __len__(self) -> int:
        return len(self.names)

    def frame(self, name: str) -> CaptureFrame:
        """The frame of a name; ``InputError`` where there is none."""
        if name not in self.names:
            some = ", ".join(self.names[:3])
            cure = "Names are file stems; numbers are FIRST:LAST."
            bad_value("a frame", f"a name of the capture, such as {some}", repr(name), cure)
        return self.frames[self.names.index(name)]

    def choose(self, wanted: str | None) -> list[str]:
        """Names of ``NAME,NAME`` or ``FIRST:LAST:STEP``; all for ``None``."""
        wanted = ":" if wanted is None else wanted
        if ":" not in wanted:
            return [self.frame(name.strip()).name for name in wanted.split(",") if name.strip()]
        match, every = re.fullmatch(r"(\d*):(\d*)(?::0*([1-9]\d*))?", wanted), (0, len(self) - 1, 1)
        numbers = match and [int(n or default) for n, default in zip(match.groups(), every, strict=True)]
        if not numbers or not numbers[0] <= numbers[1] < len(self):
            expected = f"NAME,NAME or FIRST:LAST:STEP, rising numbers from 0 to {len(self) - 1}"
            bad_value("frames (--frames)", expected, repr(wanted))
        first, last, step = numbers
        return self.names[first : last + 1 : step]

    @property
    def poses(self) -> np.ndarray | None:
        """``(N, 4, 4)`` camera-to-world as given, or ``None``."""
        Es = [frame.E for frame in self.frames]
        return None if any(E is None for E in Es) else np.stack([E for E in Es if E is not None])

    def solve(self, poses: str | None = None, *, threads: int | None = None) -> SolvedCapture:
        """Poses of all frames (extra ``capture``), ``"refined"``, the default, or ``"given"``.

        They are kept until the others are asked for. ``threads`` are for features, matching and adjustment,
        all cores by default.

        Raises:
            InputError: pycolmap is missing; frames without poses that cannot be connected.
        """
        check_choice(poses or "refined", "poses", ("refined", "given"))
        if self.solved is None or poses not in (None, self._way):
            self._way = poses or "refined"
            images, K = map(self.image, self.names), np.stack([frame.K for frame in self.frames])
            self.solved = solve_capture(
                (np.rint(cv2.cvtColor(x, cv2.COLOR_RGB2GRAY) * 255).astype(np.uint8) for x in images),
                GivenFrames(self.names, K, self.poses, [frame.size for frame in self.frames]),
                poses=self._way,
                threads=threads or available_cores(),
            )
        return self.solved

    @property
    def doubts(self) -> list[Message]:
        """Messages on the capture and its poses, each of which forbids trust in the depth of every frame."""
        notes = [note for note in (*self.notes, *self.solve().notes) if note.forbids_trust]
        known = self.scale_measured or self.unit is None
        return [note for note in notes if not (known and note.code == "capture.scale")]

    def rescale(self, factor: float) -> None:
        """Multiply all lengths, which then are metres, by a factor above 0."""
        check_number(factor, "metres per unit", 1e-12, 1e12)
        frames, solved, longer = [], self.solved, np.ones((4, 4))
        longer[:3, 3] = factor
        for frame in self.frames:
            points = None if frame.points is None else frame.points * factor
            frames.append(replace(frame, E=None if frame.E is None else frame.E * longer, points=points))
        self.frames, self.unit = frames, "m"
        self.metres_per_unit *= factor
        if solved is not None:
            given = None if solved.E_given is None else solved.E_given * longer
            self.solved = replace(solved, E=solved.E * longer, E_given=given, points=solved.points * factor)

    def image(self, name: str) -> np.ndarray:
        """``(H, W, 3)`` float32 in [0, 1], in the pixels of its camera, free of lens distortion."""
        frame = self.frame(name)
        if frame.index is not None:
            if self._video is None:
                self._video = VideoReader(frame.image, f"the video {frame.image}")
            image = self._video.read(frame.index)
        else:
            image = read_image(frame.image, f"frame {name}", as_stored=frame.as_stored)[0]
        return image if frame.lens is None else undistorted(image, frame.K, frame.lens)

    def neighbours(self, name: str, count: int = NEIGHBOURS) -> list[str]:
        """Frames that are right views of a frame, at most ``count``, the best first."""
        check_number(count, "neighbours", 1, 32, integer=True)
        solved, number = self.solve(), self.names.index(self.frame(name).name)
        return [self.names[i] for i in choose_neighbours(solved, number, count)]

    def guidance(
        self, name: str, neighbours: Sequence[str] | int = NEIGHBOURS, **knobs: Any
    ) -> GeometryGuidance:
        """The guidance of a frame: its neighbours, by name or how many, as right views with the solved poses.

        Further arguments are those of ``GeometryGuidance``.

        Raises:
            InputError: no frame that sees the same; a frame without pose.
        """
        solved = self.solve()
        names = self.neighbours(name, neighbours) if isinstance(neighbours, int) else list(neighbours)
        if not names:
            bad_value(f"frame {name}", "connected to others by shared points", "none shares any")
        i, rights = self.names.index(name), [self.names.index(other) for other in names]
        views: list[tuple[Any, ...]] = [(None, solved.K[i], np.eye(4))]
        views += [(self.image(self.names[j]), solved.K[j], solved.pose(i, j)) for j in rights]
        settings = {"pose": "given"} if solved.status in ADJUSTED else {}
        size = self.frame(name).size
        guidance = GeometryGuidance.from_views(views, left_size=size, unit=self.unit, **settings | knobs)
        guidance.warned = [*self.doubts, *guidance.warned]
        return guidance

    def check_points(self, points: str, scaled: bool = False) -> None:
        """``InputError`` where no frame has such known depths, or they will not be in metres (``scaled``)."""
        check_choice(points, "points", POINTS)
        if points == "model":
            are_known = any(frame.points is not None for frame in self.frames)
        elif points == "depth":
            are_known = any(frame.depth is not None for frame in self.frames)
        else:
            return
        if not are_known:
            bad_value("points (--points)", "known depths that the capture has", repr(points))
        if self.unit is None and not scaled:
            cure = "Give --metres-per-unit, --known-length or --distance."
            bad_value("points (--points)", "of a capture whose scale is known", "one without a unit", cure)

    def known_depths(self, name: str, points: str) -> np.ndarray | None:
        """Known depths of a frame, as ``GeometryGuidance(points=...)`` takes them; ``None`` for none.

        Raises:
            InputError: a capture without such points, or without a unit.
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
        """``(n, 3)`` points of the solve in a frame's camera, those on which at least three frames agree."""
        solved = self.solve()
        if solved.status not in ADJUSTED or not solved.connected[number]:
            return None
        every = np.concatenate([points for _, points in solved.seen])
        seen, frames = solved.seen[number][1], np.bincount(every, minlength=len(solved.points))
        xyz = _in_camera(solved.points[seen[frames[seen] >= FEWEST_FRAMES]], solved.E[number])
        ahead = xyz[xyz[:, 2] > 0]
        return ahead if len(ahead) else None

    def measured_depth(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """The depth map that the capture names for a frame: ``(h, w)`` metres, and where it is known."""
        frame = self.frame(name)
        if frame.depth is None:
            bad_value("points", "depth maps that the capture names", f"none for {name}")
        return read_measured(frame.depth, frame.depth_per_m, f"the depth map of {name}")

    def depth(
        self,
        pipe: Any,
        name: str,
        neighbours: Sequence[str] | int = NEIGHBOURS,
        *,
        seed: int = 0,
        points: str = "tracks",
        knobs: dict[str, Any] | None = None,
        **call: Any,
    ) -> MetricDepthOutput:
        """Depth of a frame by a pipeline with guidance enabled.

        Args:
            pipe: of ``enable_geometry_guidance``.
            name: of the frame.
            neighbours: names, or how many are chosen.
            seed: of the noise.
            points: known depths: ``"tracks"`` (points of the solve, where that moved the poses), ``"none"``,
                ``"model"`` (points of a COLMAP model) or ``"depth"`` (the map that the capture names).
            knobs: further arguments of ``GeometryGuidance``.
            **call: further arguments of the pipeline's call.
        """
        measured = self.known_depths(name, points)
        given = {} if measured is None else {"points": measured}
        guidance = self.guidance(name, neighbours, **given | (knobs or {}))
        generator = torch.Generator("cpu").manual_seed(seed)
        return pipe(self.image(name), guidance=guidance, generator=generator, **call)


def _in_camera(points: np.ndarray, E: np.ndarray) -> np.ndarray:
    """World points ``(n, 3)`` in the frame of a camera, float32."""
    T = np.linalg.inv(E)
    return (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)


def choose_neighbours(
    solved: SolvedCapture, frame: int, most: int, among: Collection[int] | None = None
) -> list[int]:
    """Numbers of at most ``most`` neighbours of a frame, the best first, ``among`` those given if any are.

    Every shared point counts by the angle of its two rays, and less where earlier neighbours see it, so that
    together they see the whole frame. Without shared points: the frames nearest in order.

    Source: Yao et al. 2018 (MVSNet), S5.1: the piecewise Gaussian of the angle.
    """
    values = _values(solved, frame)
    chosen: list[int] = []
    first, left = 0.0, np.ones(values.shape[1])
    out = (values > 0).sum(1) < FEWEST_SHARED
    out |= [among is not None and i not in among for i in range(len(out))]
    while len(chosen) < most:
        gains = np.where(out, -1.0, values @ left)
        best = int(np.argmax(gains))
        if gains[best] <= LEAST_SHARE * first:
            break
        first = first or float(gains[best])
        chosen.append(best)
        out[best] = True
        left = left * np.where(values[best] > 0, SEEN_AGAIN, 1.0)
    return chosen if chosen or among is not None else _nearest(solved, frame, most)


def _values(solved: SolvedCapture, frame: int) -> np.ndarray:
    """``(N, P)`` worth of the frame's points to every other frame, 0 where it does not see them."""
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


def _nearest(solved: SolvedCapture, frame: int, most: int) -> list[int]:
    """Frames near a frame that look the same way, for one that shares no points."""
    E = solved.E if solved.E_given is None else solved.E_given
    if not np.isfinite(E[frame]).all():
        return []
    apart = np.linalg.norm(E[:, :3, 3] - E[frame, :3, 3], axis=1)
    turned = np.degrees(np.arccos(np.clip(E[:, :3, 2] @ E[frame, :3, 2], -1, 1)))
    fits = np.isfinite(apart) & (apart > 0) & (turned < 30)
    order = [int(i) for i in np.argsort(np.abs(np.arange(len(E)) - frame)) if fits[i]]
    return order[:most]
