"""Typical calibration mistakes, applied to correct pairs for ``geodiff eval trust``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from geodiff_plugin.evaluation.datasets.sample import StereoSample

__all__ = ["WRONG", "WRONG_POINTS", "case_kinds", "make_case"]

Other = Callable[[], StereoSample]
Change = Callable[[StereoSample, Other], StereoSample]
#: Known points of the cases about points: so many of the truth.
POINTS = 200


def _scaled_baseline(factor: float) -> Change:
    def change(sample: StereoSample, other: Other) -> StereoSample:
        E = sample.E.copy()
        E[:3, 3] *= factor
        return replace(sample, E=E)

    return change


def _scaled_K(factor: float) -> Change:
    """Focal lengths of another size, and the principal point in the middle, where it says nothing."""

    def change(sample: StereoSample, other: Other) -> StereoSample:
        def scaled(K: np.ndarray) -> np.ndarray:
            return K * np.array([[factor, factor, 1.0], [factor, factor, 1.0], [1.0, 1.0, 1.0]])

        return replace(sample, K_left=scaled(sample.K_left), K_right=scaled(sample.K_right))

    return change


def _swapped(sample: StereoSample, other: Other) -> StereoSample:
    return replace(sample, left=sample.right, right=sample.left)


def _inverse(sample: StereoSample, other: Other) -> StereoSample:
    return replace(sample, E=np.linalg.inv(sample.E))


def _axis(sample: StereoSample, other: Other) -> StereoSample:
    E = sample.E.copy()
    E[:3, 3] = E[[1, 0, 2], 3]
    return replace(sample, E=E)


def _tilted(sample: StereoSample, other: Other) -> StereoSample:
    """As if not rectified: the right camera nods by two degrees."""
    c, s = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    nod = np.eye(4)
    nod[1:3, 1:3] = [[c, -s], [s, c]]
    return replace(sample, E=sample.E @ nod)


def _mirrored(sample: StereoSample, other: Other) -> StereoSample:
    return replace(sample, right=np.ascontiguousarray(sample.right[:, ::-1]))


def _unrelated(sample: StereoSample, other: Other) -> StereoSample:
    given = other()
    return replace(sample, right=given.right, K_right=given.K_right)


def _one_picture(sample: StereoSample, other: Other) -> StereoSample:
    return replace(sample, right=sample.left.copy(), K_right=sample.K_left)


def _shifted(sample: StereoSample, other: Other) -> StereoSample:
    """The right picture is the left one, moved: every disparity is the same."""
    shift = max(2, sample.left.shape[1] // 20)
    return replace(sample, right=np.roll(sample.left, -shift, axis=1), K_right=sample.K_left)


WRONG: dict[str, tuple[str, Change]] = {
    "swapped": ("left and right images exchanged", _swapped),
    "inverse": ("E is world-to-camera", _inverse),
    "axis": ("E along y where it is along x", _axis),
    "millimetres": ("baseline in millimetres", _scaled_baseline(1000.0)),
    "thousandth": ("baseline divided by 1000 once too often", _scaled_baseline(0.001)),
    "K-1.5": ("K of an image 1.5 times as large, centred", _scaled_K(1.5)),
    "K-2": ("K of an image twice as large, centred", _scaled_K(2.0)),
    "K-0.67": ("K of an image 0.67 times as large, centred", _scaled_K(0.67)),
    "tilted": ("not rectified: 2 degrees of pitch", _tilted),
    "mirrored": ("right image mirrored", _mirrored),
    "unrelated": ("right image of another scene", _unrelated),
    "one-picture": ("the left image twice", _one_picture),
    "shifted": ("right image a shifted copy of the left one", _shifted),
}
"""Kind -> what it is, and how a sample becomes so (given another sample too)."""

#: What becomes of true points: KITTI's 1/256 m read as millimetres, millimetres as metres, a wrong unit.
WRONG_POINTS = {"points-256": 0.256, "points-mm": 1000.0, "points-3": 3.0}


def _points(sample: StereoSample, seed: int = 0) -> np.ndarray:
    rows, columns = np.nonzero(sample.valid)
    some = np.random.default_rng(seed).permutation(len(rows))[:POINTS]
    z = sample.depth_m[rows[some], columns[some]].astype(np.float64)
    rays = np.stack([columns[some], rows[some], np.ones(len(some))], axis=1) @ np.linalg.inv(sample.K_left).T
    return rays * z[:, None]


def case_kinds(kinds: tuple[str, ...]) -> tuple[str, ...]:
    """The right sample, with points too where some kind is about them, and then the kinds."""
    pointed = any(kind in WRONG_POINTS for kind in kinds)
    return ("right", *(("right, points",) if pointed else ()), *kinds)


def make_case(kind: str, sample: StereoSample, other: Other) -> tuple[StereoSample, np.ndarray | None, bool]:
    """A sample, right or wrong in one way.

    Args:
        kind: of ``case_kinds``.
        sample: right.
        other: gives another one, whose right image is "unrelated".

    Returns:
        The sample as it is given to the method; ``(N, 3)`` points in metres that go with it, or ``None``; and
        whether its truth still is that of its left image.
    """
    if kind == "right":
        return sample, None, True
    if kind == "right, points":
        return sample, _points(sample), True
    if kind in WRONG_POINTS:
        return sample, WRONG_POINTS[kind] * _points(sample), True
    return WRONG[kind][1](sample, other), None, kind != "swapped"
