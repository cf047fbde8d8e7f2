"""State and hooks of one guided call (``GuidedRun``)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from diffusers.pipelines.marigold import MarigoldDepthOutput
from torch import Tensor
from tqdm.auto import tqdm

from geodiff_plugin._internal.checks import bad_type, bad_value
from geodiff_plugin.algorithm.member import Member
from geodiff_plugin.algorithm.schedule import Schedule, make_schedule
from geodiff_plugin.algorithm.state import StepTime, Trajectory
from geodiff_plugin.algorithm.step import guided_step
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.evidence.plan import EvidencePlan
from geodiff_plugin.findings import Finding
from geodiff_plugin.result.finish import ResultOptions, finish
from geodiff_plugin.result.output import MetricDepthOutput, stack_results
from geodiff_plugin.runtime import hooks
from geodiff_plugin.runtime.codec import MapCodec, StepEstimate, StepInputs
from geodiff_plugin.runtime.noise_levels import noise_level
from geodiff_plugin.trust import Call

StepCallback = Callable[[Any, int, Any, dict[str, Tensor | None]], dict[str, Tensor] | None]


class GuidedRun:
    """State of one guided call.

    The stock call drives it. For each chunk of samples the stock loop calls ``begin`` once, then ``guide``
    and ``after_step`` at each step (``hooks.GuidedScheduler``). It then decodes the final latents chunk by
    chunk (``metric_prediction``). ``output`` is called last.

    Args:
        codec: the pipeline, its prior and the grid that the stock call denoises on.
        guidance: the user's guidance.
        plans: returns the evidence of every image, waiting for it if necessary.
        call: arguments of the stock call that runs phase 2; its image is a tensor on the device.
        rounds: number of guidance rounds in each denoising step.
        callback: the user's callback, which runs while the pipeline has no hooks.
    """

    def __init__(
        self,
        codec: MapCodec,
        guidance: GeometryGuidance,
        plans: Callable[[], Sequence[EvidencePlan]],
        call: Mapping[str, Any],
        rounds: int = 1,
        callback: StepCallback | None = None,
    ) -> None:
        self.pipe, self.prior, self.config = codec.pipe, codec.prior, guidance.config
        self.device: torch.device = call["image"].device
        self.guidance, self.call, self._plans = guidance, call, plans
        self._image_of_sample = [i for i in range(len(guidance.inputs)) for _ in range(call["ensemble_size"])]
        self.schedule: Schedule | None = None
        self.trajectories: list[Trajectory] = []  # one per chunk, created at its first guided step
        self.members: list[Member] = []  # of all images; the members of one image are consecutive
        self._plan = guidance.updates
        self._rounds = rounds
        self._callback = callback
        self._reads_latents = call["output_latent"] or callback is not None
        self._codec = codec
        self._chunk = -1
        self._step = 0
        self._first_output: Tensor | None = None  # network output at the first step of the chunk
        self._timesteps: list[float] = []
        self._shown: Tensor | None = None  # relative map of the chunk's latest evaluation
        self._results: list[Tensor | None] = []  # per chunk, the map that its output starts from
        self._decoded = 0  # number of chunks whose final latents were decoded
        self._stack = ExitStack()
        self._bar = None
        self._denoiser = None
        if guidance.through_network and self.prior.network_input is not None:
            self._denoiser = hooks.DenoiserHook(*self.prior.network(), self.prior.network_input)
        self._scheduler = hooks.GuidedScheduler(self.pipe, self, self.config.trailing_spacing)

    def __enter__(self) -> GuidedRun:
        with ExitStack() as stack:
            if self._plan.guidance_steps:  # otherwise nothing is differentiated
                stack.enter_context(hooks.frozen_weights(self.pipe))
            image = self.call["image"]
            preprocessed = self._codec.grid.preprocessed
            stack.enter_context(hooks.images_in_float32(self.pipe.image_processor, image, preprocessed))
            if self.pipe._faster is not None:
                stack.enter_context(self.pipe._faster.attached(self.pipe))
            if self._denoiser is not None:
                stack.enter_context(self._denoiser.attached())
            stack.enter_context(self._scheduler.attached())
            # Switches the pipeline's decoding and ensembling to guided mode.
            stack.enter_context(hooks.replaced(self.pipe, "_guided_run", self))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def release(self) -> None:
        """Close the progress bar and break the reference cycle with the hooks, which would hold memory."""
        if self._bar is not None:
            self._bar.close()
        self._scheduler.release()
        del self._scheduler

    @contextmanager
    def _suspended(self) -> Iterator[None]:
        """Remove the hooks while a callback runs, so that it may call or save the pipeline."""
        self._stack.close()
        try:
            yield
        finally:
            self.__enter__()

    def metric_prediction(self, latents: Tensor) -> Tensor:
        """Decode the next chunk of final latents to metric depth ``(B, 1, H, W)`` on the padded grid."""
        trajectory, x = self.trajectories[self._decoded], self._results[self._decoded]
        self._decoded += 1
        if x is None:  # a known map avoids decoding, which would add the autoencoder's loss
            x = self.prior.decode(latents[:, self.prior.depth_channels]).float()
        grid = self._codec.grid
        x = grid.padded(x)
        depth_m = trajectory.result(x)
        self.members += trajectory.members(grid.cropped(x), depth_m)
        return depth_m

    def output(self, stock: MarigoldDepthOutput, findings: Sequence[Finding]) -> MetricDepthOutput:
        """Run phase 3 on the stock call's output, whose maps are in metres.

        ``findings`` concern the input; those that are reasons are added to every verdict.
        """
        guidance, call = self.guidance, self.call
        size = call["ensemble_size"]
        count = len(guidance.inputs)
        of_images = [self.members[first : first + size] for first in range(0, count * size, size)]
        options = ResultOptions(
            self.config,
            resampling=call["resample_method_output"],
            reduction=(call["ensembling_kwargs"] or {}).get("reduction", "median"),
            call=Call(
                has_unit=guidance.unit is not None,
                range_given=self.config.depth_range is not None,
                calibrated=guidance.calibrated,
                findings=tuple(findings),
            ),
            fill=guidance.fill,
        )
        spreads = [None] * count if stock.uncertainty is None else stock.uncertainty.split(1)
        evidence = [plan.complete() for plan in self._plans()]
        maps = zip(evidence, of_images, stock.prediction.split(1), spreads, strict=True)
        try:
            results = [
                finish(of_image, members, depth_m, spread, options)
                for of_image, members, depth_m, spread in maps
            ]
        finally:  # also if it fails on non-finite values
            self._check_finite()
        return stack_results(
            results,
            guidance,
            [report for trajectory in self.trajectories for report in trajectory.history],
            findings=[finding for finding in findings if not finding.is_reason],  # reasons are in verdicts
            extras=getattr(stock, "extras", {}),
            as_numpy=call["output_type"] != "pt",
        )

    def _check_finite(self) -> None:
        """Raise ``InputError`` for the first tensor of the loop that was not finite.

        Checked once, after all device work was launched: an earlier check would synchronize with the network.
        """
        for trajectory in self.trajectories:
            trajectory.watch.check(self.pipe)

    def begin(self, timesteps: Tensor) -> None:
        """Start the trajectory of the next chunk with its timesteps on the CPU."""
        self._chunk += 1
        self._results.append(None)
        self._step = 0
        self._timesteps = timesteps.tolist()
        self._shown = None
        self._first_output = None
        if self.schedule is None:
            self.schedule = self._make_schedule(len(timesteps))
            self._bar = self._make_bar(len(timesteps))

    def _make_schedule(self, steps: int) -> Schedule:
        """Return the schedule that every chunk follows."""
        encodes = self._denoiser is None
        return make_schedule(self.config, self._plan, steps, rounds=self._rounds, encodes=encodes)

    def _make_bar(self, steps: int) -> tqdm:
        """Return a progress bar over the steps of all chunks, with the options of the pipeline's own."""
        chunks = math.ceil(len(self._image_of_sample) / self.call["batch_size"])
        options = {"desc": "guided steps", **getattr(self.pipe, "_progress_bar_config", {})}
        return tqdm(total=chunks * steps, **options)

    def _trajectory(self) -> Trajectory:
        """Return the trajectory of the current chunk; the first call waits for the evidence."""
        if len(self.trajectories) <= self._chunk:
            size = self.call["batch_size"]
            chunk = slice(self._chunk * size, (self._chunk + 1) * size)
            trajectory = Trajectory(
                self.config,
                [plan.evidence for plan in self._plans()],
                self._image_of_sample[chunk],
                self.prior.maps_of(chunk),
                self._plan.lr_latents,
            )
            if self._first_output is not None:
                trajectory.step = StepTime(0, self._timesteps[0])
                trajectory.record("the prior's output", self._first_output)
            self.trajectories.append(trajectory)
        return self.trajectories[self._chunk]

    def guide(self, output: Tensor, timestep: Tensor, z_t: Tensor) -> StepInputs:
        """Guide one step and return the inputs of the scheduler's step, in place of ``output`` and ``z_t``.

        Both are ``(B, C, h, w)``.
        """
        schedule = self.schedule
        assert schedule is not None  # set by begin
        is_last = schedule.is_last(self._step)
        latent_is_read = self._reads_latents or not is_last
        if self._step == 0:
            self._first_output = output[:, self.prior.depth_channels]
        inputs = StepInputs(output, z_t)  # an unguided step equals the stock step bit for bit
        self._results[-1] = None
        if rounds := schedule.steps[self._step]:
            level = noise_level(self.pipe.scheduler, timestep)
            estimate = StepEstimate(self._codec, level, output, z_t, self._denoiser, latent_is_read)
            trajectory = self._trajectory()
            trajectory.step = StepTime(self._step, self._timesteps[self._step])
            with torch.autocast(
                z_t.device.type, enabled=False
            ):  # bfloat16 cannot resolve columns 761 and 762
                step = guided_step(trajectory, estimate, rounds, is_last)
            self._shown = step.relative
            # A map decoded by the tiny autoencoder is not part of the result.
            if step.is_current and (self._codec.tiny is None or not latent_is_read):
                self._results[-1] = step.relative
            if schedule.updates_at(self._step):
                inputs = estimate.step_inputs(step.offset, self.config.step_from == "updated")
        if self._denoiser is not None:
            self._denoiser.release()
        return inputs

    def after_step(self, timestep: Tensor, latents: Tensor) -> Tensor:
        """Run the user's callback after the scheduler's step and return ``z_{t-1} (B, C, h, w)``."""
        if self._callback is not None:
            values = {"latents": latents, **self._seen_by_callback(latents)}
            before = latents.clone()
            with self._suspended():
                answer = self._callback(self.pipe, self._step, timestep, values)
            latents = _latents_of(answer, latents)
            if not torch.equal(latents, before):  # replaced or changed in place
                self._results[-1] = None
        self._step += 1
        if self._bar is not None:
            history = self._trajectory().history if self._shown is not None else []
            loss = history[-1].loss if history else None
            # Reading the loss from a GPU would synchronize.
            if loss is not None and not self._bar.disable and loss.device.type == "cpu":
                self._bar.set_postfix(loss=f"{float(loss.mean()):.4f}", refresh=False)
            self._bar.update()
        return latents

    def _seen_by_callback(self, latents: Tensor) -> dict[str, Tensor | None]:
        x = self._shown
        if x is None:  # no step has been guided yet
            return dict.fromkeys(("metric_depth", "loss", "scale", "shift"))
        trajectory = self._trajectory()
        if self._step == len(self._timesteps) - 1:
            x = self._codec.decode(latents[:, self.prior.depth_channels], final=True)
        return {
            "metric_depth": trajectory.metric(x, trajectory.affine),
            "loss": trajectory.history[-1].loss,
            "scale": trajectory.affine.scale,
            "shift": trajectory.affine.shift,
        }


def _latents_of(answer: Any, latents: Tensor) -> Tensor:
    """Return the checked latents from a callback's return value, or ``latents`` if there are none."""
    name = "the return value of callback_on_step_end"
    hint = "Return callback_kwargs, or None to keep the latents."
    if answer is None:
        return latents
    if not isinstance(answer, Mapping):
        bad_type(name, "a dict or None", answer, hint)
    answered = answer.get("latents", latents)
    shape = tuple(answered.shape) if isinstance(answered, Tensor) else type(answered).__name__
    if shape != tuple(latents.shape):
        bad_value(f"latents in {name}", f"a tensor of shape {tuple(latents.shape)}", f"{shape}", hint)
    answered = answered.to(latents)
    if not answered.isfinite().all():
        bad_value(f"latents in {name}", "finite", "NaN or infinity", hint)
    return answered
