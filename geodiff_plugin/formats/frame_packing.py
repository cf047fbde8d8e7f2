"""Splits an image or video frame that holds both views: next to or above each other, full or half size.

Half layouts squeeze the views to half their width or height to fit a frame of ordinary size.

Source: frame packing arrangements 3 and 4 in ISO/IEC 14496-10 (H.264), D.2.26.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.findings import Finding

#: ``(width, height)``, pixels; ``cameras`` imports torch.
Size = tuple[int, int]
FULL, HALF, OVER_UNDER, HALF_OVER_UNDER = FRAME_LAYOUTS = ("full", "half", "over-under", "half-over-under")
ARRANGEMENTS = {
    FULL: "side by side",
    HALF: "side by side, each squeezed to half its width",
    OVER_UNDER: "one above the other",
    HALF_OVER_UNDER: "one above the other, each squeezed to half its height",
}


#: Layout -> tags in names of 3D videos, as media players know them (stereoscopicregex of Kodi's
#: advancedsettings.xml).
TAGS = {
    HALF: "h-?sbs|half[ ._-]?sbs",
    FULL: "f-?sbs|full[ ._-]?sbs",
    HALF_OVER_UNDER: "h-?(?:ou|tab)|half[ ._-]?(?:ou|tab)",
    OVER_UNDER: "f-?(?:ou|tab)|full[ ._-]?(?:ou|tab)",
}
#: Usual ratio of width to height of a view, and spread of its logarithm: 4:3 to 16:9 are usual.
USUAL_SHAPE = 1.55
SHAPE_SPREAD = 0.4
#: Mean and spread of ``_anisotropy`` over 59 images of 16 scenes and cameras, and its change by a squeeze.
#: The spread (.26) is widened, because the images of one scene are alike.
USUAL_ANISOTROPY = -0.09
ANISOTROPY_SPREAD = 0.35
SQUEEZE = {HALF: 0.46, HALF_OVER_UNDER: -0.45}
#: Weight of the correlation of the halves: in 28 of 34 real pairs, .25 above the other split's or more.
SIMILARITY_WEIGHT = 8.0
#: Difference of the scores above which the layout counts as clear.
CLEAR_LEAD = 2.5
#: Size of reduced views, (width, height), and maximum shift along their rows for the comparison.
REDUCED = (48, 24)
MAX_SHIFT = 6
#: Change of brightness that noise explains, of 255.
NOISE = 0.3


@dataclass(frozen=True)
class Packing:
    """How a frame holds the left view (first) and the right view.

    Attributes:
        layout: one of ``FRAME_LAYOUTS``.
        finding: how the layout was inferred; ``None`` if it was given.
    """

    layout: str = FULL
    finding: Finding | None = None

    @property
    def is_stacked(self) -> bool:
        """Whether the views are one above the other."""
        return self.layout in (OVER_UNDER, HALF_OVER_UNDER)

    @property
    def stretch(self) -> tuple[int, int]:
        """Factors of width and height that undo the squeeze of a view."""
        return {HALF: (2, 1), HALF_OVER_UNDER: (1, 2)}.get(self.layout, (1, 1))

    def view_size(self, frame: Size) -> Size:
        """Return the ``(width, height)`` of a view in a frame of a size."""
        return (frame[0], frame[1] // 2) if self.is_stacked else (frame[0] // 2, frame[1])

    def shown_size(self, size: Size) -> Size:
        """Return the ``(width, height)`` of a view before it was squeezed, given its size in the frame."""
        return size[0] * self.stretch[0], size[1] * self.stretch[1]

    def split(self, image_01: np.ndarray, name: str = "video") -> tuple[np.ndarray, np.ndarray]:
        """Return both views of a frame ``(H, W, 3)`` as they are in the frame, left view first."""
        axis, word = (0, "height") if self.is_stacked else (1, "width")
        if image_01.shape[axis] % 2:
            height, width = image_01.shape[:2]
            hint = "Otherwise pass the right view's image or video as RIGHT."
            bad_value(name, f"a frame of both views, of even {word}", f"{width}x{height}", hint)
        left, right = map(np.ascontiguousarray, np.split(image_01, 2, axis=axis))
        return left, right

    def squeezed(self, is_squeezed: bool) -> Packing:
        """Return the layout with the same arrangement of views that are squeezed or not."""
        full, half = (OVER_UNDER, HALF_OVER_UNDER) if self.is_stacked else (FULL, HALF)
        return Packing(half if is_squeezed else full)

    def stated_by_cameras(self, size: Size) -> Packing:
        """Return the layout, which the cameras of views ``(width, height)`` state, with a finding."""
        return replace(self, finding=_inferred(self, "LEFT", size, "by its cameras", math.inf))


def find_packing(frames: Sequence[np.ndarray], name: str, path: Path | None = None) -> Packing:
    """Infer how frames of one source hold both views: from tags in the file's name, shape and content.

    A layout's score is high if its halves look alike, if its views have a usual shape once they are
    not squeezed, and if the brightness then changes as much along rows as along columns.

    Args:
        frames: one or several frames ``(H, W, 3)`` of one size.
        name: of the source in messages.
        path: its path, whose name may have a tag of 3D videos.
    """
    height, width = frames[0].shape[:2]
    greys = [_grey(frame) for frame in frames]
    alike = [float(np.mean([_similarity(grey, axis) for grey in greys])) for axis in (0, 1)]
    anisotropy = float(np.mean([_anisotropy(grey) for grey in greys]))
    tagged = _tagged(path)
    scores = {}
    for layout in tagged:
        packing = Packing(layout)
        shown = packing.shown_size(packing.view_size((width, height)))
        shape = math.log(shown[0] / shown[1] / USUAL_SHAPE) / SHAPE_SPREAD
        change = (anisotropy - USUAL_ANISOTROPY - SQUEEZE.get(layout, 0.0)) / ANISOTROPY_SPREAD
        scores[layout] = (
            SIMILARITY_WEIGHT * alike[0 if packing.is_stacked else 1] - (shape**2 + change**2) / 2
        )
    best, *others = sorted(scores, key=lambda layout: -scores[layout])
    lead = scores[best] - scores[others[0]] if others else math.inf
    source = "by its shape and content" if others else "by its name"
    packing = Packing(best)
    view = packing.view_size((width, height))
    return replace(packing, finding=_inferred(packing, name, view, source, lead))


def _inferred(packing: Packing, name: str, view: Size, source: str, lead: float) -> Finding:
    """Report an inferred layout of views ``(width, height)``, as an assumption unless its lead is clear."""
    layout = packing.layout
    squeeze = ""
    if packing.stretch != (1, 1):
        stored, shown = ("{}x{}".format(*each) for each in (view, packing.shown_size(view)))
        squeeze = f" K is for a view of {shown} and is scaled to {stored}, as in the file."
    sentence = f"{name} holds the views {ARRANGEMENTS[layout]} ({layout}), {source}.{squeeze}"
    other = packing.squeezed(packing.stretch == (1, 1)).layout
    if lead > CLEAR_LEAD:
        return Finding(
            "pairs.side-by-side",
            f"{sentence} If this is wrong, pass --side-by-side {other}, or a different layout.",
        )
    factor = {FULL: ", and the depth is half of this", HALF: ", and the depth is twice this"}.get(layout, "")
    hint = f"If they are {ARRANGEMENTS[other]}{factor}, pass --side-by-side {other}."
    return Finding("pairs.layout", f"{sentence} This is uncertain. {hint}")


def _tagged(path: Path | None) -> tuple[str, ...]:
    """Return the layouts that agree with the tag in a file's name, such as ``film.H-SBS.mkv``."""
    for layout, tags in TAGS.items():
        if path is not None and re.search(rf"(?<![a-z0-9])(?:{tags})(?![a-z0-9])", path.stem.lower()):
            return (layout,)
    return FRAME_LAYOUTS


