"""Overlays of a capture: content that stays at one pixel while the camera moves, such as burnt-in text.

``static_features`` are not used to solve poses; ``static_pixels`` get no depth.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial import cKDTree

from geodiff_plugin.findings import Finding

#: Maximum number of frames, evenly spaced, in which static features are sought.
MAX_FRAMES = 40
#: Minimum number of frames of a capture.
MIN_FRAMES = 4
#: A feature is static if this fraction of the frames have a similar one at its place.
MIN_FRACTION = 0.4
#: Maximum distance of these features in pixels.
MAX_DISTANCE_PX = 0.75
#: Minimum cosine of their descriptors.
MIN_COSINE = 0.85
#: Above this fraction of static features in the median frame, the camera itself stands still.
MAX_STATIC_FRACTION = 0.6
#: Features up to this distance in pixels from a static one are dropped as well.
NEAR_PX = 3.0
#: Maximum longer side of the images in which static pixels are sought.
LONG_SIDE = 480
#: Maximum number of these images.
MAX_SAMPLES = 24
#: Number of frames that are compared with all others: an overlay in 40 % of the frames is in one of them.
REFERENCES = 6
#: Minimum gradient of an overlay, grey levels per pixel.
MIN_GRADIENT = 5.0
#: Minimum cosine between the gradients of two frames at a static pixel.
MIN_GRADIENT_COSINE = 0.9
#: Maximum ratio of their lengths, which depend on what is behind.
MAX_GRADIENT_RATIO = 2.0
#: Half width in pixels of the windows in which gradients are similar, and have two directions.
WINDOW = 4
#: Minimum fraction of the squared gradients in a window that are similar.
MIN_ALIKE = 0.6
#: Minimum of the smaller eigenvalue of their structure tensor, squared grey levels per pixel.
MIN_CORNER = 8.0
#: Maximum distance between parts of one overlay, as a fraction of the longer side.
CLOSED_FRACTION = 0.012
#: Maximum range of grey levels over all frames in the panel or frame around static texture.
MAX_LEVELS = 6
#: Margin around overlays in pixels, for the width of edges. Matching adds the radius of its windows.
MARGIN_PX = 2


def static_features(px: Sequence[np.ndarray], descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """Find the pixels ``(M, 2)`` of static features; empty if there are none, or if the camera stands still.

    Args:
        px: ``(n, 2)`` pixels of the features of each frame, all frames of one size.
        descriptors: ``(n, D)`` of any type and length.
    """
    chosen = sampled_frames(len(px), MAX_FRAMES)
    nothing = np.zeros((0, 2))
    if len(px) < MIN_FRAMES:
        return nothing
    places = np.concatenate([px[i] for i in chosen]).astype(np.float64)
    values = np.concatenate([descriptors[i] for i in chosen]).astype(np.float32)
    values /= np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)
    frame = np.repeat(np.arange(len(chosen)), [len(px[i]) for i in chosen])
    if not len(places):
        return nothing
    one, other = cKDTree(places).query_pairs(MAX_DISTANCE_PX, output_type="ndarray").T
    same = (frame[one] != frame[other]) & ((values[one] * values[other]).sum(1) > MIN_COSINE)
    seen = np.zeros((len(places), len(chosen)), bool)
    seen[np.arange(len(places)), frame] = True
    seen[one[same], frame[other[same]]] = True
    seen[other[same], frame[one[same]]] = True
    static = seen.sum(1) >= max(MIN_FRACTION * len(chosen), MIN_FRAMES - 1)
    fractions = np.bincount(frame, static, len(chosen)) / np.maximum(
        np.bincount(frame, minlength=len(chosen)), 1
    )
    return nothing if np.median(fractions) > MAX_STATIC_FRACTION else places[static]


def moving(px: np.ndarray, static: np.ndarray) -> np.ndarray:
    """Return which of the features ``(n, 2)`` are not near static ones ``(M, 2)``, ``(n,)`` bool."""
    if not len(static) or not len(px):
        return np.ones(len(px), bool)
    return np.asarray(cKDTree(static).query(px, distance_upper_bound=NEAR_PX)[0] > NEAR_PX)


def sampled_frames(count: int, most: int = MAX_SAMPLES) -> list[int]:
    """Return the numbers of at most ``most`` evenly spaced frames."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, most)).round()})


def reduced(grey: np.ndarray) -> np.ndarray:
    """Downscale a grey image to at most ``LONG_SIDE`` pixels for ``static_pixels``."""
    factor = min(1.0, LONG_SIDE / max(grey.shape))
    height, width = (max(1, round(side * factor)) for side in grey.shape)
    return cv2.resize(np.ma.getdata(grey), (width, height), interpolation=cv2.INTER_AREA)


