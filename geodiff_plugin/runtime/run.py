"""State of one guided call: what is set up for it on the pipeline and taken down after it.

Data flow: pipeline + ``GeometryGuidance`` -> hooks on -> trajectories -> metric depth of every member
    -> hooks off.
Paper: Algorithm 1 around ``algorithm.guided_step``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any

import torch
from torch import Tensor
from tqdm.auto import tqdm

from geodiff_plugin.algorithm.denoising import noise_from, output_from, z0_from
from geodiff_plugin.algorithm.evidence import Evidence
from geodiff_plugin.algorithm.known import Known
from geodiff_plugin.algorithm.state import Trajectory
from geodiff_plugin.algorithm.step import StepContext, guided_step
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.runtime.channels import put_channels
from geodiff_plugin.runtime.denoiser import DenoiserTap
from geodiff_plugin.runtime.exclusive import Exclusive
from geodiff_plugin.runtime.grid import ProcessingGrid
from geodiff_plugin.runtime.half import ImagesInFloat32
from geodiff_plugin.runtime.marks import FrozenWeights, Running
from geodiff_plugin.runtime.noise_levels import noise_level
from geodiff_plugin.runtime.preconditions import needs_network
from geodiff_plugin.runtime.scheduler import GuidedScheduler
from geodiff_plugin.runtime.warm_start import WarmStart

__all__ = ["GuidedRun"]

StepCallback = Callable[[Any, int, Any, dict[str, Tensor | None]], dict[str, Tensor] | None]


class GuidedRun:
    """State of one guided call.

    Args:
        pipe: the live pipeline.
        prior: its adapter.
        guidance: what the user configured.
        evidence: one entry per image.
        ensemble_size: members per image.
        batch_size: samples per chunk, as the pipeline slices them.
        grid: that the pipeline works on.
        rounds: times that every denoising step makes its updates, see ``rounds.plan_steps``.
        callback: ``callback_on_step_end`` or ``None``.
        wants_latents: whether the caller is given the final latents.
        tiny: what decodes and encodes in the loop; ``None`` for the pipeline's own autoencoder.
        held: what the call holds against other threads, given back while the callback runs.
        warm: where the call goes on from another frame, or ``None``.

    Attributes:
        trajectories: one a chunk.
        relative: the decoded maps of the final latents, one a chunk, without padding.
        members: of every image with an ensemble, ``(E, 1, H, W)`` metres without padding.
    """

    def __init__(
        self,
        pipe: Any,
        prior: DepthPrior,
        guidance: GeometryGuidance,
        evidence: list[Evidence],
        ensemble_size: int,
        batch_size: int,
        grid: ProcessingGrid,
        rounds: int,
        callback: StepCallback | None,
        wants_latents: bool,
        tiny: Any | None,
        held: Exclusive,
        warm: WarmStart | None = None,
    ) -> None:
        self.pipe, self.prior, self.config, self.evidence = pipe, prior, guidance.config, evidence
        self.full = needs_network(guidance)
        self.owners = [i for i in range(len(evidence)) for _ in range(ensemble_size)]
        self.batch_size, self.grid = batch_size, grid
        self.rounds, self.callback, self._held = rounds, callback, held
        self.warm, self._skipped = warm, 0 if warm is None else warm.skipped
        self._reads_latents = wants_latents or callback is not None
        self._tiny = tiny
        self.trajectories: list[Trajectory] = []
        self.relative: list[Tensor] = []
        self.members: list[Tensor] = []
        self.step_index = 0
        self.timesteps: list[float] = []
        self._decoded_chunks = 0
        self._stack, self._bar = ExitStack(), None
        self._tap = None
        if self.full and prior.network_input is not None:
            self._tap = DenoiserTap(*prior.network(), prior.network_input)
        self._hooks: list[AbstractContextManager[object]] = [
            FrozenWeights(pipe),
            ImagesInFloat32(pipe.image_processor, pipe._execution_device),
            *([self._tap] if self._tap else []),
            GuidedScheduler(
                pipe, self._on_trajectory, self._on_step, self._on_done, self.config.respace, self._skipped
            ),
            Running(pipe, self),
        ]

    def __enter__(self) -> GuidedRun:
        with ExitStack() as stack:
            for hook in self._hooks:
                stack.enter_context(hook)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()
        if self._bar is not None:
            self._bar.close()

    @contextmanager
    def _suspended(self) -> Iterator[None]:
        """The pipeline as the user left it, for the length of a callback: stock, guided or saved there."""
        self._stack.close()
        try:
            with self._held.given_back():
                yield
        finally:
            self.__enter__()

    @property
    def rounds_of_step(self) -> range:
        """Numbers of the current step's rounds in the schedule; steps that a warm start leaves out count."""
        first = (self._skipped + self.step_index) * self.rounds
        return range(first, first + self.rounds)

    @contextmanager
    def _in_the_loop(self) -> Iterator[None]:
        """The tiny autoencoder, if there is one, in the place of the pipeline's own."""
        if self._tiny is None:
            yield
            return
        own = self.pipe.vae
        object.__setattr__(self.pipe, "vae", self._tiny)  # past the rewriting of the pipeline's config
        try:
            yield
        finally:
            object.__setattr__(self.pipe, "vae", own)

    def decode(self, z0: Tensor) -> Tensor:
        """Unclipped relative map without padding, ``(B, 1, H, W)`` float32, with its graph; in the loop."""
        with self._in_the_loop():
            return self.decode_result(z0)

    def decode_result(self, z0: Tensor) -> Tensor:
        """The same by the pipeline's own autoencoder."""
        return self.grid.cropped(self.grid.filled(self.prior.decode(z0)))

    def encode(self, x: Tensor) -> Tensor:
        """Clean latent of a relative map without padding, which is made as the image's was; in the loop."""
        with self._in_the_loop():
            return self.prior.encode(self.grid.padded(x))

    def metric_prediction(self, latents: Tensor) -> Tensor:
        """Metric depth of the next chunk of final latents; takes the place of the clipping decode.

        Args:
            latents: ``(B, C, h, w)``, chunks in the order in which they were denoised.

        Returns:
            ``(B, 1, H, W)`` metres on the padded processing grid, in float32.
        """
        trajectory = self.trajectories[self._decoded_chunks]
        self._decoded_chunks += 1
        # What was encoded last, before the autoencoder's loss and the noise that SD-2's schedulers leave.
        x = trajectory.result
        if x is None:
            x = self.grid.filled(self.prior.decode(latents[:, self.prior.latents]))
        else:
            x = self.grid.padded(x)
        self.relative.append(self.grid.cropped(x))
        trajectory.watch.note("the map of the final latent", len(self.timesteps) - 1, x)
        return trajectory.metric(x, trajectory.affine)

    def known(self, image: int, member: int | None = None) -> Known:
        """What is known of one image on the grid of the sweep.

        Args:
            image: its index in the call.
            member: as the judgement of this one says; ``None`` for that of all members, on average.
        """
        own = [t.known.of_sample(i) for t in self.trajectories for i, o in enumerate(t.owners) if o == image]
        chosen = own if member is None else own[member : member + 1]
        means = []
        for judged in zip(*chosen, strict=True):  # what is kept of each match, and the prior's error
            given = [one for one in judged if one is not None]
            means.append(torch.stack(given).mean(0, keepdim=True) if given else None)
        return Known.of([self.evidence[image]], self.config, "sweep", *means)

    def check_finite(self) -> None:
        """Ask, once and after the loop, whether everything that was computed is finite.

        Raises:
            ValueError: naming the step, the tensor and the cure.
        """
        for trajectory in self.trajectories:
            trajectory.watch.check(self.pipe.dtype)

    def _on_trajectory(self, timesteps: Tensor) -> None:
        first = len(self.trajectories) * self.batch_size
        chunk = slice(first, first + self.batch_size)
        own_range = self.prior.metric_range(chunk)
        start = None if self.warm is None else (self.warm.near_m[chunk], self.warm.far_m[chunk])
        self.trajectories.append(
            Trajectory(self.config, self.evidence, self.owners[chunk], self.prior.space, own_range, start)
        )
        self.step_index, self.timesteps = 0, timesteps.tolist()
        if self._bar is None:
            told = {"desc": "guided steps", **getattr(self.pipe, "_progress_bar_config", {})}
            chunks = -(-len(self.owners) // self.batch_size)
            self._bar = tqdm(total=chunks * len(self.timesteps), **told)

    def _on_step(self, output: Tensor, timestep: Tensor, z_t: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        level = noise_level(self.pipe.scheduler, timestep)
        trajectory, depth = self.trajectories[-1], self.prior.latents
        wide = torch.promote_types(z_t.dtype, torch.float32)  # half precision ends here
        wide_output, wide_z_t = output[:, depth].to(wide), z_t[:, depth].to(wide)
        if self.step_index == 0:
            trajectory.watch.note("the prior's output", 0, wide_output)
        eps = noise_from(wide_output, wide_z_t, level)
        tap = self._tap
        leaf = z0_from(wide_output, wide_z_t, level) if tap is None else tap.leaf

        def z0_of(z: Tensor) -> Tensor:
            return z if tap is None else z0_from(tap.output_at(z)[:, depth].to(wide), z, level)

        encode = self.encode if tap is None else None
        timestep_now = self.timesteps[self.step_index]
        last = self.step_index == len(self.timesteps) - 1
        decode_result = self.decode_result if last and not self._reads_latents else None
        rounds, count = self.rounds_of_step, (self._skipped + len(self.timesteps)) * self.rounds
        at = StepContext(
            self.step_index, timestep_now, rounds, count, eps, z0_of, self.decode, encode, decode_result
        )
        with torch.autocast(z_t.device.type, enabled=False):  # bfloat16 cannot tell column 761 from 762
            move = guided_step(trajectory, leaf, at)
        updates = self.config.updates
        result: tuple[Tensor, Tensor, Tensor | None]
        if self._tiny is not None and decode_result is None:
            trajectory.result = None  # its map is a tiny decoder's
        active = any(trajectory.is_active(i / count) for i in rounds)
        if move is None or not updates.optimize_latents or not active:
            result = output, z_t, None  # bit for bit the pipeline's own step
        elif tap is not None and self.prior.max_steps == 1:
            # The step gives the clean latent: the network's answer at the moved z_t, not a moved answer.
            moved = (leaf + move).detach()
            result = tap.output_at(moved).detach(), put_channels(z_t, depth, moved.to(z_t.dtype)), None
        elif tap is not None and updates.step_from == "updated":
            moved = (leaf + move).detach().to(z_t.dtype)
            result = output, put_channels(z_t, depth, moved), None
        elif tap is not None:
            result = output, z_t, put_channels(torch.zeros_like(z_t, dtype=wide), depth, move)
        else:
            moved_output, moved_z_t = output_from(leaf + move, eps, level)
            result = (
                put_channels(output, depth, moved_output.to(output.dtype)),
                put_channels(z_t, depth, moved_z_t.to(z_t.dtype)),
                None,
            )
        if tap is not None:
            tap.release()
        return result

    def _on_done(self, timestep: Tensor, latents: Tensor) -> Tensor:
        if self.callback is not None:
            values = {"latents": latents, **self._seen_by_callback(latents)}
            with self._suspended():
                answer = self.callback(self.pipe, self.step_index, timestep, values) or {}
            if "latents" in answer:
                latents, self.trajectories[-1].result = answer["latents"], None
        self.step_index += 1
        if self._bar is not None:
            history = self.trajectories[-1].history
            loss = history[-1].loss if history else None
            # Another device would be waited for.
            if loss is not None and not self._bar.disable and loss.device.type == "cpu":
                self._bar.set_postfix(loss=f"{float(loss.mean()):.4f}", refresh=False)
            self._bar.update()
        return latents

    def _seen_by_callback(self, latents: Tensor) -> dict[str, Tensor | None]:
        trajectory = self.trajectories[-1]
        if not trajectory.has_scale:  # the steps before the first correction are the prior's own
            return dict.fromkeys(("metric_depth", "loss", "scale", "shift"))
        affine, x = trajectory.affine, trajectory.last_x
        if x is None or self.step_index == len(self.timesteps) - 1:
            x = self.decode_result(latents[:, self.prior.latents])
        return {
            "metric_depth": trajectory.metric(x, affine),
            "loss": trajectory.history[-1].loss,
            "scale": affine.scale,
            "shift": affine.shift,
        }
