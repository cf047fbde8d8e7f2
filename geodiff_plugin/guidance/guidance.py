"""What a user configures: right views, cameras, known points and the hyperparameters of the guidance.

Data flow: ``right, K, E, points``, configuration -> ``GeometryGuidance`` -> at call time ``Evidence``.
Paper: S3.3, S4.2, S5.1; ``GeometryGuidance.paper`` is Algorithm 1 with its printed numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import numpy as np
from torch import Tensor

from geodiff_plugin._camera_checks import check_calibrated_size, check_intrinsics_fit, warn_of_other_size
from geodiff_plugin._checks import bad_type, bad_value, check_number, check_size
from geodiff_plugin.algorithm.evidence import Evidence, EvidenceInputs
from geodiff_plugin.formats import as_image_01, read_calibration
from geodiff_plugin.geometry.cameras import image_size
from geodiff_plugin.guidance.config import GuidanceConfig, UpdatePlan
from geodiff_plugin.guidance.evidence_store import EvidenceStore, make_evidence
from geodiff_plugin.guidance.inputs import ImageInputs, read_inputs, split_views
from geodiff_plugin.guidance.photographs import EstimatedRig, estimate_rig
from geodiff_plugin.guidance.preconditions import check_fed, check_names
from geodiff_plugin.guidance.presets import DEFAULT, MARIGOLD_DC, PAPER, SEARCH_ONLY
from geodiff_plugin.types import MetricDepthOutput, Rig

__all__ = ["GeometryGuidance"]


class GeometryGuidance:
    """A second view with a known pose (or more of them, or points), and how strongly it steers the diffusion.

    Args:
        right: the right image (PIL, numpy HWC uint8/uint16/float in [0, 1], torch CHW), of any size; a tuple
            of several further views; ``None`` with ``points`` alone. A list has one of these per image of the
            batch.
        K: ``(3, 3)`` intrinsics in pixels, each for its own image at its own size; one matrix for all
            views, a tuple ``(K_left, K_right, ...)``, or a list with one of these per image.
        E: ``(4, 4)`` pose of the right camera in the left camera's frame, metres; or a tuple
            ``(E_left, E_right, ...)`` of camera-to-world poses; ``None`` without a right view; or a list with
            one of these per image.
        points: depths that are known, metres: a sparse map ``(H, W)`` of the left image's size (0, NaN and
            infinity are unknown), or ``(N, 3)`` points in the left camera's frame; or a list of these.
        left_size: ``(width, height)`` that the left image must have; ``None`` takes any that ``K`` fits.
        cropped: the images are crops, so a principal point outside of its image is no mistake.
        previous: the output of the frame before, of a call with ``output_latent=True``: the call then begins
            in the middle of the schedule, from its latent, and the search for the scale at its scale.
        config: the hyperparameters; the default preset, or another of ``guidance.presets``.
        **knobs: leaves of ``config`` that shall differ, such as ``inner_steps=10``;
            docs/reference/knobs.md and ``geodiff info --knobs`` list them.

    Attributes:
        evidence_store: where evidence is kept for further calls on the same images, cameras and settings;
            ``None``, the default, makes it anew at every call.
        previous: as the argument; it may be set before every call.

    Raises:
        InputError: anything of the wrong type, rank, size, range or rigidity, naming the argument; it is a
            ``ValueError``, and a ``TypeError`` as well where the type is wrong.

    Convention:
        A rig whose right camera sits 0.12 m to the right has ``E[0, 3] == +0.12``.

    Source: Algorithm 1, S4.2, S5.1; docs/reference/knobs.md explains defaults of our own.
    """

    #: What ``from_photographs`` found; ``None`` where poses were given.
    estimated: EstimatedRig | None = None

    def __init__(
        self,
        right: Any,
        K: Any,
        E: Any = None,
        *,
        points: Any = None,
        left_size: tuple[int, int] | None = None,
        cropped: bool = False,
        previous: MetricDepthOutput | None = None,
        config: GuidanceConfig = DEFAULT,
        **knobs: Any,
    ) -> None:
        if not isinstance(config, GuidanceConfig):
            bad_type("config", "a GuidanceConfig", config, "GuidanceConfig.load reads a saved one.")
        self._config = config.changed(**knobs)
        check_names(self._config)
        self._inputs = read_inputs(right, K, E, points, cropped=cropped)
        self.evidence_store: EvidenceStore | None = None
        self.previous = previous
        self._cropped, self._left_size = cropped, check_size(left_size, "left_size")
        check_fed(
            self._config, self.updates, views=bool(self.rights), points=self._inputs[0].points is not None
        )

    @classmethod
    def from_baseline(cls, right: Any, K: Any, baseline_m: float, K_right: Any = None, **knobs: Any) -> Self:
        """A rectified rig: the right camera sits ``baseline_m`` metres to the right, looking the same way.

        Args:
            right: as in the constructor.
            K: ``(3, 3)`` intrinsics of the left image, pixels.
            baseline_m: metres; negative if the "right" camera sits to the left.
            K_right: ``(3, 3)`` of the right image; ``None`` if it is the same.
            **knobs: what else the constructor takes.
        """
        check_number(baseline_m, "baseline_m", -1e6, 1e6)
        E = np.eye(4)
        E[0, 3] = baseline_m
        return cls(right, K if K_right is None else (K, K_right), E, **knobs)

    @classmethod
    def from_calibration(
        cls,
        right: Any,
        path: str | Path | tuple[str | Path, str | Path],
        cameras: tuple[int, int] | None = None,
        *,
        image_names: tuple[str, str] | None = None,
        baseline_m: float | None = None,
        **knobs: Any,
    ) -> Self:
        """Read K and E from a calibration file (or a pair of files, one a view), format told by its content.

        Args:
            right: as in the constructor.
            path: file, or tuple of two files; formats are listed in docs/reference/calibration.md.
            cameras: (left, right) numbers in a file that has more than two, such as KITTI's.
            image_names: names of both images, by which a COLMAP model knows them.
            baseline_m: measured distance of the cameras in metres; replaces that of the file.
            **knobs: what else the constructor takes.

        Raises:
            InputError: also, here or when the pipeline is called, images of another size than the file says.
        """
        size = knobs.get("left_size")
        if size is None and right is not None and not isinstance(right, (list, tuple)):
            size = as_image_01(right, "right").shape[:0:-1]  # the two cameras of a rig have one resolution
        rig = read_calibration(path, cameras, image_names=image_names, image_size=size, baseline_m=baseline_m)
        guidance = cls(right, (rig.K_left, rig.K_right), rig.E, **{"left_size": rig.size_left} | knobs)
        for image in guidance.rights:
            size = (image.shape[-1], image.shape[-2])
            cure = "Scale K with the images, or use these."
            check_calibrated_size(size, rig.size_right, "right", rig.source, cure)
        return guidance

    @classmethod
    def from_views(cls, views: Sequence[tuple[Any, Any, Any]], **knobs: Any) -> Self:
        """Two or more posed views of one scene, the left (reference) view first.

        Args:
            views: ``(image, K, E)`` each, with ``E`` a camera-to-world pose in any one frame, metres. The
                first image is the one that the pipeline is called with: here only its size is read, and it
                may be ``None``.
            **knobs: what else the constructor takes.

        Convention:
            With an identity for the first pose the others are poses in the left camera's frame.
        """
        left_size, images, Ks, Es = split_views(views)
        return cls(images, Ks, Es, **{"left_size": left_size} | knobs)

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
        matcher: str = "sift",
        **knobs: Any,
    ) -> Self:
        """Two photographs or more without poses: cameras are estimated from their matches (extra ``pose``).

        Args:
            left: the photograph that gets the depth, or a list of three or more with it first.
            right: the second one; ``None`` with a list.
            baseline_m: distance of the first right camera from the left one, metres.
            K: ``(3, 3)`` intrinsics of the left photograph, pixels, and of the others unless ``K_right`` or a
                list says theirs; ``None`` for ``fov``, else for the EXIF of PIL images.
            K_right: ``(3, 3)`` of the right photograph, if it differs.
            fov: horizontal field of view of all photographs, degrees.
            known_length: ``(x1, y1, x2, y2, metres)``: two pixels of the left photograph, and how far apart
                the two places are; instead of ``baseline_m``.
            points: ``(N, 3)`` as in the constructor; they give the scale where nothing else does.
            matcher: what finds distinct points in both: ``"sift"``, or ``"lightglue"``, ``"superglue"`` or a
                folder with such weights, where this machine has them.
            **knobs: what else the constructor takes.

        Returns:
            A guidance whose ``estimated`` says what was found, and whose ``unit`` is ``None`` where no length
            is known: depth is then in baselines of the first two cameras.

        Raises:
            InputError: PoseLib is not installed; no K; no pose to be had: too few matches, a camera that
                only turned.
        """
        photographs = list(left) if right is None and isinstance(left, (list, tuple)) else [left, right]
        Ks = K if K_right is None else [K, K_right]
        found = estimate_rig(
            photographs,
            K=Ks,
            fov=fov,
            baseline_m=baseline_m,
            known_length=known_length,
            points=points,
            matcher=matcher,
        )
        views = zip((None, *photographs[1:]), found.Ks, (np.eye(4), *found.Es), strict=True)
        points = points if found.scale.unit else None
        guidance = cls.from_views(list(views), points=points, left_size=found.size_left, **knobs)
        guidance.estimated = found
        return guidance

    @property
    def previous(self) -> MetricDepthOutput | None:
        """The output of the frame before, that the next call goes on from; ``None`` for none."""
        return self._previous

    @previous.setter
    def previous(self, output: MetricDepthOutput | None) -> None:
        if output is not None and not isinstance(output, MetricDepthOutput):
            bad_type("previous", "a MetricDepthOutput, of a guided call of the frame before", output)
        if output is not None and (output.latent is None or output.scale is None):
            bad_value("previous", "an output with its latent", "one without", "Call with output_latent=True.")
        self._previous = output

    @property
    def unit(self) -> str | None:
        """``"m"``, or ``None`` where poses were estimated and no length is known."""
        return "m" if self.estimated is None else self.estimated.scale.unit

    @classmethod
    def from_points(cls, points: Any, K: Any, **knobs: Any) -> Self:
        """Known depths instead of a second view; with one, give ``points=`` to any other constructor.

        Args:
            points: as in the constructor.
            K: ``(3, 3)`` intrinsics of the left image, pixels.
            **knobs: what else the constructor takes.
        """
        return cls(None, K, None, points=points, **knobs)

    @classmethod
    def marigold_dc(cls, points: Any, K: Any, **knobs: Any) -> Self:
        """Marigold-DC with its published settings: depth completion from points alone.

        Adam of 0.05 on z_t and 0.005 on scale and shift, gradient through the U-Net scaled to the norm of the
        predicted noise, L1 + L2 in metres, 50 steps. Use a Marigold with ``prediction_type="depth"``.

        Args:
            points: as in the constructor; a sparse map is used pixel by pixel, as there.
            K: ``(3, 3)`` intrinsics of the left image, pixels.
            **knobs: leaves that shall differ.

        Source: Viola et al. 2024, Algorithm 1; prs-eth/Marigold-DC, in parity (tests/parity).
        """
        return cls.from_points(points, K, config=MARIGOLD_DC, **knobs)

    @classmethod
    def paper(cls, right: Any, K: Any, E: Any, **knobs: Any) -> Self:
        """Algorithm 1 as printed: full gradient, plain steps of 1e-2, gamma 1e-2 towards 0, one-number g_s.

        Args:
            right: as in the constructor.
            K: as in the constructor.
            E: as in the constructor.
            **knobs: leaves that shall differ from the paper; ``g_s_range`` is its "predefined depth range".

        Source: Algorithm 1, S5.1, S7.3, S9; docs/reference/paper-map.md settles what the paper leaves open.
        """
        return cls(right, K, E, config=PAPER, **knobs)

    @classmethod
    def search_only(cls, right: Any, K: Any, E: Any, **knobs: Any) -> Self:
        """The default without gradient updates: only the scale and shift that the search finds.

        Args:
            right: as in the constructor.
            K: as in the constructor.
            E: as in the constructor.
            **knobs: leaves that shall differ.
        """
        return cls(right, K, E, config=SEARCH_ONLY, **knobs)

    @property
    def config(self) -> GuidanceConfig:
        """The hyperparameters, as given: what they leave open stays ``None``."""
        return self._config

    @property
    def updates(self) -> UpdatePlan:
        """What the configuration leaves open about the updates, settled for what is given."""
        return self.config.plan_updates(points_given=self._inputs[0].points is not None)

    def as_run(self) -> GuidanceConfig:
        """The configuration with nothing left open, for reports."""
        return self.config.changed(**asdict(self.updates))

    @property
    def inputs(self) -> list[ImageInputs]:
        """What was given, checked, one entry per left image."""
        return list(self._inputs)

    @property
    def rigs(self) -> list[Rig]:
        """The calibrations as understood, one per further view, those of the first left image first."""
        return [rig for own in self._inputs for rig in own.rigs]

    @property
    def rights(self) -> list[Tensor]:
        """The further images, ``(3, H, W)`` float32 in [0, 1] each, native size, in the order of ``rigs``."""
        return [image for own in self._inputs for image in own.rights]

    def denoising_steps(self, asked: int | None, pipeline_default: int | None) -> int:
        """Steps of a guided call: as asked, else the pipeline's default, at least ``min_steps``."""
        return asked if asked is not None else max(pipeline_default or 1, self.config.min_steps)

    def prepare(self, lefts_01: Tensor) -> list[Evidence]:
        """Let the views speak: one cost volume (and its matches, if a term asks) per image.

        Args:
            lefts_01: ``(N, 3, H, W)`` float32 in [0, 1], native size; its device is where the work is done.

        Returns:
            ``N`` entries.

        Raises:
            InputError: not one right view per left image; a left K that is not for images of this size.
        """
        count, size = lefts_01.shape[0], image_size(lefts_01)
        if len(self._inputs) != count:
            name, kind = ("right", "images") if self.rights else ("points", "entries")
            bad_value(name, f"a list of {count} {kind}, one per left image", f"{len(self._inputs)}")
        if self._left_size not in (None, size[::-1]):
            width, height = self._left_size
            bad_value("image", f"of {width}x{height} pixels, as the left view", f"{size[1]}x{size[0]}")
        evidence = []
        make = make_evidence if self.evidence_store is None else self.evidence_store.get
        for i, own in enumerate(self._inputs):
            name = "K" if count == 1 else f"K[{i}]"
            if not self._cropped:
                fit = (own.K_left, size[1], size[0], name, "the left image")
                check_intrinsics_fit(*fit)
                warn_of_other_size(*fit)
            views, K_left, points = own.on(lefts_01.device)
            evidence.append(
                make(EvidenceInputs(lefts_01[i], views, K_left, points, self.config, self._asks_for_matches))
            )
        return evidence

    @property
    def _asks_for_matches(self) -> bool:
        stage = self.config.correction
        used = self.updates.inner_steps > 0 or stage.correct or stage.refine
        return used and bool(self.config.weights.get("matches"))
