"""What a user configures: the right view, its cameras and the hyperparameters of the guidance.

Hop: ``right, K, E`` and keywords -> ``GeometryGuidance`` -> (at call time) one ``Evidence`` per image.
Paper: S4.2, S5.1; ``GeometryGuidance.paper`` is Algorithm 1 with its printed numbers.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers.configuration_utils import ConfigMixin
from torch import Tensor

from geodiff_plugin._checks import (
    bad_type,
    bad_value,
    check_baseline,
    check_choice,
    check_intrinsics,
    check_intrinsics_fit,
    check_number,
    check_pose,
    check_range,
)
from geodiff_plugin.evidence import Evidence, prepare_evidence
from geodiff_plugin.formats import as_image_01, read_calibration
from geodiff_plugin.terms import TERMS
from geodiff_plugin.types import Rig
from geodiff_plugin.updates import RULES

__all__ = ["GeometryGuidance"]

#: Weights of the default preset; how flat the optimum around each is: docs/knobs.md.
DEFAULT_WEIGHTS = {"photometric": 1.0, "matches": 1.0, "prior_pull": 0.01, "anchor": 1.0}
PAPER_WEIGHTS = {"photometric": 1.0, "prior_pull": 0.01}
GRADIENTS = ("denoised", "full")
SEARCHES = ("volume", "one-number")
ANCHORS = ("start", "zero")


class GeometryGuidance(ConfigMixin):
    """A second view with a known pose, and how strongly it steers the diffusion.

    Args:
        right: the right image (PIL, numpy HWC uint8/uint16/float in [0, 1], torch CHW), of any size;
            a list has one entry per image of the batch.
        K: ``(3, 3)`` intrinsics in pixels, each for its own image at its own size; one matrix for both
            views, a tuple ``(K_left, K_right)``, or a list with one of these per image.
        E: ``(4, 4)`` pose of the right camera in the left camera's frame, metres; or a tuple
            ``(E_left, E_right)`` of camera-to-world poses; or a list with one of these per image.
        gradient: ``"denoised"`` moves the clean latent and stops there; ``"full"`` goes through the
            U-Net to z_t, as the paper.
        rule: how a gradient moves the latent, key of ``RULES``.
        affine_rule: the same for scale and shift.
        step_latents: step size of ``rule``.
        step_affine: step size of ``affine_rule`` on the raw scale and shift.
        inner_steps: updates per denoising step; 0 leaves only the search for the scale.
        min_steps: denoising steps that a guided call takes at least when it names no ``num_inference_steps``;
            a pipeline's own default may be 1, which leaves nothing for the guidance to come back to.
        optimize_latents: ``False`` learns scale and shift only (S5.3, Table 4), latents stay untouched.
        start: fraction of the schedule before which nothing is updated, [0, 1).
        stop: fraction after which nothing is updated, (0, 1].
        weights: weight by term; missing terms weigh 0.
        eta: SSIM against L1 in the photometric term, [0, 1].
        pyramid_levels: image pyramid of the photometric term; 1 is the paper's.
        min_visible: visible share below which the photometric term is off, [0, 1].
        pull_to: what ``prior_pull`` pulls scale and shift towards, ``"start"`` or ``"zero"``.
        search: ``"volume"`` looks up (near, far) in a plane-sweep volume; ``"one-number"`` is the paper's
            g_s search.
        g_s_range: metres, the candidates of the one-number search.
        depth_range: ``(near, far)`` metres that bound the search, or ``None``.
        gate: factors around the estimate within which matches are believed, at the first and last step.
        loss_resolution: pixels, bound of the longer side of the grid that losses are computed on.
        refine: bring the result to its matches at full resolution, edge-aware (``refinement.refine_depth``);
            without a ``matches`` term there is nothing to bring it to.
        respace: run a ``leading`` DDIM schedule as ``trailing`` for guided calls.

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
        E: Any,
        *,
        gradient: str = "denoised",
        rule: str = "adam",
        affine_rule: str = "adam",
        step_latents: float = 0.1,
        step_affine: float = 0.01,
        inner_steps: int = 40,
        min_steps: int = 4,
        optimize_latents: bool = True,
        start: float = 0.0,
        stop: float = 1.0,
        weights: dict[str, float] | None = None,
        eta: float = 0.85,
        pyramid_levels: int = 3,
        min_visible: float = 0.1,
        pull_to: str = "start",
        search: str = "volume",
        g_s_range: tuple[float, float] = (1.0, 80.0),
        depth_range: tuple[float, float] | None = None,
        gate: tuple[float, float] = (20.0, 3.0),
        loss_resolution: int = 640,
        refine: bool = True,
        respace: bool = True,
    ) -> None:
        weights = dict(DEFAULT_WEIGHTS if weights is None else weights)
        for name, weight in weights.items():
            check_choice(name, "a key of weights", TERMS)
            check_number(weight, f"weights[{name!r}]", 0.0, float("inf"))
        stop = check_number(stop, "stop", 0.0, 1.0)
        # Registered by hand: the diffusers decorator zips positional arguments with the registered
        # names, and would save the right image as the first hyperparameter.
        self.register_to_config(
            gradient=check_choice(gradient, "gradient", GRADIENTS),
            rule=check_choice(rule, "rule", RULES),
            affine_rule=check_choice(affine_rule, "affine_rule", RULES),
            step_latents=check_number(step_latents, "step_latents", 0.0, 1e6),
            step_affine=check_number(step_affine, "step_affine", 0.0, 1e6),
            inner_steps=check_number(inner_steps, "inner_steps", 0, 10_000, integer=True),
            min_steps=check_number(min_steps, "min_steps", 1, 1000, integer=True),
            optimize_latents=bool(optimize_latents),
            start=check_number(start, "start", 0.0, stop),
            stop=stop,
            weights=weights,
            eta=check_number(eta, "eta", 0.0, 1.0),
            pyramid_levels=check_number(pyramid_levels, "pyramid_levels", 1, 10, integer=True),
            min_visible=check_number(min_visible, "min_visible", 0.0, 1.0),
            pull_to=check_choice(pull_to, "pull_to", ANCHORS),
            search=check_choice(search, "search", SEARCHES),
            g_s_range=check_range(g_s_range, "g_s_range"),
            depth_range=check_range(depth_range, "depth_range"),
            gate=check_range(gate[::-1], "gate, last before first,")[::-1],
            loss_resolution=check_number(loss_resolution, "loss_resolution", 32, 1 << 16, integer=True),
            refine=bool(refine),
            respace=bool(respace),
        )
        rights = list(right) if isinstance(right, list) else [right]
        self._rights = [as_image_01(image, _label("right", i, rights)) for i, image in enumerate(rights)]
        count = len(self._rights)
        if count == 0:
            bad_value("right", "an image or a list with one image per left image", "an empty list")
        self._rigs = [
            _rig(
                _entry(K, "K", i, count),
                _entry(E, "E", i, count),
                _label("K", i, rights),
                _label("E", i, rights),
            )
            for i in range(count)
        ]
        for i, (image, rig) in enumerate(zip(self._rights, self._rigs, strict=True)):
            name = _label("K_right", i, rights)
            check_intrinsics_fit(rig.K_right, image.shape[-1], image.shape[-2], name, "the right image")

    @classmethod
    def from_baseline(
        cls, right: Any, K: Any, baseline_m: float, K_right: Any = None, **kwargs: Any
    ) -> GeometryGuidance:
        """A rectified rig: the right camera sits ``baseline_m`` metres to the right, looking the same way.

        Args:
            right: as in the constructor.
            K: ``(3, 3)`` intrinsics of the left image, pixels.
            baseline_m: metres; negative if the "right" camera sits to the left.
            K_right: ``(3, 3)`` of the right image; ``None`` if it is the same.
            **kwargs: hyperparameters.
        """
        check_number(baseline_m, "baseline_m", -1e6, 1e6)
        E = np.eye(4)
        E[0, 3] = baseline_m
        return cls(right, K if K_right is None else (K, K_right), E, **kwargs)

    @classmethod
    def from_calibration(
        cls,
        right: Any,
        path: str | Path | tuple[str | Path, str | Path],
        cameras: tuple[int, int] | None = None,
        **kwargs: Any,
    ) -> GeometryGuidance:
        """Read K and E from a calibration file (or a pair of files, one a view), format told by its content.

        Args:
            right: as in the constructor.
            path: file, or tuple of two files; formats are listed in docs/calibration.md.
            cameras: (left, right) numbers in a file that has more than two, such as KITTI's.
            **kwargs: hyperparameters.
        """
        rig = read_calibration(path, cameras=cameras)
        return cls(right, (rig.K_left, rig.K_right), rig.E, **kwargs)

    @classmethod
    def paper(
        cls, right: Any, K: Any, E: Any, g_s_range: tuple[float, float] = (1.0, 80.0), **kwargs: Any
    ) -> GeometryGuidance:
        """Algorithm 1 as printed: full gradient, plain steps of 1e-2, gamma 1e-2 towards 0, one-number g_s.

        Args:
            right: as in the constructor.
            K: as in the constructor.
            E: as in the constructor.
            g_s_range: metres, the paper's "predefined depth range".
            **kwargs: hyperparameters that shall differ from the paper.

        Source: Algorithm 1, S5.1, S7.3, S9; what the paper leaves open is settled in docs/paper-map.md.
        """
        preset: dict[str, Any] = {
            "gradient": "full",
            "rule": "plain",
            "affine_rule": "plain",
            "step_latents": 1e-2,
            "step_affine": 1e-2,
            "inner_steps": 1,
            "min_steps": 10,
            "weights": PAPER_WEIGHTS,
            "eta": 0.85,
            "pyramid_levels": 1,
            "min_visible": 0.0,
            "pull_to": "zero",
            "search": "one-number",
            "g_s_range": g_s_range,
        }
        return cls(right, K, E, **(preset | kwargs))

    @classmethod
    def search_only(cls, right: Any, K: Any, E: Any, **kwargs: Any) -> GeometryGuidance:
        """The default without gradient updates: only the scale and shift that the search finds.

        Args:
            right: as in the constructor.
            K: as in the constructor.
            E: as in the constructor.
            **kwargs: hyperparameters.
        """
        preset: dict[str, Any] = {"inner_steps": 0, "weights": {"photometric": 1.0}}
        return cls(right, K, E, **(preset | kwargs))

    @property
    def rigs(self) -> list[Rig]:
        """The calibrations as understood, one per right image."""
        return list(self._rigs)

    @property
    def rights(self) -> list[Tensor]:
        """The right images, ``(3, H, W)`` float32 in [0, 1] each, native size."""
        return list(self._rights)

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
        count = lefts_01.shape[0]
        if len(self._rights) != count:
            bad_value("right", f"a list of {count} images, one per left image", f"{len(self._rights)}")
        config, device, evidence = self.config, lefts_01.device, []
        matched = bool(config.weights.get("matches")) and config.inner_steps > 0
        for i, rig in enumerate(self._rigs):
            check_intrinsics_fit(
                rig.K_left,
                lefts_01.shape[-1],
                lefts_01.shape[-2],
                _label("K", i, self._rights),
                "the left image",
            )
            matrices = (rig.K_left, rig.K_right, rig.T_right_from_left)
            cameras = (torch.as_tensor(m, dtype=torch.float32, device=device) for m in matrices)
            evidence.append(
                prepare_evidence(
                    lefts_01[i],
                    self._rights[i].to(device),
                    *cameras,
                    loss_resolution=config.loss_resolution,
                    depth_range=config.depth_range,
                    needs_volume=config.search == "volume",
                    needs_matches=matched,
                )
            )
        return evidence


