"""Samples changed on purpose: another exposure of the right view, wrong poses, a rig that has drifted."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample

__all__ = [
    "drift_of",
    "drifted_ref",
    "exposed_ref",
    "perturbation",
    "perturbed_pose",
    "perturbed_ref",
    "with_drifted_rig",
    "with_exposure",
    "with_perturbed_poses",
]


def exposed_ref(ref: SampleRef, gain: float, gamma: float) -> SampleRef:
    """The reference to a sample with a changed right view; it is named by what was changed."""
    name = f"{ref.name}-gain{gain:g}-gamma{gamma:g}"
    return replace(ref, name=name, files={**ref.files, "right_exposure": (gain, gamma)})


def with_exposure(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """Change the right view only.

    Args:
        sample: as it was taken.
        change: gain and gamma; a value v in [0, 1] becomes ``gain * v ** gamma``, clipped as a sensor clips
            and rounded to 8 bits again.
        name: of the result.
    """
    gain, gamma = change
    right_01 = np.clip(gain * (sample.right / 255.0) ** gamma, 0.0, 1.0)
    return replace(sample, name=name, right=np.rint(255 * right_01).astype(np.uint8))


#: Errors are drawn between this share of the asked ones and all of them.
LEAST = 0.3


def _two_numbers(
    text: str, option: str, names: str, most: tuple[float, float], cure: str
) -> tuple[float, float]:
    """Two numbers with a comma as typed, each from 0 to its ``most``; else an error with the cure."""
    found = re.fullmatch(r"\s*([\d.]+)\s*,\s*([\d.]+)\s*", text)
    try:
        one, other = (float(number) for number in found.groups()) if found else (-1.0, -1.0)
    except ValueError:  # two points in a number
        one, other = -1.0, -1.0
    if not (0 <= one <= most[0] and 0 <= other <= most[1]):
        bad_value(option, f"{names} with numbers in [0, {most[0]:g}] and [0, {most[1]:g}]", repr(text), cure)
    return one, other


def drift_of(text: str) -> tuple[float, float]:
    """``DEGREES,PIXELS`` as typed.

    Raises:
        ValueError: not two numbers, an angle outside [0, 5], or pixels outside [0, 20].
    """
    cure = "0.3,1.5 turns the right camera by 0.3 degrees and moves its image by 1.5 pixels."
    return _two_numbers(text, "--drift", "DEGREES,PIXELS", (5, 20), cure)


def drifted_ref(ref: SampleRef, change: tuple[float, float]) -> SampleRef:
    """The reference to a sample whose right camera has drifted; it is named by how far."""
    name = f"{ref.name}-drift{change[0]:g}-{change[1]:g}px"
    return replace(ref, name=name, files={**ref.files, "drifted": change})


def with_drifted_rig(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """What a rig gives whose right camera has turned since it was calibrated, and whose image has moved.

    Both are a homography of the right image, whatever the depth: calibration and truth stay.

    Args:
        sample: as it was taken.
        change: degrees, about an axis that is drawn, and pixels up or down.
        name: of the result; the axis and the way are drawn from it.
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


def perturbation(text: str) -> tuple[float, float]:
    """``DEGREES,SHARE`` as typed.

    Raises:
        ValueError: not two numbers, an angle outside [0, 30], or a share outside [0, 0.9].
    """
    cure = "1.5,0.1 turns by up to 1.5 degrees and shifts by up to a tenth of the baseline."
    return _two_numbers(text, "--perturb", "DEGREES,SHARE", (30, 0.9), cure)


def perturbed_ref(ref: SampleRef, change: tuple[float, float]) -> SampleRef:
    """The reference to a sample with perturbed poses; it is named by what was changed."""
    name = f"{ref.name}-turn{change[0]:g}-shift{change[1]:g}"
    return replace(ref, name=name, files={**ref.files, "perturbed": change})


def perturbed_pose(
    E: np.ndarray, degrees: float, share: float, depth_m: float, rng: np.random.Generator
) -> np.ndarray:
    """A pose with an error.

    Args:
        E: ``(4, 4)``, metres; pose of the right camera in the left camera's frame.
        degrees: the largest turn.
        share: the largest shift, of the baseline.
        depth_m: of the scene.
        rng: draws the error. Every second one is of a tracker's kind, whose shift makes up for its turn at
            the scene's depth as far as it may; the others' shift goes anywhere.

    Returns:
        ``(4, 4)``; its baseline is as long as before: the length is what no photograph tells.
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

    Args:
        sample: as it was taken.
        change: degrees and share, as for ``perturbed_pose``.
        name: of the result; the error is drawn from it.

    Raises:
        ValueError: a sample without truth, which says how far away its scene is.
    """
    if not sample.valid.any():
        bad_value(f"the truth of {sample.label}", "known for at least one pixel", "none")
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    depth_m = float(np.median(sample.depth_m[sample.valid]))
    degrees, share = change
    E = perturbed_pose(sample.E, degrees, share, depth_m, rng)
    extra = tuple(
        (image, K, perturbed_pose(other, degrees, share, depth_m, rng))
        for image, K, other in sample.extra_views
    )
    return replace(sample, name=name, E=E, E_true=sample.E_scored, extra_views=extra)
