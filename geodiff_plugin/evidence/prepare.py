"""Act 1: clean the photographs of one image, check and refine their poses, match them: ``Evidence``.

Source: S7.3 (the plane-sweep view of the g_s search); the matches are beyond it.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

import geodiff_plugin.matching as matching
from geodiff_plugin._checks import InputError
from geodiff_plugin._threads import BackgroundTask, leaves_cpu_free, sent_to_cpu
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.matching import Matches, clean
from geodiff_plugin.matching.matches import read_above
from geodiff_plugin.matching.rows import RowMatches, RowPictures, match_rows, rectified_pictures
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.fit import PoseFit, fit_of_small, measure_fit, posed_greys
from geodiff_plugin.pose.mistakes import INVERSE
from geodiff_plugin.pose.refine import refine_views, report_as_given
from geodiff_plugin.scale.points import RELIABLE, reliable_matches
from geodiff_plugin.types import PosedViews


def cleaned(images: Sequence[Tensor], config: GuidanceConfig) -> Sequence[Tensor]:
    """Photographs ``(3, H, W)`` in [0, 1] of native size, without flaws if ``clean_photographs`` is set."""
    return clean(images, config.sweep_pixels) if config.clean_photographs else images


def _with_clean_images(posed: PosedViews, config: GuidanceConfig) -> PosedViews:
    """The views with clean photographs; the same record if all of them were clean."""
    images = [posed.left_01, *(view.image_01 for view in posed.views)]
    left_01, *rights = clear = cleaned(images, config)
    if all(one is other for one, other in zip(images, clear, strict=True)):
        return posed
    views = (view._replace(image_01=image) for view, image in zip(posed.views, rights, strict=True))
    return posed._replace(left_01=left_01, views=tuple(views))


def make_evidence(
    left_01: Tensor, given: Inputs, config: GuidanceConfig, measured_baseline: bool = False
) -> Evidence:
    """Clean the photographs, refine the poses, and prepare the ``Evidence`` of one native left image.

    ``measured_baseline``: a refined pose keeps the distance between the cameras.
    """
    checks = bool(given.views) and config.pose != "given"
    if checks and leaves_cpu_free(left_01.device):
        return _made_during_check(left_01, given, config, measured_baseline)
    posed, points = given.posed_views(left_01), given.points_on(left_01.device)
    if not posed.views:
        return prepare_evidence(posed, points, config)
    posed = _with_clean_images(posed, config)
    if not checks:
        report = report_as_given(posed.views)
    else:
        views, report = refine_views(posed, measure_fit(posed_greys(posed)), measured_baseline)
        posed = posed._replace(views=views)
    return replace(prepare_evidence(posed, points, config), report=BackgroundTask.known(report))


def _made_during_check(
    left_01: Tensor, given: Inputs, config: GuidanceConfig, measured_baseline: bool
) -> Evidence:
    """The same, where the device matches the views while the CPU matches their features.

    That begins before it is known whether the photographs are clean, and again if they were not. As most
    poses fit, the views are matched as given. Small pictures mostly show that they fit; what else there is to
    find then changes no view, and act 3 is the first to ask.
    """
    check, evidence = _check_in_background(given.with_left(left_01)), None
    posed, points = given.posed_views(left_01), given.points_on(left_01.device)
    clear = _with_clean_images(posed, config)
    if clear is not posed:
        check = _check_in_background(clear)
    with suppress(InputError):  # raised again below, unless a refined pose mends it
        evidence = prepare_evidence(clear, points, config)
    views = clear.views
    if check.small.result().surely or check.fit.result().fits:
        fit = check.fit
        report = BackgroundTask(
            lambda: refine_views(clear, fit.result(), measured_baseline).report, left_01.device
        )
    else:
        views, found = refine_views(clear, check.fit.result(), measured_baseline)
        report = BackgroundTask.known(found)
    if evidence is None or any(one is not other for one, other in zip(views, clear.views, strict=True)):
        evidence = prepare_evidence(clear._replace(views=views), points, config)
    return replace(evidence, report=report)


class _Check(NamedTuple):
    """Whether poses fit, as the CPU works it out."""

    small: BackgroundTask[PoseFit]  # ``fit_of_small``, there first
    fit: BackgroundTask[PoseFit]


def _check_in_background(posed: PosedViews) -> _Check:
    """The check of views of which the left one, at least, is on the device."""
    device = posed.left_01.device
    greys = BackgroundTask(lambda: posed_greys(posed), device)
    small = BackgroundTask(lambda: fit_of_small(greys.result()), device)

    def fit() -> PoseFit:
        _ = greys.result().signs  # while another thread looks for features; ``refine_views`` reads them later
        return measure_fit(greys.result(), small.result)

    return _Check(small, BackgroundTask(fit, device))


def prepare_evidence(native: PosedViews, points: Tensor | None, config: GuidanceConfig) -> Evidence:
    """Cost volume, matches and points of one image and its right views, each of native size."""
    needs_matches = config.needs_matches(points is not None)
    grid = matching.to_grid(native, config.sweep_pixels)
    volume, matches, known_points, rows = None, None, None, None
    noticed: list[Message] = []
    left_out = 0
    if points is not None:
        known_points, left_out = matching.points_to_matches(points, native.K_left, native.size, grid.size)
    if native.views and (config.search == "volume" or needs_matches):
        pictures = rectified_pictures(native) if needs_matches and config.crisp else None
        volume = matching.build_cost_volume(native, depth_range=config.depth_range, config=config)
        if needs_matches:
            matches = matching.match_volume(volume)
            rows = rows_in_background(pictures, matches, known_points)
        if matching.inverse_pose_preferred(native, matches):
            noticed.append(INVERSE)
    if left_out:
        sentence = f"{left_out} points outside the left image are left out: is their frame right?"
        noticed.append(Message("points.outside", sentence))
    evidence = Evidence(
        native,
        grid,
        volume,
        matches,
        known_points,
        reliable=None if matches is None else reliable_matches(matches),
        rows=rows,
        noticed=tuple(noticed),
    )
    _read_back(evidence)
    return evidence


def rows_in_background(
    pictures: RowPictures | None, matches: Matches, points: Matches | None
) -> BackgroundTask[RowMatches] | None:
    """The rows of a rectified pair, matched by the CPU while a GPU goes on: act 3 is the first to ask.

    They are sought up to the nearest of the matches and known points; ``None`` without such a pair.
    """
    if pictures is None:
        return None
    nearest = matches.inverse_depth.amax()
    if points is not None:
        nearest = torch.maximum(nearest, points.inverse_depth.amax())
    received = sent_to_cpu(nearest)
    return BackgroundTask(lambda: match_rows(pictures, pictures.shift_px(float(received()))), pictures.device)


def _read_back(evidence: Evidence) -> None:
    """Fill the caches that wait for the device now, so that no step does."""
    if evidence.volume is not None:
        _ = evidence.volume.reach_m, evidence.volume.rectified
    if (points := evidence.points) is not None:
        read_above((points, 0.0), (points, RELIABLE))  # ``reliable_matches`` reads those of matches
