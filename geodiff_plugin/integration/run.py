"""One guided call of one pipeline: everything that is set up for it and taken down after it.

Hop: pipeline + ``GeometryGuidance`` -> hooks on -> trajectories -> metric depth of every member -> hooks off.
Paper: Algorithm 1 around ``algorithm.guided_step``.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.algorithm import guided_step
from geodiff_plugin.denoising import noise_from, output_from, z0_from
from geodiff_plugin.evidence import Evidence
from geodiff_plugin.guidance import GeometryGuidance
from geodiff_plugin.integration.channels import put_channels
from geodiff_plugin.integration.denoiser import DenoiserTap
from geodiff_plugin.integration.guided_scheduler import GuidedScheduler
from geodiff_plugin.integration.refusals import needs_network
from geodiff_plugin.integration.schedulers import noise_level
from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.trajectory import Trajectory

__all__ = ["GuidedRun", "plan_steps"]

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
        padding: rows at the bottom and columns at the right that were added to it.
        rounds: times that every denoising step makes its updates, see ``plan_steps``.
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
        padding: tuple[int, int],
        rounds: int,
        callback: StepCallback | None,
    ) -> None:
        self.pipe, self.prior, self.config, self.evidence = pipe, prior, guidance.config, evidence
        self.owners = [i for i in range(len(evidence)) for _ in range(ensemble_size)]
        self.batch_size, self.content_size, self.padding = batch_size, content_size, padding
        self.rounds, self.callback = rounds, callback
        self.trajectories: list[Trajectory] = []
        self.relative: list[Tensor] = []
        self.step_index, self.timesteps = 0, []
        self._tap: DenoiserTap | None = None
        self._decoded_chunks = 0
        self._stack = ExitStack()

    def __enter__(self) -> GuidedRun:
        with ExitStack() as stack:
            stack.enter_context(_frozen_weights(self.pipe))
            if needs_network(self.config):
                tap = DenoiserTap(*self.prior.network(), self.prior.network_input)
                self._tap = stack.enter_context(tap)
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
    def spans(self) -> list[tuple[float, float]]:
        """Begin and end of the rounds of the current step in the schedule, [0, 1] each."""
        first, count = self.step_index * self.rounds, len(self.timesteps) * self.rounds
        return [(i / count, (i + 1) / count) for i in range(first, first + self.rounds)]

    def decode(self, z0: Tensor) -> Tensor:
        """Unclipped relative map without padding, ``(B, 1, H, W)`` float32, with its graph."""
        height, width = self.content_size
        return self.prior.decode(z0)[:, :, :height, :width]

    def encode(self, x: Tensor) -> Tensor:
        """Clean latent of a relative map without padding, which is made as the image's was."""
        bottom, right = self.padding
        return self.prior.encode(F.pad(x, (0, right, 0, bottom), mode="replicate"))

    def metric_prediction(self, latents: Tensor) -> Tensor:
        """Metric depth of the next chunk of final latents; takes the place of the clipping decode.

        Args:
            latents: ``(B, C, h, w)``, chunks in the order in which they were denoised.

        Returns:
            ``(B, 1, H, W)`` metres on the padded processing grid, in float32.
        """
        trajectory = self.trajectories[self._decoded_chunks]
        self._decoded_chunks += 1
        x = self.prior.decode(latents[:, self.prior.latents])
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
        trajectory, depth = self.trajectories[-1], self.prior.latents
        wide = torch.promote_types(z_t.dtype, torch.float32)  # half precision ends here
        wide_output, wide_z_t = output[:, depth].to(wide), z_t[:, depth].to(wide)
        eps = noise_from(wide_output, wide_z_t, level)
        full = self._tap is not None
        if full:
            leaf = self._tap.leaf

            def z0_of(z: Tensor) -> Tensor:
                return z0_from(self._tap.output_at(z)[:, depth].to(wide), z, level)
        else:
            leaf, z0_of = z0_from(wide_output, wide_z_t, level), _identity
        with torch.autocast(z_t.device.type, enabled=False):  # bfloat16 cannot tell column 761 from 762
            move = guided_step(
                trajectory,
                leaf,
                z0_of,
                self.decode,
                None if full else self.encode,
                eps,
                self.step_index,
                self.timesteps[self.step_index],
                self.spans,
            )
        if not self.config.optimize_latents or not any(
            trajectory.is_active(begin) for begin, _ in self.spans
        ):
            result = output, z_t, None  # bit for bit the pipeline's own step
        elif full and self.prior.max_steps == 1:
            # The step gives the clean latent: the network's answer at the moved z_t, not a moved answer.
            moved = (leaf + move).detach()
            result = self._tap.output_at(moved).detach(), put_channels(z_t, depth, moved.to(z_t.dtype)), None
        elif full and self.config.step_from == "updated":
            moved = (leaf + move).detach().to(z_t.dtype)
            result = output, put_channels(z_t, depth, moved), None
        elif full:
            result = output, z_t, put_channels(torch.zeros_like(z_t, dtype=wide), depth, move)
        else:
            moved_output, moved_z_t = output_from(leaf + move, eps, level)
            result = (
                put_channels(output, depth, moved_output.to(output.dtype)),
                put_channels(z_t, depth, moved_z_t.to(z_t.dtype)),
                None,
            )
        if full:
            self._tap.release()
        return result

    def _on_done(self, timestep: Tensor, latents: Tensor) -> Tensor:
        if self.callback is not None:
            trajectory = self.trajectories[-1]
            affine = trajectory.affine
            depth = latents[:, self.prior.latents]
            x = self.decode(depth) if self.step_index == len(self.timesteps) - 1 else trajectory.last_x
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


def plan_steps(
    guidance: GeometryGuidance, prior: DepthPrior, asked: int | None, pipeline_default: int | None
) -> tuple[int, int]:
    """Denoising steps of a guided call, and how often each makes its updates.

    A prior that can only take fewer steps than guidance wants makes the updates of all of them in those
    that it has, each round with its own search and gate on matches, as a step would have.

    Args:
        guidance: says how many steps it wants.
        prior: says how many make sense.
        asked: ``num_inference_steps`` of the call.
        pipeline_default: when none was asked for.

    Raises:
        ValueError: more steps were asked for than the prior has.
    """
    wanted = guidance.denoising_steps(asked, pipeline_default)
    if prior.max_steps is None or wanted <= prior.max_steps:
        return wanted, 1
    if asked is not None:
        cure = "Leave it out: the prior was trained for so few."
        bad_value("num_inference_steps", f"at most {prior.max_steps} with this prior", asked, cure)
    return prior.max_steps, -(-wanted // prior.max_steps)