def _grey(frame: np.ndarray) -> np.ndarray:
    """Return the mean of the channels of a frame ``(H, W, 3)``, with levels of 0 to about 255."""
    grey = frame.mean(axis=2, dtype=np.float32)
    return grey if frame.dtype == np.uint8 else 255.0 * grey


def _similarity(grey: np.ndarray, axis: int) -> float:
    """Return the correlation of both halves of a frame ``(H, W)``, reduced, for the best shift along rows."""
    halves = np.array_split(grey[: grey.shape[0] // 2 * 2, : grey.shape[1] // 2 * 2], 2, axis=axis)
    left, right = (cv2.resize(half, REDUCED, interpolation=cv2.INTER_AREA) for half in halves)
    width = REDUCED[0]
    best = -1.0
    for shift in range(-MAX_SHIFT, MAX_SHIFT + 1):
        a = left[:, max(0, shift) : width + min(0, shift)]
        b = right[:, max(0, -shift) : width + min(0, -shift)]
        a, b = a - a.mean(), b - b.mean()
        scale = math.sqrt(float((a * a).sum() * (b * b).sum()))
        best = max(best, float((a * b).sum()) / scale if scale > 0 else 0.0)
    return best


def _anisotropy(grey: np.ndarray) -> float:
    """Return the log ratio of the mean change along rows to that along columns."""
    along_rows, along_columns = (float(np.abs(np.diff(grey, axis=axis)).mean()) for axis in (1, 0))
    return math.log((along_rows + NOISE) / (along_columns + NOISE))
