"""``GeometryGuidance``: right views, cameras, points and hyperparameters, as the user gives them (S3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from torch import Tensor

from geodiff_plugin._camera_checks import check_calibrated_size, check_size_of
from geodiff_plugin._checks import bad_type, bad_value, check_choice, check_number, check_size, noted, refuse
from geodiff_plugin._threads import WithinCores
from geodiff_plugin.algorithm.gradients import RULES
from geodiff_plugin.algorithm.terms import TERMS
from geodiff_plugin.config import PRESETS, GuidanceConfig, UpdatePlan
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.inputs import Arguments, Inputs, read_inputs, split_views
from geodiff_plugin.evidence.photographs import EstimatedRig, KnownLengths, estimate_rig
from geodiff_plugin.evidence.prepare import make_evidence
from geodiff_plugin.evidence.store import EvidenceStore
from geodiff_plugin.formats import picture_size, read_calibration
from geodiff_plugin.formats.images import in_stored_pixels
from geodiff_plugin.formats.reading import is_as_stored
from geodiff_plugin.geometry import image_size
from geodiff_plugin.messages import Message
from geodiff_plugin.types import Rig

#: The assumption about a rectified pair if only one K is given.
SAME_CENTRE = Message(
    "camera.same-centre",
    "The right camera's cx is assumed to be the left one's. If it is not, every depth is off: each pixel of "
    "difference (doffs) shifts all disparities by one, which the pictures show only where it puts things "
    "behind infinity. Give the right camera's cx, which is cx + doffs (K_right, or --cx-right).",
)
#: Cosine of the angle below which two cameras count as parallel.
PARALLEL = 0.9999


class GeometryGuidance:
    """A second view with a known pose, which makes the depth of a diffusion pipeline metric.

    >>> guidance = GeometryGuidance(right, K, E)
    >>> depth_m = pipe(left, guidance=guidance).prediction

    Further views or known points can be added, or take the place of the second view. A batch of left images
    takes a list, with one entry per image, for every argument that differs between them.

    Args:
        right: the right image (PIL, numpy HWC uint8/uint16/float in [0, 1], torch CHW), of any size; a tuple
            of images for several further views; ``None`` with ``points`` alone.
        K: ``(3, 3)`` in each image's pixels: one matrix for all views, or a tuple ``(K_left, K_right, ...)``.
        E: ``(4, 4)`` pose of the right camera in the left camera's frame, metres; or a tuple ``(E_left,
            E_right, ...)`` of camera-to-world poses; ``None`` without a right view.
        points: known depths, metres: a sparse map ``(H, W)`` of the left image's size (0, NaN and infinity
            mean unknown), or ``(N, 3)`` points in the left camera's frame; floats.
        points_confidence: of the points in [0, 1], ``(H, W)`` or ``(N,)``; ``None`` takes all as measured. A
            point of less weight decides less, and gives way to a match of the views that is more confident.
        left_size: ``(width, height)`` that the left image must have; ``None`` for any that fits ``K``.
        cropped: the images are crops, so the principal point may lie outside of the image.
        unit: ``"m"``, or ``None`` where the lengths of ``E`` are in no known unit, as in a model of COLMAP.
            The output then says so, and a metric prior gives the metres.
        measured_baseline: whether the distance between the cameras is measured or calibrated, and not a
            tracker's. Where the poses have to be refined, a measured distance stays as it is; otherwise it is
            weighed against the depth of the scene under the given poses. A rectified rig's is measured.
        preset: hyperparameters by name: ``"default"``, ``"fast"``, ``"paper"``, ``"marigold-dc"``,
            ``"search-only"`` or ``"prior-fit"``.
        config: hyperparameters in place of a preset.
        **knobs: hyperparameters to change in either, such as ``inner_steps=10``; docs/reference/knobs.md and
            ``geodiff info --knobs`` list them.

    Attributes:
        inputs: the checked input, one entry per left image.
        config: the hyperparameters as given; one that is ``None`` is chosen automatically (``as_run``).
        evidence_store: cache of cost volumes and matches for further calls with the same images, cameras and
            settings; ``None``, the default, for no cache.
        estimated: cameras estimated by ``from_photographs``; ``None`` where poses were given.
        as_stored: whether the cameras are those of the pixels as files store them, as COLMAP's are; then an
            EXIF orientation of an image from memory is no reason to turn it.
        warned: every warning of the construction; one that ``forbids_trust`` makes the result untrusted.
        assumed: messages on inputs that were assumed because they were not given.

    Raises:
        InputError: an argument of the wrong type, rank, size or range, or a pose that is not rigid. It is a
            ``ValueError``, and also a ``TypeError`` for a wrong type.

    Convention:
        A rig whose right camera sits 0.12 m to the right has ``E[0, 3] == +0.12``.

    Source: Algorithm 1, S4.2, S5.1; docs/reference/knobs.md explains the defaults.
    """

    estimated: EstimatedRig | None = None
    as_stored: bool = False

    def __init__(
        self,
        right: Any,
        K: Any,
        E: Any = None,
        *,
        points: Any = None,
        points_confidence: Any = None,
        left_size: tuple[int, int] | None = None,
        cropped: bool = False,
        unit: str | None = "m",
        measured_baseline: bool = False,
        preset: str | None = None,
        config: GuidanceConfig | None = None,
        **knobs: Any,
    ) -> None:
        if config is None:
            config = PRESETS[check_choice(preset or "default", "preset", PRESETS)]
        elif preset is not None:
            bad_value("preset", "None beside config", repr(preset))
        if not isinstance(config, GuidanceConfig):
            bad_type("config", "a GuidanceConfig", config, "GuidanceConfig.load reads a saved one.")
        if unit not in ("m", None):
            cure = "Give lengths in metres, or None for any other unit."
            bad_value("unit", "'m' or None", repr(unit), cure)
        self.config, self.unit = config.changed(**knobs), unit
        check_choice(self.config.rule, "rule", RULES)
        for name in self.config.weights:
            check_choice(name, "a key of weights", TERMS)
        with noted() as self.warned:
            given = Arguments(right, K, E, points, points_confidence)
            self.inputs = read_inputs(given, cropped=cropped, unit=unit)
        self.assumed: list[Message] = []
        if not isinstance(K, (tuple, list)):
            self.assumed = assumed_centre(self.rigs)
        self.measured_baseline = measured_baseline
        self.evidence_store: EvidenceStore | None = None
        self._cropped, self._left_size = cropped, check_size(left_size, "left_size")
        has_points = self.inputs[0].points is not None
        _check_sufficient(self.config, self.updates, views=bool(self.rights), points=has_points)

    @classmethod
    def from_baseline(
        cls, right: Any, K: Any, baseline_m: float, K_right: Any = None, **arguments: Any
    ) -> Self:
        """A rectified rig: the right camera is ``baseline_m`` metres to the right, left if negative.

        ``K (3, 3)`` is the left image's, and the right one's without ``K_right``; ``right`` and further
        arguments are as in the constructor.
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
        """Read K and E from a calibration file, or from one file per view; the format is recognised.

        Args:
            right: as in the constructor.
            path: file, or tuple of two files; docs/reference/calibration.md lists the formats.
            cameras: (left, right) numbers, for a file with more than two cameras, such as KITTI's.
            image_names: names of both images in a COLMAP model or a transforms.json.
            baseline_m: measured distance between the cameras in metres; replaces that of the file.
            **arguments: further arguments of the constructor.

        Raises:
            InputError: also for images of another size than the calibration's; the call checks the left one.
        """
        size = arguments.get("left_size")
        with noted() as warned:
            if size is None and right is not None and not isinstance(right, (list, tuple)):
                size = picture_size(right, "right")  # the two cameras of a rig have one resolution
            rig = read_calibration(
                path, cameras, image_names=image_names, image_size=size, baseline_m=baseline_m
            )
            defaults = {"left_size": rig.size_left, "unit": rig.unit, "measured_baseline": rig.measured}
            as_stored = is_as_stored(path)
            right = in_stored_pixels(right) if as_stored else right
            guidance = cls(right, (rig.K_left, rig.K_right), rig.E, **defaults | arguments)
        guidance.warned, guidance.as_stored = warned, as_stored
        for image in guidance.rights:
            size = (image.shape[-1], image.shape[-2])
            cure = "Scale K with the images, or use these."
            check_calibrated_size(size, rig.size_right, "right", rig.source, cure)
        return guidance

    @classmethod
    def from_views(cls, views: Sequence[tuple[Any, Any, Any]], **arguments: Any) -> Self:
        """Two or more posed views of one scene, the left (reference) view first.

        Args:
            views: ``(image, K, E)`` each, with ``E`` a camera-to-world pose in metres, all in one frame. Of
                the first image, which the pipeline is called with, only the size is used; it may be ``None``.
            **arguments: further arguments of the constructor.

        Convention:
            If the first pose is the identity, the others are poses in the left camera's frame.
        """
        with noted() as warned:
            split = split_views(views, cropped=arguments.get("cropped", False))
            guidance = cls(split.rights, split.Ks, split.Es, **{"left_size": split.left_size} | arguments)
        guidance.warned = warned
        return guidance

    @classmethod
    def from_points(cls, points: Any, K: Any, **arguments: Any) -> Self:
        """Known depths instead of a second view. To use both, give ``points=`` to any other constructor.

        ``K (3, 3)`` are the left image's; points and further arguments are as in the constructor.
        """
        return cls(None, K, None, points=points, **arguments)

    @classmethod
    def from_photographs(
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
        **arguments: Any,
    ) -> Self:
        """Two or more photographs without poses, which are estimated from matches (extra ``pose``).

        Args:
            left: the photograph to estimate the depth of; or a list of photographs that starts with it.
            right: the second photograph; ``None`` with a list.
            baseline_m: distance between the left camera and the first right one, metres.
            K: ``(3, 3)`` intrinsics of all photographs in pixels, or a list with one each. ``None`` takes
                ``fov``, or else the EXIF data of PIL images.
            K_right: ``(3, 3)`` of the right photograph, if it differs.
            fov: horizontal field of view of all photographs, degrees.
            known_length: ``(x1, y1, x2, y2, metres)``: two pixels of the left photograph, and the distance
                between the two points in the scene; instead of ``baseline_m``.
            points: ``(N, 3)`` as in the constructor; they give the scale if nothing else does.
            cropped: as in the constructor.
            **arguments: further arguments of the constructor.

        Returns:
            A guidance with the cameras in ``estimated``. Its ``unit`` is ``None`` if no length is known; then
            depth is in units of the first baseline.

        Raises:
            InputError: PoseLib is not installed; K is unknown; no pose can be estimated, because of too few
                matches or a camera that only rotated.
        """
        photographs = list(left) if right is None and isinstance(left, (list, tuple)) else [left, right]
        Ks = K if K_right is None else [K, K_right]
        known = KnownLengths(baseline_m, known_length, points)
        with noted() as warned:
            rig = estimate_rig(photographs, known, K=Ks, fov=fov, cropped=cropped)
            views = zip((None, *photographs[1:]), rig.Ks, (np.eye(4), *rig.Es), strict=True)
            guidance = cls.from_views(
                list(views),
                points=points if rig.scale.unit else None,
                left_size=rig.size_left,
                cropped=cropped,
                unit=rig.scale.unit,
                measured_baseline=True,
                **arguments,
            )
        guidance.warned, guidance.estimated = warned, rig
        if K_right is None:
            guidance.assumed = assumed_centre(guidance.rigs)
        return guidance

    @classmethod
    def marigold_dc(cls, points: Any, K: Any, **arguments: Any) -> Self:
        """Marigold-DC as published, depth completion from points; with ``prediction_type="depth"``."""
        return cls.from_points(points, K, preset="marigold-dc", **arguments)

    @classmethod
    def paper(cls, right: Any, K: Any, E: Any, **arguments: Any) -> Self:
        """Algorithm 1 as printed; docs/reference/paper-map.md settles what the paper leaves open."""
        return cls(right, K, E, preset="paper", **arguments)

    @classmethod
    def search_only(cls, right: Any, K: Any, E: Any, **arguments: Any) -> Self:
        """Only the scale and shift that the search finds: no correction, no gradient updates."""
        return cls(right, K, E, preset="search-only", **arguments)

    @property
    def updates(self) -> UpdatePlan:
        """Number, start and size of the gradient updates, with automatic choices resolved."""
        return self.config.plan_updates(points_given=self.inputs[0].points is not None)

    @property
    def moves_latents(self) -> bool:
        """Whether gradient updates move the latent."""
        return self.config.optimize_latents and self.updates.inner_steps > 0

    @property
    def through_network(self) -> bool:
        """Whether gradients of z_t are taken through the network."""
        return self.config.gradient == "full" and self.moves_latents

    def as_run(self) -> GuidanceConfig:
        """The configuration with all automatic choices resolved, for reports."""
        plan = self.updates
        return self.config.changed(inner_steps=plan.inner_steps, step_latents=plan.step_latents)

    @property
    def rigs(self) -> list[Rig]:
        """The calibration of every further view, those of the first left image first."""
        return [rig for given in self.inputs for rig in given.rigs]

    @property
    def rights(self) -> list[Tensor]:
        """The further images, ``(3, H, W)`` float32 in [0, 1] each, native size, in the order of ``rigs``."""
        return [view.image_01 for given in self.inputs for view in given.views]

    def denoising_steps(self, requested: int | None, pipeline_default: int | None) -> int:
        """Steps of a guided call: as requested, else the pipeline's default, at least ``min_steps``."""
        return requested if requested is not None else max(pipeline_default or 1, self.config.min_steps)

    def check_left_images(self, lefts_01: Tensor) -> None:
        """Refuse left images ``(N, 3, H, W)`` that the right views, K or points do not belong to."""
        count, size = lefts_01.shape[0], image_size(lefts_01)
        if len(self.inputs) != count:
            images = "images (a tuple for several right views)"
            name, kind = ("right", images) if self.rights else ("points", "entries")
            bad_value(name, f"a list of {count} {kind}, one per left image", f"{len(self.inputs)}")
        if self._left_size not in (None, size[::-1]):
            width, height = self._left_size
            bad_value("image", f"of {width}x{height} pixels, as the left view", f"{size[1]}x{size[0]}")
        if not self._cropped:
            for i, given in enumerate(self.inputs):
                _check_K_fits(given, size, "K" if count == 1 else f"K[{i}]")

    def prepare(self, lefts_01: Tensor) -> list[Evidence]:
        """The ``Evidence`` of every left image ``(N, 3, H, W)`` in [0, 1], native, on the device to use."""
        self.check_left_images(lefts_01)
        return self.evidence_of(lefts_01)

    def evidence_of(self, lefts_01: Tensor) -> list[Evidence]:
        """As ``prepare``, of images that ``check_left_images`` has seen already."""
        make = make_evidence if self.evidence_store is None else self.evidence_store.get
        with WithinCores():  # may be called outside of a guided call
            return [
                make(left_01, given, self.config, self.measured_baseline)
                for left_01, given in zip(lefts_01, self.inputs, strict=True)
            ]


