"""``GuidedRun``: state and hooks of one guided call."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm.auto import tqdm

from geodiff_plugin._checks import bad_type, bad_value
from geodiff_plugin.algorithm.correction import fit_depth, local_error, prior_error
from geodiff_plugin.algorithm.schedule import Schedule, make_schedule
from geodiff_plugin.algorithm.state import Trajectory
from geodiff_plugin.algorithm.step import guided_step
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.geometry import image_size
from geodiff_plugin.matching import Matches, with_points
from geodiff_plugin.priors import DepthPrior
from geodiff_plugin.runtime import hooks
from geodiff_plugin.runtime.estimate import MapCodec, ProcessingGrid, StepEstimate, StepInputs
from geodiff_plugin.runtime.noise_levels import noise_level

StepCallback = Callable[[Any, int, Any, dict[str, Tensor | None]], dict[str, Tensor] | None]

#: Longer side of the depth prompt, pixels.
PROMPT_LONG_EDGE = 256


def depth_prompt(evidence: Sequence[Evidence], config: GuidanceConfig) -> Tensor | None:
    """``(N, 1, h, w)`` metres: flat maps corrected by matches and points; ``None`` if one image has none."""
    maps = []
    for image in evidence:
        confident, points = Matches.stack([image.reliable]), Matches.stack([image.points])
        target = confident if points is None else with_points(confident, points)
        if target is None:
            return None
        height, width = image_size(image.left_01)
        factor = min(1.0, PROMPT_LONG_EDGE / max(height, width))
        size = max(1, round(height * factor)), max(1, round(width * factor))
        median = 1.0 / target.inverse_depth[target.confidence > 0].median()
        flat, left = median.expand(1, 1, height, width), image.left_01[None]
        error = prior_error(flat, target, left, config=config)
        depth_m, _, _ = fit_depth(flat, target, left, error, config=config)
        maps.append(F.interpolate(depth_m, size, mode="bilinear", antialias=True))
    return torch.cat(maps)


class GuidedRun:
    """State of one guided call, whose stock arguments are ``call``, with ``rounds`` in each denoising step.

    ``held``, the locks of the call, are released while the ``callback`` runs.
    """

    def __init__(
        self,
        pipe: Any,
        prior: DepthPrior,
        guidance: GeometryGuidance,
        evidence: list[Evidence],
        call: Mapping[str, Any],
        grid: ProcessingGrid,
        rounds: int,
        callback: StepCallback | None = None,
        tiny: Any | None = None,
        held: hooks.Exclusive | None = None,
    ) -> None:
        self.pipe, self.prior, self.config, self.evidence = pipe, prior, guidance.config, evidence
        self.owners = [i for i in range(len(evidence)) for _ in range(call["ensemble_size"])]
        self.batch_size, self.grid = call["batch_size"], grid
        self.schedule: Schedule | None = None
        self.trajectories: list[Trajectory] = []  # one per chunk
        self.relative: list[Tensor] = []  # decoded maps of the final latents, one per chunk, not padded
        self.members: list[Tensor] = []  # of every image with an ensemble, (E, 1, H, W) metres, not padded
        self._plan, self._rounds = guidance.updates, rounds
        self._callback, self._held = callback, held
        self._reads_latents = call["output_latent"] or callback is not None
        self._codec = MapCodec(pipe, prior, grid, tiny)
        self._step = 0
        self._timesteps: list[float] = []
        self._shown: Tensor | None = None  # relative map of the chunk's latest evaluation
        self._results: list[Tensor | None] = []  # of every chunk, the map that its output starts from
        self._ends_m: list[tuple[Tensor, Tensor]] = []  # nearest and farthest of the final maps of a chunk
        self._stack, self._bar = ExitStack(), None
        self._tap = None
        if guidance.through_network and prior.network_input is not None:
            self._tap = hooks.DenoiserTap(*prior.network(), prior.network_input)
        self._scheduler = hooks.GuidedScheduler(pipe, self, self.config.respace)

    def __enter__(self) -> GuidedRun:
        with ExitStack() as stack:
            stack.enter_context(hooks.frozen_weights(self.pipe))
            stack.enter_context(hooks.images_in_float32(self.pipe.image_processor))
            if self._tap is not None:
                stack.enter_context(self._tap.attached())
            stack.enter_context(self._scheduler.attached())
            # Tells the pipeline's decoding and ensembling that they are guided.
            stack.enter_context(hooks.replaced(self.pipe, "_guided_run", self))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def release(self) -> None:
        """Close the bar, and break the reference cycle with the hooks, which would keep device memory."""
        if self._bar is not None:
            self._bar.close()
        self._scheduler.release()
        del self._scheduler

    @contextmanager
    def _suspended(self) -> Iterator[None]:
        """Remove the hooks while a callback runs, so that it may call or save the pipeline."""
        assert self._held is not None  # a callback comes with the lock
        self._stack.close()
        try:
            with self._held.given_back():
                yield
        finally:
            self.__enter__()

    def metric_prediction(self, latents: Tensor) -> Tensor:
        """Metric depth ``(B, 1, H, W)`` of the next chunk of final latents, on the padded processing grid."""
        chunk = len(self.relative)
        trajectory, x = self.trajectories[chunk], self._results[chunk]
        if x is None:  # otherwise skip decoding, which adds the autoencoder's loss
            x = self.prior.decode(latents[:, self.prior.depth_channels]).float()
        x = self.grid.padded(x)
        self.relative.append(self.grid.cropped(x))
        trajectory.note("the map of the final latent", x)
        depth_m = trajectory.metric(x, trajectory.affine)
        self._ends_m.append((depth_m.amin((1, 2, 3), keepdim=True), depth_m.amax((1, 2, 3), keepdim=True)))
        return depth_m

    def within_range(self, depth_m: Tensor, image: int | None = None) -> Tensor:
        """Clamp maps of all images, or of one image's members, to their range before resizing (overshoot)."""
        samples = [i for i, owner in enumerate(self.owners) if image in (None, owner)]
        near_m, far_m = (
            torch.cat(ends).to(depth_m)[samples].view(len(depth_m), -1, 1, 1)
            for ends in zip(*self._ends_m, strict=True)
        )
        return depth_m.clamp_(near_m.amin(1, keepdim=True), far_m.amax(1, keepdim=True))

    def samples_of(self, image: int) -> list[tuple[Trajectory, int]]:
        """The samples of an image, each as its trajectory and its index there."""
        return [(t, i) for t in self.trajectories for i, owner in enumerate(t.owners) if owner == image]

    def kept_and_error(self, image: int, member: int | None = None) -> tuple[Tensor | None, Tensor | None]:
        """``Trajectory.kept`` and the ``local_error`` of one member, or their means over all members.

        ``(1, 1, h, w)`` each, ``None`` where not measured.
        """
        samples = self.samples_of(image)
        chosen = samples if member is None else samples[member : member + 1]

        def mean(name: str) -> Tensor | None:
            values = [value[i].float() for t, i in chosen if (value := getattr(t, name)) is not None]
            return torch.stack(values).mean(0, keepdim=True) if values else None

        return mean("kept"), local_error(mean("error"), mean("valid"))

    def prior_error(self) -> Tensor | None:
        """Error of the prior in log depth; ``None`` unless ``kept_and_error`` has it for every image."""
        errors = [self.kept_and_error(i)[1] for i in range(len(self.evidence))]
        known = [error for error in errors if error is not None]
        return torch.cat(known) if len(known) == len(errors) else None

    def check_finite(self) -> None:
        """Raise ``InputError`` on the first tensor of the loop that was not finite; once, after the loop."""
        for trajectory in self.trajectories:
            trajectory.watch.check(self.pipe.dtype)

    def begin(self, timesteps: Tensor) -> None:
        """Start the trajectory of the next chunk, with its timesteps on the CPU."""
        first = len(self.trajectories) * self.batch_size
        chunk = slice(first, first + self.batch_size)
        plan, prior, metres = self._plan, self.prior, self.prior.metric_range
        self.trajectories.append(
            Trajectory(
                self.config,
                self.evidence,
                self.owners[chunk],
                prior.space,
                step_latents=plan.step_latents,
                prior_range=None if metres is None else (metres[chunk, 0], metres[chunk, 1]),
                valid=None if prior.valid is None else prior.valid[chunk],
            )
        )
        self._results.append(None)
        self._step, self._timesteps, self._shown = 0, timesteps.tolist(), None
        if self.schedule is None:
            encodes, count = self._tap is None, len(timesteps)
            self.schedule = make_schedule(self.config, plan, count, rounds=self._rounds, encodes=encodes)
            options = {"desc": "guided steps", **getattr(self.pipe, "_progress_bar_config", {})}
            chunks = -(-len(self.owners) // self.batch_size)
            self._bar = tqdm(total=chunks * len(timesteps), **options)

    def guide(self, output: Tensor, timestep: Tensor, z_t: Tensor) -> StepInputs:
        """Guide one step: what the scheduler's step gets instead of ``output`` and ``z_t (B, C, h, w)``."""
        trajectory, schedule = self.trajectories[-1], self.schedule
        assert schedule is not None  # of begin
        trajectory.step = self._step, self._timesteps[self._step]
        level, is_last = noise_level(self.pipe.scheduler, timestep), schedule.is_last(self._step)
        latent_is_read = self._reads_latents or not is_last
        estimate = StepEstimate(self._codec, level, output, z_t, self._tap, latent_is_read)
        if self._step == 0:
            trajectory.note("the prior's output", estimate.output)
        inputs: StepInputs = output, z_t, None  # unchanged, for the stock step bit for bit
        self._results[-1] = None
        if rounds := schedule.steps[self._step]:
            with torch.autocast(z_t.device.type, enabled=False):  # bfloat16 cannot tell column 761 from 762
                move, self._shown, is_current = guided_step(trajectory, estimate, rounds, is_last)
            # The map of a tiny decoder is not the result.
            if is_current and (self._codec.tiny is None or not latent_is_read):
                self._results[-1] = self._shown
            if schedule.moves_at(self._step):
                inputs = estimate.step_inputs(move, self.config.step_from == "updated")
        if self._tap is not None:
            self._tap.release()
        return inputs

    def after_step(self, timestep: Tensor, latents: Tensor) -> Tensor:
        """``z_{t-1} (B, C, h, w)`` as the callback leaves it, after the scheduler's step."""
        if self._callback is not None:
            values = {"latents": latents, **self._seen_by_callback(latents)}
            before = latents.clone()
            with self._suspended():
                answer = self._callback(self.pipe, self._step, timestep, values)
            latents = _latents_of(answer, latents)
            if not torch.equal(latents, before):  # replaced, or changed in place
                self._results[-1] = None
        self._step += 1
        if self._bar is not None:
            history = self.trajectories[-1].history
            loss = history[-1].loss if history else None
            # Reading from a GPU would wait for it.
            if loss is not None and not self._bar.disable and loss.device.type == "cpu":
                self._bar.set_postfix(loss=f"{float(loss.mean()):.4f}", refresh=False)
            self._bar.update()
        return latents

    def _seen_by_callback(self, latents: Tensor) -> dict[str, Tensor | None]:
        trajectory, x = self.trajectories[-1], self._shown
        if x is None:  # steps before the first correction are not guided
            return dict.fromkeys(("metric_depth", "loss", "scale", "shift"))
        if self._step == len(self._timesteps) - 1:
            x = self._codec.decode(latents[:, self.prior.depth_channels], final=True)
        return {
            "metric_depth": trajectory.metric(x, trajectory.affine),
            "loss": trajectory.history[-1].loss,
            "scale": trajectory.affine.scale,
            "shift": trajectory.affine.shift,
        }


def _latents_of(answer: Any, latents: Tensor) -> Tensor:
    """The latents that a callback returned, checked; ``latents`` where it returned none."""
    name = "the answer of callback_on_step_end"
    cure = "Return callback_kwargs, or nothing to leave the latents as they are."
    if answer is None:
        return latents
    if not isinstance(answer, Mapping):
        bad_type(name, "a dict or None", answer, cure)
    answered = answer.get("latents", latents)
    shape = tuple(answered.shape) if isinstance(answered, Tensor) else type(answered).__name__
    if shape != tuple(latents.shape):
        bad_value(f"latents in {name}", f"a tensor of shape {tuple(latents.shape)}", f"{shape}", cure)
    answered = answered.to(latents)
    if not answered.isfinite().all():
        bad_value(f"latents in {name}", "finite", "NaN or infinity", cure)
    return answered
