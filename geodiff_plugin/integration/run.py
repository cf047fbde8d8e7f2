"""One guided call of one pipeline: everything that is set up for it and taken down after it.

Hop: pipeline + ``GeometryGuidance`` -> hooks on -> trajectories -> metric depth of every member -> hooks off.
Paper: Algorithm 1 around ``trajectory.guided_step``.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import torch
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.denoising import noise_from, output_from, z0_from
from geodiff_plugin.evidence import Evidence
from geodiff_plugin.guidance import GeometryGuidance
from geodiff_plugin.integration.denoiser import DenoiserTap
from geodiff_plugin.integration.guided_scheduler import GuidedScheduler
from geodiff_plugin.integration.schedulers import check_scheduler, noise_level
from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.trajectory import Trajectory, guided_step

__all__ = ["GuidedRun"]

StepCallback = Callable[[Any, int, Any, dict[str, Tensor]], dict[str, Tensor] | None]


class GuidedRun:
    """State of one guided call.

    Args:
        pipe: the live pipeline.
        prior: its adapter.
        guidance: what the user configured.
        evidence: one entry per image.
        ensemble_size: members per image.
        batch_size: samples per chunk, as the pipeline slices them.
        content_size: ``(H, W)`` of the processing grid without padding.
        callback: ``callback_on_step_end`` or ``None``.
    """

    def __init__(
        self,
        pipe: Any,
        prior: DepthPrior,
        guidance: GeometryGuidance,
        evidence: list[Evidence],
        ensemble_size: int,
        batch_size: int,
        content_size: tuple[int, int],
        callback: StepCallback | None,
    ) -> None:
        self.pipe, self.prior, self.config, self.evidence = pipe, prior, guidance.config, evidence
        self.owners = [i for i in range(len(evidence)) for _ in range(ensemble_size)]
        self.batch_size, self.content_size, self.callback = batch_size, content_size, callback
        self.trajectories: list[Trajectory] = []
        self.relative: list[Tensor] = []
        self.step_index, self.timesteps = 0, []
        self._tap: DenoiserTap | None = None
        self._decoded_chunks = 0
        self._stack = ExitStack()

    def __enter__(self) -> GuidedRun:
        check_scheduler(self.pipe.scheduler)
        check_offloading(self.pipe, self.config.gradient)
        with ExitStack() as stack:
            stack.enter_context(_frozen_weights(self.pipe))
            if self.config.gradient == "full" and self.config.optimize_latents and self.config.inner_steps:
                self._tap = stack.enter_context(DenoiserTap(self.prior.denoiser(), self.prior.split_input))
            stack.enter_context(
                GuidedScheduler(
                    self.pipe.scheduler,
                    self._on_trajectory,
                    self._on_step,
                    self._on_done,
                    self.config.respace,
                )
            )
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    @property
    def fraction(self) -> float:
        """Where the current step lies in the schedule, [0, 1)."""
        return self.step_index / len(self.timesteps)

    def decode(self, z0: Tensor) -> Tensor:
        """Unclipped relative map without padding, ``(B, 1, H, W)`` float32, with its graph."""
        height, width = self.content_size
        return self.prior.decode(z0)[:, :, :height, :width]

    def metric_prediction(self, latents: Tensor) -> Tensor:
        """Metric depth of the next chunk of final latents; takes the place of the clipping decode.

        Args:
            latents: ``(B, C, h, w)``, chunks in the order in which they were denoised.

        Returns:
            ``(B, 1, H, W)`` metres on the padded processing grid, in float32.
        """
        trajectory = self.trajectories[self._decoded_chunks]
        self._decoded_chunks += 1
        x = self.prior.decode(latents)
        height, width = self.content_size
        self.relative.append(x[:, :, :height, :width])
        return trajectory.metric(x, trajectory.affine)

    def _on_trajectory(self, timesteps: Tensor) -> None:
        first = len(self.trajectories) * self.batch_size
        owners = self.owners[first : first + self.batch_size]
        self.trajectories.append(Trajectory(self.config, self.evidence, owners, self.prior.space))
        self.step_index, self.timesteps = 0, timesteps.tolist()

    def _on_step(self, output: Tensor, timestep: Tensor, z_t: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        level = noise_level(self.pipe.scheduler, timestep)
        wide = torch.promote_types(z_t.dtype, torch.float32)  # half precision ends here
        wide_output, wide_z_t = output.to(wide), z_t.to(wide)
        eps = noise_from(wide_output, wide_z_t, level)
        full = self._tap is not None
        if full:
            leaf = self._tap.leaf

            def z0_of(z: Tensor) -> Tensor:
                return z0_from(self._tap.output_at(z).to(wide), z, level)
        else:
            leaf, z0_of = z0_from(wide_output, wide_z_t, level), _identity
        move = guided_step(
            self.trajectories[-1],
            leaf,
            z0_of,
            self.decode,
            eps,
            self.step_index,
            self.timesteps[self.step_index],
            self.fraction,
        )
        if full:
            self._tap.release()
        if not self.config.optimize_latents or not self.trajectories[-1].is_active(self.fraction):
            return output, z_t, None  # bit for bit the pipeline's own step
        if full:
            return output, z_t, move
        moved_output, moved_z_t = output_from(leaf + move, eps, level)
        return moved_output.to(output.dtype), moved_z_t.to(z_t.dtype), None

    def _on_done(self, timestep: Tensor, latents: Tensor) -> Tensor:
        if self.callback is not None:
            trajectory = self.trajectories[-1]
            affine = trajectory.affine
            x = self.decode(latents) if self.step_index == len(self.timesteps) - 1 else trajectory.last_x
            values = {
                "latents": latents,
                "metric_depth": trajectory.metric(x, affine),
                "loss": trajectory.history[-1].loss,
                "scale": affine.scale,
                "shift": affine.shift,
            }
            latents = (self.callback(self.pipe, self.step_index, timestep, values) or {}).get(
                "latents", latents
            )
        self.step_index += 1
        return latents


def _identity(z: Tensor) -> Tensor:
    return z


class _frozen_weights:  # noqa: N801 - a context manager, used like a function
    """``requires_grad`` off on every weight (else a graph is kept for 950 M of them), back afterwards."""

    def __init__(self, pipe: Any) -> None:
        modules = [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)]
        self._flags = [(p, p.requires_grad) for m in modules for p in m.parameters()]

    def __enter__(self) -> None:
        for parameter, _ in self._flags:
            parameter.requires_grad_(False)

    def __exit__(self, *exc: object) -> None:
        for parameter, flag in self._flags:
            parameter.requires_grad_(flag)


def check_offloading(pipe: Any, gradient: str) -> None:
    """Refuse offloading that takes weights away before the backward pass needs them.

    Raises:
        ValueError: sequential or group offloading, or model offloading with the full gradient.
    """
    modules = [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)]
    for module in modules:
        for child in module.modules():
            hook = getattr(child, "_hf_hook", None)
            names = {type(h).__name__ for h in getattr(hook, "hooks", [hook] if hook else [])}
            sequential = "AlignDevicesHook" in names and any(
                getattr(h, "offload", False) for h in getattr(hook, "hooks", [hook])
            )
            registry = getattr(child, "_diffusers_hook", None)
            grouped = registry is not None and any("group_offloading" in name for name in registry.hooks)
            if sequential or grouped:
                bad_value(
                    "pipe",
                    "without sequential or group CPU offloading while guided",
                    f"{type(module).__name__} whose weights leave the device after each forward",
                    "The backward pass needs them: use pipe.enable_model_cpu_offload() or pipe.to(device).",
                )
    if gradient == "full" and getattr(pipe, "_all_hooks", None):
        bad_value(
            "gradient",
            "'denoised' with enable_model_cpu_offload()",
            "'full'",
            "Decoding pushes the U-Net to the CPU before its backward pass; "
            "use gradient='denoised' or pipe.to(device).",
        )