def _check_K_fits(given: Inputs, size: tuple[int, int], name: str) -> None:
    """Refuse a K that does not belong to a left image of ``size`` ``(H, W)``."""
    like_left = [image_size(view.image_01) == size for view in given.views]
    if given.shared_intrinsics and not all(like_left):
        bad_value("K", "a tuple (K_left, K_right), as the images differ in size", "one matrix")
    pairs = zip(like_left, given.rigs, strict=True)
    if not any(same_size and np.array_equal(rig.K_left, rig.K_right) for same_size, rig in pairs):
        check_size_of(given.K_left, size, name, "the left image")  # else the constructor has checked it


def assumed_centre(rigs: Sequence[Rig]) -> list[Message]:
    """What is assumed without a K of the right camera; said of parallel cameras, where it matters most."""
    # The trace of a rotation is 1 + 2 cos(angle).
    parallel = any(np.trace(rig.E[:3, :3]) > 1.0 + 2.0 * PARALLEL for rig in rigs)
    return [SAME_CENTRE] if parallel else []


def _check_sufficient(config: GuidanceConfig, updates: UpdatePlan, *, views: bool, points: bool) -> None:
    """Refuse a configuration whose search or whose weighted terms all need an input that was not given."""
    if config.search == "one-number" and not (views and config.weights.get("photometric")):
        refuse("search='one-number' needs a right view and a photometric weight; search='volume' does not.")
    if config.search == "points-range" and not points:
        refuse("search='points-range' needs points. search='volume' works without them.")
    given = {"": True, "views": views, "matches": views, "points": points}
    needs = [TERMS[name].needs for name, weight in config.weights.items() if weight]
    makes_updates = updates.inner_steps or config.inner_steps is None
    if makes_updates and not any(given[need] for need in needs):
        cure = "photometric and matches need a right view, points needs points; inner_steps=0 needs none."
        bad_value("weights", "above 0 for a term that can work on what is given", dict(config.weights), cure)
