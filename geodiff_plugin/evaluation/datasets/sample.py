"""The frozen sample that every data set yields, and the reference that loads it.

Data flow: files of a data set -> ``SampleRef`` -> ``StereoSample`` -> methods and metrics.
Paper: S5.1 (data sets); conventions as everywhere in the package.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value

__all__ = [
    "Dataset",
    "ExtraView",
    "SampleRef",
    "StereoSample",
    "depth_to_disparity",
    "disparity_to_depth",
]

ExtraView = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class StereoSample:
    """Two posed views with the truth of the left one.

    Attributes:
        dataset: name of the data set in ``DATASETS``.
        name: name of the sample within it.
        left: ``(H, W, 3)`` uint8, the reference view.
        right: ``(H', W', 3)`` uint8.
        K_left: ``(3, 3)`` float64, pixels of ``left``.
        K_right: ``(3, 3)`` float64, pixels of ``right``.
        E: ``(4, 4)`` float64, metres; pose of the right camera in the left camera's frame.
        depth_m: ``(H, W)`` float32, metres; 0 where the truth is unknown.
        valid: ``(H, W)`` bool, where the truth is known.
        occluded: ``(H, W)`` bool, hidden in the right view or outside it; ``None`` where the set does not
            say.
        material: ``(H, W)`` uint8 material class; ``None`` where the set has none.
        rectified: whether rows are epipolar lines with equal focal lengths (``geometry.is_rectified``).
        notes: what a reader of the numbers should know, e.g. ``truth``, ``disparity_step_px``.
        extra_views: ``(image, K, E)`` of further views, ``E`` the pose in the left camera's frame.
        E_true: ``(4, 4)`` the pose that the right image was taken from, where ``E`` is given wrongly on
            purpose; ``None`` where ``E`` is it.
    """

    dataset: str
    name: str
    left: np.ndarray
    right: np.ndarray
    K_left: np.ndarray
    K_right: np.ndarray
    E: np.ndarray
    depth_m: np.ndarray
    valid: np.ndarray
    occluded: np.ndarray | None = None
    material: np.ndarray | None = None
    rectified: bool = False
    notes: Mapping[str, Any] = field(default_factory=dict)
    extra_views: tuple[ExtraView, ...] = ()
    E_true: np.ndarray | None = None

    @property
    def label(self) -> str:
        """``dataset/name``."""
        return f"{self.dataset}/{self.name}"

    @property
    def measured_baseline(self) -> bool:
        """Whether the length of the baseline is said to be true: a pose given wrongly on purpose keeps it."""
        return self.E_true is not None

    @property
    def E_scored(self) -> np.ndarray:
        """``(4, 4)`` the pose that truth and scores go by, whatever the methods are given."""
        return self.E if self.E_true is None else self.E_true


@dataclass(frozen=True)
class SampleRef:
    """A sample that was found but not read yet.

    Attributes:
        dataset: name of the data set in ``DATASETS``.
        name: name of the sample within it; unique there.
        files: paths and numbers that the data set's loader needs.
    """

    dataset: str
    name: str
    files: Mapping[str, Any]

    @property
    def label(self) -> str:
        """``dataset/name``."""
        return f"{self.dataset}/{self.name}"


@dataclass(frozen=True)
class Dataset:
    """One data set: how to find it, how to read it, how it is scored.

    Attributes:
        name: key in ``DATASETS``.
        find: folder -> references in a fixed order; an empty list where the folder holds none.
        load: reference -> sample.
        cap_m: farthest truth that counts in the set's own protocol, metres; ``None`` for no limit.
        obtain: how to get the set, one sentence with its address and licence.
        options: keywords that ``find`` takes beside the folder.
        full_count: number of pairs in the set as the paper used it; ``None`` where it does not apply.
        needs_folder: whether there is anything to find; not for what is rendered.
    """

    name: str
    find: Callable[..., list[SampleRef]]
    load: Callable[[SampleRef], StereoSample]
    cap_m: float | None
    obtain: str
    options: tuple[str, ...] = ()
    full_count: int | None = None
    needs_folder: bool = True


def disparity_to_depth(
    disparity_px: np.ndarray, K_left: np.ndarray, K_right: np.ndarray, E: np.ndarray
) -> np.ndarray:
    """Depth of a rectified pair's disparity: ``f b / (d + cx_right - cx_left)``.

    Args:
        disparity_px: ``(H, W)`` float, ``x_left - x_right`` in pixels.
        K_left: ``(3, 3)``, pixels.
        K_right: ``(3, 3)``, pixels; its cx minus the left one is Middlebury's ``doffs``.
        E: ``(4, 4)``, metres; pose of the right camera in the left camera's frame.

    Returns:
        ``(H, W)`` float32, metres; 0 where the shifted disparity is not positive or not finite.
    """
    shifted = np.asarray(disparity_px, np.float64) + (K_right[0, 2] - K_left[0, 2])
    known = np.isfinite(shifted) & (shifted > 0)
    depth_m = np.zeros(shifted.shape)
    depth_m[known] = K_left[0, 0] * E[0, 3] / shifted[known]
    if E[0, 3] <= 0:
        bad_value("E[0, 3]", "positive, the right camera to the right", E[0, 3], "Swap the two views.")
    return depth_m.astype(np.float32)


def depth_to_disparity(
    depth_m: np.ndarray, K_left: np.ndarray, K_right: np.ndarray, E: np.ndarray
) -> np.ndarray:
    """Inverse of ``disparity_to_depth`` for positive depth.

    Args:
        depth_m: ``(H, W)`` float, metres, positive.
        K_left: ``(3, 3)``, pixels.
        K_right: ``(3, 3)``, pixels.
        E: ``(4, 4)``, metres.

    Returns:
        ``(H, W)`` float64, pixels.
    """
    return K_left[0, 0] * E[0, 3] / np.asarray(depth_m, np.float64) - (K_right[0, 2] - K_left[0, 2])
