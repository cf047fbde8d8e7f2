"""What a user configures: right views, cameras, known points and the hyperparameters of the guidance.

Hop: ``right, K, E, points``, keywords -> ``GeometryGuidance`` -> (at call time) one ``Evidence`` per image.
Paper: S4.2, S5.1; ``GeometryGuidance.paper`` is Algorithm 1 with its printed numbers.
"""

from __future__ import annotations

from typing import Any

from diffusers.configuration_utils import ConfigMixin
from torch import Tensor

from geodiff_plugin._checks import bad_value, check_intrinsics_fit, warn_of_other_size
from geodiff_plugin.evidence import Evidence, prepare_evidence
from geodiff_plugin.guidance_doors import GuidanceDoors
from geodiff_plugin.guidance_inputs import ImageInputs, read_inputs
from geodiff_plugin.knobs import CHECKS, check_knobs
from geodiff_plugin.terms import TERMS
from geodiff_plugin.types import Rig

__all__ = ["GeometryGuidance"]


class GeometryGuidance(GuidanceDoors, ConfigMixin):
    """A second view with a known pose (or more of them, or points), and how strongly it steers the diffusion.

    Args:
        right: the right image (PIL, numpy HWC uint8/uint16/float in [0, 1], torch CHW), of any size; a tuple
            of several right views; ``None`` with ``points`` alone. A list has one of these per image of the
            batch.
        K: ``(3, 3)`` intrinsics in pixels, each for its own image at its own size; one matrix for all
            views, a tuple ``(K_left, K_right, ...)``, or a list with one of these per image.
        E: ``(4, 4)`` pose of the right camera in the left camera's frame, metres; or a tuple
            ``(E_left, E_right, ...)`` of camera-to-world poses; ``None`` without a right view; or a list with
            one of these per image.
        points: depths that are known, metres: a sparse map ``(H, W)`` of the left image's size (0, NaN and
            infinity are unknown), or ``(N, 3)`` points in the left camera's frame; or a list of these.
        left_size: ``(width, height)`` that the left image must have; ``None`` takes any that ``K`` fits.
        gradient: ``"denoised"`` moves the clean latent and stops there; ``"full"`` goes through the
            U-Net to z_t, as the paper.
        rule: how a gradient moves the latent, key of ``RULES``.
        affine_rule: the same for scale and shift.
        step_latents: step size of ``rule``; ``None`` for 0.03 after a correction, else 0.1.
        step_affine: step size of ``affine_rule`` on the raw scale and shift.
        inner_steps: updates per denoising step; ``None`` for 5 after a correction, else 40; 0 leaves search
            and correction alone.
        updates_from: steps that end by this fraction of the schedule, [0, 1], make no updates; ``None``
            for 0.75 of ``stop`` after a correction (the last of four steps makes some), else 0.
        min_steps: denoising steps that a guided call takes at least when it names no ``num_inference_steps``;
            a pipeline's own default may be 1, which leaves nothing for the guidance to come back to.
        optimize_latents: ``False`` learns scale and shift only (S5.3, Table 4), latents stay untouched.
        start: fraction of the schedule before which nothing is updated, [0, 1).
        stop: fraction after which nothing is updated, (0, 1].
        weights: weight by term; missing terms weigh 0.
        eta: SSIM against L1 in the photometric term, [0, 1].
        pyramid_levels: image pyramid of the photometric term; 1 is the paper's.
        exposure: compare photographs in the left one's exposure and colour (``terms.exposure``).
        z_test: pixels that the estimate itself hides from a right camera take no part in the photometric
            term: there the right image shows something else.
        min_visible: visible share below which the photometric term is off, [0, 1].
        pull_to: what ``prior_pull`` pulls scale and shift towards, ``"start"`` or ``"zero"``.
        search: ``"volume"`` looks up (near, far) in a plane-sweep volume, and fits them to the points where
            there is no right view; ``"one-number"`` is the paper's g_s search; ``"points-range"`` takes the
            nearest and the farthest point, as Marigold-DC.
        g_s_range: metres, the candidates of the one-number search.
        depth_range: ``(near, far)`` metres that bound the sweep and the nearest and farthest depth of the
            search, or ``None``.
        gate: factor around the estimate within which matches are believed, > 1.
        loss_resolution: pixels, bound of the longer side of the grid that losses are computed on.
        correct: at every step, before the updates, bring the decoded map to its matches and encode what that
            changes; the gradient then has the rest to do. Not where the gradient moves z_t (``"full"``).
        doubt: matches behind what the prior first says, over a region and by more than chance, lose
            their say: mirrors and glass (``matching.contradiction``).
        refine: bring the result to its matches and points at full resolution, edge-aware
            (``refinement.refine_depth``); there must be a ``matches`` term or points.
        respace: run a ``leading`` DDIM schedule as ``trailing`` for guided calls.
        points_loss: ``"robust"`` in inverse depth, or ``"l1l2"`` in metres (``terms.points``).
        positive: how raw scale and shift become positive: ``"softplus"``, or ``"square"`` with a relative map
            clipped to [0, 1] (``metric.MetricMap``).
        step_from: with the full gradient, the latent that the scheduler's step starts from: the ``"given"``
            one, the update added after it (Algorithm 1), or the ``"updated"`` one (Marigold-DC).

    Raises:
        TypeError, ValueError: anything of the wrong rank, size, range or rigidity, naming the argument.

    Convention:
        A rig whose right camera sits 0.12 m to the right has ``E[0, 3] == +0.12``.

    Source: Algorithm 1, S4.2, S5.1; defaults that differ from the paper are explained in docs/knobs.md.
    """

    config_name = "guidance_config.json"

    def __init__(
        self,
        right: Any,
        K: Any,
        E: Any = None,
        *,
        points: Any = None,
        left_size: tuple[int, int] | None = None,
        gradient: str = "denoised",
        rule: str = "adam",
        affine_rule: str = "adam",
        step_latents: float | None = None,
        step_affine: float = 0.01,
        inner_steps: int | None = None,
        updates_from: float | None = None,
        min_steps: int = 4,
        optimize_latents: bool = True,
        start: float = 0.0,
        stop: float = 1.0,
        weights: dict[str, float] | None = None,
        eta: float = 0.85,
        pyramid_levels: int = 3,
        exposure: bool = True,
        z_test: bool = True,
        min_visible: float = 0.1,
        pull_to: str = "start",
        search: str = "volume",
        g_s_range: tuple[float, float] = (1.0, 80.0),
        depth_range: tuple[float, float] | None = None,
        gate: float = 10.0,
        loss_resolution: int = 640,
        correct: bool = True,
        doubt: bool = True,
        refine: bool = True,
        respace: bool = True,
        points_loss: str = "robust",
        positive: str = "softplus",
        step_from: str = "given",
    ) -> None:
        given = {name: value for name, value in locals().items() if name in CHECKS}
        # Registered by hand: the diffusers decorator zips positional arguments with the registered
        # names, and would save the right image as the first hyperparameter.
        self.register_to_config(**check_knobs(given, points_given=points is not None))
        self._inputs = read_inputs(right, K, E, points)
        self._left_size = None if left_size is None else tuple(left_size)
        self._check_fed()

    def _check_fed(self) -> None:
        """Refuse a configuration that asks for what was not given."""
        needs = {"one-number": "a right view and a photometric weight", "points-range": "points"}
        views, known = bool(self.rights), self._inputs[0].points is not None
        compared = views and bool(self.config.weights.get("photometric"))
        if not {"one-number": compared, "points-range": known}.get(self.config.search, True):
            search = self.config.search
            bad_value("search", f"one that works on what is given ({search!r} needs {needs[search]})", "none")
        lacking = {"needs_warp": not views, "needs_matches": not views, "needs_points": not known}
        weights = {name: weight for name, weight in self.config.weights.items() if weight}
        idle = [
            n for n in weights if any(absent and getattr(TERMS[n], need) for need, absent in lacking.items())
        ]
        if self.config.inner_steps and len(idle) == len(weights):
            cure = "photometric and matches need a right view, points needs points; inner_steps=0 needs none."
            bad_value("weights", "with a term for what is given", self.config.weights, cure)

    @property
    def inputs(self) -> list[ImageInputs]:
        """What was given, checked, one entry per left image."""
        return list(self._inputs)

    @property
    def rigs(self) -> list[Rig]:
        """The calibrations as understood, one per right image, those of the first left image first."""
        return [rig for own in self._inputs for rig in own.rigs]

    @property
    def rights(self) -> list[Tensor]:
        """The right images, ``(3, H, W)`` float32 in [0, 1] each, native size, in the order of ``rigs``."""
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
            ValueError: not one right view per left image; a left K that is not for images of this size.
        """
        count, size = lefts_01.shape[0], tuple(lefts_01.shape[-2:])
        if len(self._inputs) != count:
            name, kind = ("right", "images") if self.rights else ("points", "entries")
            bad_value(name, f"a list of {count} {kind}, one per left image", f"{len(self._inputs)}")
        if self._left_size not in (None, size[::-1]):
            width, height = self._left_size
            bad_value("image", f"of {width}x{height} pixels, as the left view", f"{size[1]}x{size[0]}")
        config, evidence = self.config, []
        used = config.inner_steps > 0 or config.correct or config.refine
        matched = bool(config.weights.get("matches")) and used
        for i, own in enumerate(self._inputs):
            name = "K" if count == 1 else f"K[{i}]"
            fit = (own.K_left, size[1], size[0], name, "the left image")
            check_intrinsics_fit(*fit)
            warn_of_other_size(*fit)
            evidence.append(
                prepare_evidence(
                    lefts_01[i],
                    *own.on(lefts_01.device),
                    loss_resolution=config.loss_resolution,
                    depth_range=config.depth_range,
                    needs_volume=config.search == "volume",
                    needs_matches=matched,
                )
            )
        return evidence
