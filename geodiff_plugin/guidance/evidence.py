"""From what the user gave to ``Evidence``: photographs cleaned, poses refined, volume and matches made, once.

S3.3 takes exact poses for granted; ``pose.refine`` starts from a first depth, which a coarse sweep gives.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.evidence import Evidence, prepare_evidence
from geodiff_plugin.config import DEFAULT, GuidanceConfig
from geodiff_plugin.guidance.inputs import Inputs
from geodiff_plugin.matching import clean
from geodiff_plugin.matching.build import pilot_volume
from geodiff_plugin.matching.consistency import match_volume
from geodiff_plugin.pose.refine import refine_views, untouched
from geodiff_plugin.types import CameraView, PoseReport

# Windows that spread reliable matches into holes, pixels of the coarse sweep; a wider one counts a hundredth.
_WINDOWS = (3, 7, 15, 31, 63)
# Least inverse depth, as a share of the largest.
_FARTHEST = 1e-3


def cleaned(image_01: Tensor, config: GuidanceConfig) -> Tensor:
    """A photograph ``(3, H, W)`` in [0, 1] of native size, as the knob ``clean_photographs`` says."""
    return clean(image_01, config.sweep_pixels) if config.clean_photographs else image_01


def pose_views(
    left_01: Tensor,
    rights: Sequence[CameraView],
    K_left: Tensor,
    config: GuidanceConfig = DEFAULT,
    unit: str | None = "m",
    measured: bool = False,
) -> tuple[tuple[CameraView, ...], PoseReport]:
    """The right views with the poses of the knob ``pose``, and the report; arguments as ``refine_views``."""
    if config.pose == "given":
        return untouched(rights)
    first_depth = partial(coarse_depth, left_01, K_left=K_left)
    return refine_views(left_01, rights, K_left, first_depth, unit, measured)


def coarse_depth(left_01: Tensor, rights: Sequence[CameraView], K_left: Tensor) -> Tensor:
    """A rough, smooth depth without holes, ``(1, 1, h, w)`` metres: a coarse sweep, its matches spread."""
    matches = match_volume(pilot_volume(left_01, rights, K_left))
    weight = matches.confidence[None] ** 2 + 1e-9
    values = matches.inverse_depth[None] * weight
    above, below = values.clone(), weight.clone()
    for i, window in enumerate(_WINDOWS):
        share = 100.0 ** -(i + 1)
        above += share * F.avg_pool2d(values, window, 1, window // 2, count_include_pad=False)
        below += share * F.avg_pool2d(weight, window, 1, window // 2, count_include_pad=False)
    inverse = F.avg_pool2d(above / below, 5, 1, 2, count_include_pad=False)
    return 1.0 / inverse.clamp_min(_FARTHEST * float(inverse.max()))


def make_evidence(
    left_01: Tensor, given: Inputs, config: GuidanceConfig, needs_matches: bool, measured: bool = False
) -> Evidence:
    """Clean the photographs, refine the poses, and prepare the ``Evidence`` of one left image.

    ``left_01 (3, H, W)`` float32 in [0, 1] has its native size; ``needs_matches`` is whether the volume is
    aggregated and checked against each view, ``measured`` whether the baselines' lengths are measured.
    """
    views, K_left, points = given.on(left_01.device)
    if not views:
        return prepare_evidence(left_01, views, K_left, points, config, needs_matches)
    left_01 = cleaned(left_01, config)
    views = [view._replace(image_01=cleaned(view.image_01, config)) for view in views]
    posed, report = pose_views(left_01, views, K_left, config, given.unit, measured)
    return prepare_evidence(left_01, posed, K_left, points, config, needs_matches, report)


class EvidenceStore:
    """Remembers evidence by the values that it was made from: images, cameras, points and settings.

    Give one to the ``GeometryGuidance`` of every call that is to share: ``guidance.evidence_store = store``.
    """

    def __init__(self, size: int = 2, copies: bool = True) -> None:
        """Keep the evidence of the last ``size`` images; about 100 MB each with its cost volume.

        ``copies=False`` keeps the images themselves; then nobody may change them in place.
        """
        self._size, self._copies, self._spared = size, copies, 0.0
        # Tensors and settings that an entry was made from, the entry, and the seconds that it took.
        self._entries: list[tuple[list[Tensor | None], tuple[Any, ...], Evidence, float]] = []

    def get(
        self,
        left_01: Tensor,
        given: Inputs,
        config: GuidanceConfig,
        needs_matches: bool,
        measured: bool = False,
    ) -> Evidence:
        """What ``make_evidence`` gives for these arguments; the caller must not change it."""
        views = [value for view in given.views for value in view]
        tensors = [left_01, torch.from_numpy(given.K_left), given.points, *views]
        knobs = ("pose", "clean_photographs", "depth_range", "planes", "sweep_pixels")
        settings = (*(getattr(config, name) for name in knobs), config.search == "volume")
        settings = (*settings, needs_matches, measured, given.unit)
        for held, made_with, evidence, seconds in self._entries:
            if made_with == settings and len(held) == len(tensors) and all(map(_equal, held, tensors)):
                self._spared += seconds
                return evidence
        start = time.perf_counter()
        evidence = make_evidence(left_01, given, config, needs_matches, measured)
        # Copies, so that an image that was changed in place since is not taken for the same.
        held = [value.clone() if self._copies and value is not None else value for value in tensors]
        self._entries.insert(0, (held, settings, evidence, time.perf_counter() - start))
        del self._entries[self._size :]
        return evidence

    def take_spared_seconds(self) -> float:
        """Seconds saved since the last call of this; a fair account of time adds them."""
        spared, self._spared = self._spared, 0.0
        return spared


def _equal(a: Tensor | None, b: Tensor | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.device == b.device and a.shape == b.shape and torch.equal(a, b)
