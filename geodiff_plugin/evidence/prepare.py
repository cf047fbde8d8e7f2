"""Phase 1: cleans the images of one scene, checks and refines their poses, and matches them (``Evidence``).

Source: S7.3 (the plane-sweep view of the g_s search); the matches are beyond it.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

import geodiff_plugin.matching as matching
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin._internal.threads import BackgroundTask, leaves_cpu_free
from geodiff_plugin.cameras import Camera, PosedViews, eroded
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.evidence.plan import EvidencePlan, RowTasks, fit_in_background
from geodiff_plugin.evidence.pose_check import CheckedPoses, check_poses, image_facts, used_as_given
from geodiff_plugin.evidence.valid import BLEND_PX
from geodiff_plugin.formats import undistorted
from geodiff_plugin.matching import clean
from geodiff_plugin.matching.matches import RELIABLE, read_above
from geodiff_plugin.matching.repetition import if_repeated, with_repetition
from geodiff_plugin.matching.rows import first_rectified_pair
from geodiff_plugin.pose.fit import measure_fit, posed_greys
from geodiff_plugin.scale.points import reliable_matches
from geodiff_plugin.trust import FactSheet, MatchesStage, measure


def cleaned(
    images: Sequence[Tensor], masks: Sequence[Tensor | None], config: GuidanceConfig
) -> Sequence[Tensor]:
    """Remove flaws from images ``(3, H, W)`` in [0, 1] of native size if ``clean_images`` is set.

    Flaws are measured where ``masks (H, W)`` bool state that pixels are valid; ``None`` for all.
    """
    if not config.clean_images:
        return images
    # At the edge of a detected border, content is smooth up to this distance inside.
    measured = [None if mask is None else eroded(mask, BLEND_PX) for mask in masks]
    return clean(images, config.sweep_pixels, measured)


def pinhole(
    image_01: np.ndarray, camera: Camera, config: GuidanceConfig, valid: Tensor | None = None
) -> np.ndarray:
    """Return the image ``(H, W, 3)`` of a camera without its lens distortion.

    ``valid (H, W)`` bool are its valid pixels before; ``None`` for all.
    """
    if camera.lens is None:
        return image_01
    # Clean before resampling, which hides the block boundaries of JPEG compression.
    (ready,) = cleaned([torch.from_numpy(image_01).permute(2, 0, 1)], [valid], config)
    return undistorted(ready.permute(1, 2, 0).contiguous().numpy(), camera)


def _with_clean_images(posed: PosedViews, config: GuidanceConfig) -> PosedViews:
    """Return the views with cleaned images; the same object if all images were clean."""
    views = [posed.left, *posed.rights]
    images = [view.image_01 for view in views]
    clear = cleaned(images, [view.valid for view in views], config)
    if all(one is other for one, other in zip(images, clear, strict=True)):
        return posed
    left, *rights = (view._replace(image_01=image) for view, image in zip(views, clear, strict=True))
    return PosedViews(left, tuple(rights))


def plan_evidence(
    left_01: Tensor,
    given: Inputs,
    config: GuidanceConfig,
    measured_baseline: bool = False,
    checked: CheckedPoses | None = None,
) -> EvidencePlan:
    """Clean the images, refine the poses and prepare the evidence of one left image of native size.

    If ``measured_baseline``, refined poses keep the baseline. ``checked`` are the poses found with an earlier
    frame of the rig; they are used without another check.
    """
    checks = bool(given.views) and config.pose != "given" and checked is None
    if checks and leaves_cpu_free(left_01.device):
        return _matched_during_check(left_01, given, config, measured_baseline)
    posed = given.posed_views(left_01)
    points = given.points_on(left_01.device)
    if not posed.rights:
        return prepare_evidence(posed, points, config)
    posed = _with_clean_images(posed, config)
    poses = used_as_given(posed) if checked is None else checked.of_frame(posed.rights)
    if checks:
        greys = posed_greys(posed)
        poses = check_poses(posed, measure_fit(greys), image_facts(greys), measured_baseline)
    plan = prepare_evidence(posed._replace(rights=poses.views), points, config)
    return replace(plan, poses=BackgroundTask.known(poses))


def _matched_during_check(
    left_01: Tensor, given: Inputs, config: GuidanceConfig, measured_baseline: bool
) -> EvidencePlan:
    """Plan the evidence so that the device matches the views while the CPU matches their features.

    The views are matched with the poses as given, since most poses fit. Downscaled images usually show that
    they fit. Any further check then changes no view, and phase 3 is the first to need its result.
    """
    tasks = fit_in_background(given.with_left(left_01))
    plan = None
    posed = given.posed_views(left_01)
    points = given.points_on(left_01.device)
    clear = _with_clean_images(posed, config)
    if clear is not posed:
        tasks = fit_in_background(clear)
    with suppress(InputError):  # raised again below unless a refined pose resolves it
        plan = prepare_evidence(clear, points, config)

    def check() -> CheckedPoses:
        return check_poses(clear, tasks.fit.result(), tasks.images.result(), measured_baseline)

    views = clear.rights
    if tasks.small.result().surely or tasks.fit.result().fits:
        poses = BackgroundTask(check, left_01.device)
    else:
        poses = BackgroundTask.known(check())
        views = poses.result().views
    if plan is None or any(one is not other for one, other in zip(views, clear.rights, strict=True)):
        plan = prepare_evidence(clear._replace(rights=views), points, config)
    return replace(plan, poses=poses)


def prepare_evidence(native: PosedViews, points: Tensor | None, config: GuidanceConfig) -> EvidencePlan:
    """Compute cost volume, matches and points of one image and its right views, all of native size.

    What the configuration does not need is not computed, and is ``None`` in the evidence.
    """
    needs_matches = config.needs_matches(points is not None)
    grid = matching.to_grid(native, config.sweep_pixels)
    volume = None
    matches = None
    known_points = None
    rows = None
    facts = FactSheet()
    outside = 0
    if points is not None:
        known_points, outside = matching.points_to_matches(points, native.left.camera, grid.size)
    if native.rights and (config.search == "volume" or needs_matches):
        # The rows are sent to the CPU during the sweep, and matched once its matches are known.
        rgb_images = first_rectified_pair(native) if needs_matches and config.refine_edges else None
        row_tasks = None if rgb_images is None else RowTasks(rgb_images, native.size)
        volume = matching.build_cost_volume(native, depth_range=config.depth_range, config=config)
        if needs_matches:
            matches = with_repetition(matching.match_volume(volume), volume)
            rows = None if row_tasks is None else row_tasks.match(matches, known_points)
        facts = measure(MatchesStage(native, matches))
    # Both synchronize with the device.
    matches = None if matches is None else if_repeated(matches)
    reliable = None if matches is None else reliable_matches(matches)
    evidence = Evidence(
        native,
        grid,
        volume,
        matches,
        known_points,
        reliable=reliable,
        points_outside=outside,
        facts=facts,
    )
    _read_back(evidence)
    return EvidencePlan(evidence, rows)


def _read_back(evidence: Evidence) -> None:
    """Fill the caches that synchronize with the device now, so that no step has to."""
    if evidence.volume is not None:
        _ = evidence.volume.reach_m, evidence.volume.rectified
    if (points := evidence.points) is not None:
        # ``reliable_matches`` reads the confidence of the matches.
        read_above((points, 0.0), (points, RELIABLE))
