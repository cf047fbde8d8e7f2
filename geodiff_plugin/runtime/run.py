"""State of one guided call: its hooks on the pipeline, one ``Trajectory`` per batch chunk, the callbacks.

Data flow: pipeline + ``GeometryGuidance`` -> hooks on -> trajectories -> metric depth of every member
    -> hooks off.
Paper: Algorithm 1 around ``algorithm.guided_step``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any

import torch
from torch import Tensor
from tqdm.auto import tqdm

from geodiff_plugin._checks import bad_type, bad_value
from geodiff_plugin.algorithm.denoising import noise_from, output_from, z0_from
from geodiff_plugin.algorithm.evidence import Evidence
from geodiff_plugin.algorithm.known import Known
from geodiff_plugin.algorithm.state import Trajectory
from geodiff_plugin.algorithm.step import StepContext, guided_step
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.runtime.channels import put_channels
from geodiff_plugin.runtime.codec import MapCodec
from geodiff_plugin.runtime.denoiser import DenoiserTap
from geodiff_plugin.runtime.exclusive import Exclusive
from geodiff_plugin.runtime.flags import FrozenWeights, Running
from geodiff_plugin.runtime.grid import ProcessingGrid
from geodiff_plugin.runtime.half_precision import ImagesInFloat32
from geodiff_plugin.runtime.noise_levels import noise_level
from geodiff_plugin.runtime.preconditions import needs_network
from geodiff_plugin.runtime.scheduler import GuidedScheduler
from geodiff_plugin.runtime.warm_start import WarmStart

__all__ = ["GuidedRun"]

StepCallback = Callable[[Any, int, Any, dict[str, Tensor | None]], dict[str, Tensor] | None]
#: What the scheduler's step is given: network output, noisy latent, and what to add to its result.
StepResult = tuple[Tensor, Tensor, Tensor | None]


class GuidedRun:
    """State of one guided call.

    Args:
        pipe: the live pipeline.
        prior: its adapter.
        guidance: what the user configured.
        evidence: one entry per image.
        ensemble_size: members per image.
        batch_size: samples per chunk, as the pipeline slices them.
        grid: the processing grid of the pipeline.
        rounds: how often each denoising step is corrected and updated, see ``rounds.plan_steps``.
        callback: ``callback_on_step_end`` or ``None``.
        wants_latents: whether the call returns the final latents.
        tiny: autoencoder that is used in the loop; ``None`` for the pipeline's.
        held: lock against calls in other threads, released while the callback runs.
        warm: the start from the previous frame, or ``None``.

    Attributes:
        trajectories: one per chunk.
        relative: decoded maps of the final latents, one per chunk, without padding.
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
        self._codec = MapCodec(pipe, prior, grid, tiny)
        self.trajectories: list[Trajectory] = []
        self.relative: list[Tensor] = []
        self.members: list[Tensor] = []
        self.step_index = 0
        self.timesteps: list[float] = []
        self._decoded_chunks = 0
        self._ends_m: list[tuple[Tensor, Tensor]] = []  # nearest and farthest of the final maps of a chunk
        self._stack, self._bar = ExitStack(), None
        self._tap = None
        if self.full and prior.network_input is not None:
            self._tap = DenoiserTap(*prior.network(), prior.network_input)
        self._scheduler = GuidedScheduler(
            pipe, self._on_trajectory, self._on_step, self._on_done, self.config.respace, self._skipped
        )
        self._hooks: list[AbstractContextManager[object]] = [
            FrozenWeights(pipe),
            ImagesInFloat32(pipe.image_processor),
            *([self._tap] if self._tap else []),
            self._scheduler,
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

    def release(self) -> None:
        """Undo what ties the run and its hooks together, so that its memory is free once nobody needs it.

        Python's collector of cycles comes late, and knows nothing of a device's memory.
        """
        self._scheduler.release()
        del self._scheduler
        self._hooks.clear()

    @contextmanager
    def _suspended(self) -> Iterator[None]:
        """Remove the hooks while a callback runs, so that it may call or save the pipeline."""
        self._stack.close()
        try:
            with self._held.given_back():
                yield
        finally:
            self.__enter__()

    @property
    def rounds_of_step(self) -> range:
        """Numbers of the current step's rounds in the schedule; steps skipped by a warm start count."""
        first = (self._skipped + self.step_index) * self.rounds
        return range(first, first + self.rounds)

    def metric_prediction(self, latents: Tensor) -> Tensor:
        """Metric depth of the next chunk of final latents, instead of the clipping decode.

        Args:
            latents: ``(B, C, h, w)``, chunks in the order in which they were denoised.

        Returns:
            ``(B, 1, H, W)`` metres on the padded processing grid, in float32.
        """
        trajectory = self.trajectories[self._decoded_chunks]
        self._decoded_chunks += 1
        # The map that was encoded last: decoding would add the autoencoder's loss and the scheduler's noise.
        x = trajectory.result
        if x is None:
            x = self.grid.filled(self.prior.decode(latents[:, self.prior.latents]).float())
        else:
            x = self.grid.padded(x)
        self.relative.append(self.grid.cropped(x))
        trajectory.watch.note("the map of the final latent", len(self.timesteps) - 1, x)
        depth_m = trajectory.metric(x, trajectory.affine)
        self._ends_m.append((depth_m.amin((1, 2, 3), keepdim=True), depth_m.amax((1, 2, 3), keepdim=True)))
        return depth_m

    def within_range(self, depth_m: Tensor, image: int | None = None) -> Tensor:
        """Keep maps brought to another size in the range that they had: bicubic enlargement overshoots.

        Args:
            depth_m: ``(M, 1, H, W)`` metres: of all images, or of the members of one.
            image: whose members these are.

        Returns:
            The same tensor, changed in place.
        """
        own = [i for i, owner in enumerate(self.owners) if image in (None, owner)]
        near_m, far_m = (
            torch.cat(ends).to(depth_m)[own].view(len(depth_m), -1, 1, 1)
            for ends in zip(*self._ends_m, strict=True)
        )
        return depth_m.clamp_(near_m.amin(1, keepdim=True), far_m.amax(1, keepdim=True))

    def known(self, image: int, member: int | None = None) -> Known:
        """Matches and points of one image on the grid of the sweep, weighted by what the loop found of them.

        Args:
            image: its index in the call.
            member: index of the ensemble member whose weights are used; ``None`` for the mean of all.
        """
        members = [
            t.known.of_sample(i)
            for t in self.trajectories
            for i, owner in enumerate(t.owners)
            if owner == image
        ]
        chosen = members if member is None else members[member : member + 1]
        means = []
        for values in zip(*chosen, strict=True):  # what is kept of each match, and the prior's error
            present = [value for value in values if value is not None]
            means.append(torch.stack(present).mean(0, keepdim=True) if present else None)
        return Known.of([self.evidence[image]], self.config, "sweep", *means)

    def check_finite(self) -> None:
        """Check, once and after the loop, that everything computed in it is finite.

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
            options = {"desc": "guided steps", **getattr(self.pipe, "_progress_bar_config", {})}
            chunks = -(-len(self.owners) // self.batch_size)
            self._bar = tqdm(total=chunks * len(self.timesteps), **options)

    def _on_step(self, output: Tensor, timestep: Tensor, z_t: Tensor) -> StepResult:
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

        codec = self._codec
        encode = codec.encode if tap is None else None
        timestep_now = self.timesteps[self.step_index]
        last = self.step_index == len(self.timesteps) - 1
        decode_result = codec.decode_result if last and not self._reads_latents else None
        rounds, count = self.rounds_of_step, (self._skipped + len(self.timesteps)) * self.rounds
        at = StepContext(
            self.step_index, timestep_now, rounds, count, eps, z0_of, codec.decode, encode, decode_result
        )
        with torch.autocast(z_t.device.type, enabled=False):  # bfloat16 cannot tell column 761 from 762
            move = guided_step(trajectory, leaf, at)
        if codec.has_tiny and decode_result is None:
            trajectory.result = None  # its map is a tiny decoder's
        active = any(trajectory.is_active(i / count) for i in rounds)
        if move is None or not self.config.optimize_latents or not active:
            result: StepResult = output, z_t, None  # bit for bit the pipeline's own step
        elif tap is not None:
            result = self._moved_noisy(tap, output, z_t, leaf, move)
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

    def _moved_noisy(
        self, tap: DenoiserTap, output: Tensor, z_t: Tensor, leaf: Tensor, move: Tensor
    ) -> StepResult:
        """What the scheduler steps from where z_t was moved: the full gradient."""
        depth = self.prior.latents
        if self.prior.max_steps == 1:
            # The step gives the clean latent: the network's answer at the moved z_t, not a moved answer.
            moved = (leaf + move).detach()
            return tap.output_at(moved).detach(), put_channels(z_t, depth, moved.to(z_t.dtype)), None
        if self.config.step_from == "updated":
            moved = (leaf + move).detach().to(z_t.dtype)
            return output, put_channels(z_t, depth, moved), None
        wide = torch.promote_types(z_t.dtype, torch.float32)
        return output, z_t, put_channels(torch.zeros_like(z_t, dtype=wide), depth, move)

    def _on_done(self, timestep: Tensor, latents: Tensor) -> Tensor:
        if self.callback is not None:
            values = {"latents": latents, **self._seen_by_callback(latents)}
            before = latents.clone()
            with self._suspended():
                answer = self.callback(self.pipe, self.step_index, timestep, values)
            latents = _latents_of(answer, latents)
            if not torch.equal(latents, before):  # replaced, or changed in place
                self.trajectories[-1].result = None
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
            x = self._codec.decode_result(latents[:, self.prior.latents])
        return {
            "metric_depth": trajectory.metric(x, affine),
            "loss": trajectory.history[-1].loss,
            "scale": affine.scale,
            "shift": affine.shift,
        }


def _latents_of(answer: Any, latents: Tensor) -> Tensor:
    """What a callback answered for the latents, checked; ``latents`` where it left them alone."""
    name, cure = (
        "the answer of callback_on_step_end",
        "Return callback_kwargs, or nothing to leave the latents as they are.",
    )
    if answer is None:
        return latents
    if not isinstance(answer, Mapping):
        bad_type(name, "a dict or None", answer, cure)
    answered = answer.get("latents", latents)
    if not isinstance(answered, Tensor):
        bad_type(f"latents in {name}", "a tensor", answered, cure)
    if answered.shape != latents.shape:
        got = f"shape {tuple(answered.shape)}"
        bad_value(f"latents in {name}", f"of shape {tuple(latents.shape)}", got, cure)
    answered = answered.to(latents)
    if not answered.isfinite().all():
        bad_value(f"latents in {name}", "finite", "NaN or infinity", cure)
    return answered