def _label(name: str, i: int, entries: list) -> str:
    return name if len(entries) == 1 else f"{name}[{i}]"


def _entry(value: Any, name: str, i: int, count: int) -> Any:
    """The entry of image ``i``: a list has one per image, anything else serves all."""
    if not isinstance(value, list):
        return value
    if value and not isinstance(value[0], (tuple, np.ndarray, Tensor)) and np.ndim(value) == 2:
        return value  # a matrix written as nested lists
    if len(value) != count:
        bad_value(name, f"a list of {count} entries, one per right image", f"{len(value)} entries")
    return value[i]


def _rig(K: Any, E: Any, K_name: str, E_name: str) -> Rig:
    if isinstance(K, tuple):
        if len(K) != 2:
            bad_type(K_name, "a 3x3 matrix or a tuple (K_left, K_right)", K)
        K_left, K_right = (
            check_intrinsics(K[0], f"{K_name}[left]"),
            check_intrinsics(K[1], f"{K_name}[right]"),
        )
    else:
        K_left = K_right = check_intrinsics(K, K_name)
    if isinstance(E, tuple):
        if len(E) != 2:
            bad_type(E_name, "a 4x4 matrix or a tuple (E_left, E_right)", E)
        pose = np.linalg.inv(check_pose(E[0], f"{E_name}[left]")) @ check_pose(E[1], f"{E_name}[right]")
    else:
        pose = check_pose(E, E_name)
    check_baseline(pose, E_name)
    return Rig(K_left, K_right, pose)
