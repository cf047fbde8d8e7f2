"""Samples changed on purpose: another exposure of the right view, wrong poses, a rig that has drifted."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample

#: Errors are drawn between this share of the asked ones and all of them.
LEAST = 0.3

Numbers = tuple[float, float]


def changed_ref(ref: SampleRef, kind: str, change: Numbers) -> SampleRef:
    """The reference to a sample with a change, a key of ``CHANGES``, by whose two numbers it is named."""
    name = f"{ref.name}-{CHANGES[kind][0].format(*change)}"
    return replace(ref, name=name, files={**ref.files, kind: change})


def _two_numbers(text: str, option: str, names: str, most: Numbers, cure: str) -> Numbers:
    """Two numbers with a comma as typed, each from 0 to its ``most``; else ``ValueError`` with the cure."""
    parts = re.fullmatch(r"\s*(\d*\.?\d+)\s*,\s*(\d*\.?\d+)\s*", text)
    first, second = map(float, parts.groups()) if parts else (-1.0, -1.0)
    if not (0 <= first <= most[0] and 0 <= second <= most[1]):
        bad_value(option, f"{names} with numbers in [0, {most[0]:g}] and [0, {most[1]:g}]", repr(text), cure)
    return first, second


def perturbation(text: str) -> Numbers:
    """``DEGREES,SHARE`` as typed: at most 30 degrees, and 0.9 of the baseline."""
    cure = "1.5,0.1 turns by up to 1.5 degrees and shifts by up to a tenth of the baseline."
    return _two_numbers(text, "--perturb", "DEGREES,SHARE", (30, 0.9), cure)


def drift_of(text: str) -> Numbers:
    """``DEGREES,PIXELS`` as typed: at most 5 degrees, and 20 pixels."""
    cure = "0.3,1.5 turns the right camera by 0.3 degrees and moves its image by 1.5 pixels."
    return _two_numbers(text, "--drift", "DEGREES,PIXELS", (5, 20), cure)


def with_exposure(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """Change the right view only: v in [0, 1] becomes ``gain * v ** gamma``, clipped, in 8 bits again."""
    gain, gamma = change
    right_01 = np.clip(gain * (sample.right / 255.0) ** gamma, 0.0, 1.0)
    return replace(sample, name=name, right=np.rint(255 * right_01).astype(np.uint8))


def with_drifted_rig(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """What a rig gives whose right camera has turned since it was calibrated, and whose image has moved.

    Both are a homography of the right image, whatever the depth: calibration and truth stay. ``change`` is
    degrees, about an axis that is drawn from the name, and pixels up or down, likewise.
    """
    degrees, px = change
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    axis = rng.normal(size=3)
    R = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    moved = np.eye(3)
    moved[1, 2] = px * rng.choice((-1.0, 1.0))
    H = moved @ sample.K_right @ R @ np.linalg.inv(sample.K_right)
    size = sample.right.shape[1::-1]
    right = cv2.warpPerspective(sample.right, H, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return replace(sample, name=name, right=right)


def perturbed_pose(
    E: np.ndarray, degrees: float, share: float, depth_m: float, rng: np.random.Generator
) -> np.ndarray:
    """A pose with an error, whose baseline is as long as before: the length is what no photograph tells.

    The turn is at most ``degrees``, the shift that ``share`` of the baseline. Every second error is of a
    tracker's kind, whose shift makes up for its turn at the scene's depth as far as it may; the others' shift
    goes anywhere.
    """
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = axis * np.radians(degrees) * rng.uniform(LEAST, 1.0)
    baseline = float(np.linalg.norm(E[:3, 3]))
    shift = way * share * baseline * rng.uniform(LEAST, 1.0)
    if rng.random() < 0.5:
        shift = -np.cross(turn, (0.0, 0.0, depth_m))
        shift *= min(1.0, share * baseline / max(float(np.linalg.norm(shift)), 1e-12))
    wrong = E.copy()
    wrong[:3, :3] = E[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    moved = E[:3, 3] + E[:3, :3] @ shift
    wrong[:3, 3] = moved * baseline / np.linalg.norm(moved)
    return wrong


def with_perturbed_poses(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """Give the poses of a sample's right views wrongly; images, intrinsics and truth stay.

    The truth says how far away the scene is; the error, ``change`` degrees and share of the baseline at most,
    is drawn from the name.
    """
    sample.check_truth()
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    depth_m, (degrees, share) = float(np.median(sample.depth_m[sample.valid])), change
    E = perturbed_pose(sample.E, degrees, share, depth_m, rng)
    extra = tuple(
        (image, K, perturbed_pose(other, degrees, share, depth_m, rng))
        for image, K, other in sample.extra_views
    )
    return replace(sample, name=name, E=E, E_true=sample.E_scored, extra_views=extra)


Change = Callable[[StereoSample, Any, str], StereoSample]
#: Entry of ``SampleRef.files`` -> what it adds to the name, and how a sample becomes so.
CHANGES: dict[str, tuple[str, Change]] = {
    "right_exposure": ("gain{:g}-gamma{:g}", with_exposure),
    "perturbed": ("turn{:g}-shift{:g}", with_perturbed_poses),
    "drifted": ("drift{:g}-{:g}px", with_drifted_rig),
}
