"""Checks given poses against the images and refines them if they do not fit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from geodiff_plugin.cameras import PosedViews, View
from geodiff_plugin.pose.fit import PosedGreys, PoseFit, poses_of
from geodiff_plugin.pose.refine import (
    CheckedViews,
    Displacement,
    nearby_of,
    refine_by_flow,
    refine_views,
    report_as_given,
    with_poses,
)
from geodiff_plugin.trust import (
    FactSheet,
    ImagesStage,
    PoseErrors,
    PosesStage,
    TracksStage,
    measure,
    rules_out_everything,
)
from geodiff_plugin.types import PoseReport


class CheckedPoses(NamedTuple):
    """The right views with the poses and images in use, the fit of the poses, and the facts of the checks."""

    views: tuple[View, ...]
    report: PoseReport
    facts: FactSheet
    warps: tuple[Displacement | None, ...] = ()  # of the images; empty if they are unchanged

    def of_frame(self, rights: Sequence[View]) -> CheckedPoses:
        """Return the same poses and warps for the right views of another frame of the rig."""
        return self._replace(views=with_poses(rights, poses_of(self.views), self.warps))


def used_as_given(posed: PosedViews) -> CheckedPoses:
    """Return poses that are used without a check."""
    return CheckedPoses(posed.rights, report_as_given(posed.rights), FactSheet())


def image_facts(greys: PosedGreys) -> FactSheet:
    """Measure the facts that the images show without matches."""
    images, valid = [view.grey for view in greys.views], [view.valid for view in greys.views]
    return measure(ImagesStage(images, greys.heights, valid))


def check_poses(posed: PosedViews, fit: PoseFit, images: FactSheet, measured: bool = False) -> CheckedPoses:
    """Check the poses of a known fit and refine them if they do not fit (``refine_views``).

    If features of downscaled images show that the pose of a rig fits but do not rule out other errors,
    full-size features are matched. If few features match, optical flow is used as well.

    Args:
        posed: the views, cleaned.
        fit: fit of their poses, from ``measure_fit``.
        images: facts from ``image_facts``.
        measured: whether a refined pose keeps the baseline.
    """
    if not (fit.is_known or fit.surely):
        return _with_checks(posed, refine_by_flow(posed, fit, measured), images)
    given = fit.greys.given
    near = nearby_of(fit)
    sizes = [view.grey.shape for view in fit.greys.views]
    facts = measure(TracksStage(fit.tracks, given, near, sizes, posed.size))
    if fit.is_small and not rules_out_everything(facts):
        return check_poses(posed, fit.at_full_resolution(), images, measured)
    errors = facts[PoseErrors]
    has_errors = errors is not None and bool(errors.found)
    return _with_checks(posed, refine_views(posed, fit, near, measured, has_errors), images | facts)


def _with_checks(posed: PosedViews, checked: CheckedViews, facts: FactSheet) -> CheckedPoses:
    stage = PosesStage(checked.report, checked.tracks, poses_of(checked.views), posed.size)
    return CheckedPoses(checked.views, checked.report, facts | measure(stage), checked.warps)