def static_pixels(greys: Sequence[np.ndarray], others: Sequence[np.ndarray] = ()) -> np.ndarray | None:
    """Find overlays: texture that stays at one pixel while the rest of the image moves.

    Frames between which the camera stands still count once. Content at infinity may be found as well, if the
    camera does not turn; its depth cannot be measured.

    Args:
        greys: ``(H, W)`` uint8 of one size each, from ``reduced``, in order.
        others: the same of the right camera of a rig, which must show the same overlays. A part of the rig,
            which is at another pixel there, is a part of the scene.

    Returns:
        ``(H, W)`` bool, true for overlays and a margin; ``None`` if there are none, or too few frames.
    """
    if len({grey.shape for grey in (*greys, *others)}) != 1:
        return None
    gradients, of_others = [_gradients(grey) for grey in greys], [_gradients(grey) for grey in others]
    chosen = [0]
    for i in range(1, len(greys)):
        if _same(gradients[chosen[-1]], gradients[i])[1] < MAX_STATIC_FRACTION:
            chosen.append(i)
    if len(chosen) < MIN_FRAMES:
        return None
    least = max(MIN_FRACTION * len(chosen), MIN_FRAMES - 1)
    found = np.zeros(greys[0].shape, bool)
    for reference in sorted({chosen[int(k)] for k in np.linspace(0, len(chosen) - 1, REFERENCES).round()}):
        static = _count(gradients[reference], [gradients[i] for i in chosen]) >= least
        if others:
            static &= _count(gradients[reference], of_others) >= MIN_FRACTION * len(others)
        found |= _corners(gradients[reference], static)
    return _whole(found, np.stack([greys[i] for i in chosen])) if found.any() else None


def overlay_finding(overlays: np.ndarray) -> Finding:
    """Return the finding on ``static_pixels`` that were found."""
    sentence = (
        f"{100 * overlays.mean():.1f} % of the image stays the same while the camera moves (burnt-in text, a "
        "frame, or part of the rig): these pixels influence nothing and get no depth."
    )
    return Finding("image.overlays", sentence)


def _gradients(grey: np.ndarray) -> np.ndarray:
    """Return the gradient ``(2, H, W)`` float32 of grey levels per pixel, 0 where it is weak."""
    smooth = cv2.GaussianBlur(grey, (3, 3), 0)
    both = np.stack([cv2.Sobel(smooth, cv2.CV_32F, x, 1 - x, scale=0.125) for x in (1, 0)])
    return both * ((both**2).sum(0) > MIN_GRADIENT**2)


def _same(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, float]:
    """Return where two gradients ``(2, H, W)`` and their windows are similar, and the fraction of ``one``."""
    lengths = [np.sqrt((each**2).sum(0)) for each in (one, other)]
    product = lengths[0] * lengths[1]
    low = np.minimum(*lengths)
    high = np.maximum(*lengths)
    same = ((one * other).sum(0) > MIN_GRADIENT_COSINE * product) & (high < MAX_GRADIENT_RATIO * low)
    weight = lengths[0] ** 2
    alike, total = (cv2.blur(each, (2 * WINDOW + 1,) * 2) for each in (weight * same, weight))
    same &= alike > MIN_ALIKE * total
    return same, float(same.sum() / max((lengths[0] > 0).sum(), 1))


def _count(gradient: np.ndarray, others: Sequence[np.ndarray]) -> np.ndarray:
    """Count the other gradients that are similar, ``(H, W)``."""
    count = np.zeros(gradient.shape[1:], np.uint8)
    for other in others:
        count += _same(gradient, other)[0]
    return count


def _corners(gradient: np.ndarray, static: np.ndarray) -> np.ndarray:
    """Return the static pixels around which gradients have two directions; an edge may move along itself."""
    x, y = gradient * static
    xx, yy, xy = (cv2.blur(each, (2 * WINDOW + 1,) * 2) for each in (x * x, y * y, x * y))
    smaller = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    return static & (smaller > MIN_CORNER)


def _whole(found: np.ndarray, greys: np.ndarray) -> np.ndarray:
    """Complete overlays: letters of one line, and the panel or frame that they stand on."""
    side = 2 * round(CLOSED_FRACTION * max(found.shape)) + 1
    joined = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)) > 0
    constant = np.ptp(greys, axis=0) <= MAX_LEVELS
    _, labels = cv2.connectedComponents((joined | constant).astype(np.uint8), connectivity=4)
    touched = np.isin(labels, np.unique(labels[joined])) & constant
    return _dilated(joined | touched, MARGIN_PX)


def _dilated(mask: np.ndarray, radius: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0
