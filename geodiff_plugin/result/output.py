"""``ImageResult`` of every image, stacked once into ``MetricDepthOutput``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._certain import SD_PER_MAD
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.estimate import NO_UNIT
from geodiff_plugin.result.finish import ImageResult
from geodiff_plugin.result.indicators import pose_of, warnings_of
from geodiff_plugin.scale.space import joined
from geodiff_plugin.types import MetricDepthOutput, StepReport

#: The user is warned if the visible share is below this: few pixels then determine the scale.
LITTLE_OVERLAP = 0.3
#: Fields of ``ImageResult`` that are maps.
MAPS = ("depth_m", "uncertainty", "relative", "visible", "photometric_error", "confidence", "support")


def stack_results(
    results: Sequence[ImageResult],
    guidance: GeometryGuidance,
    history: Sequence[StepReport],
    *,
    remarks: Sequence[Message] = (),
    extras: Mapping[str, Tensor] | None = None,
    as_numpy: bool = True,
) -> MetricDepthOutput:
    """``MetricDepthOutput`` without ``latent``, of the results of all images of a call.

    ``history`` are the reports of its steps, ``remarks`` warnings that say nothing about one image alone,
    and ``extras`` further maps of the prior.
    """
    over_prior = _together(results, "over_prior")
    maps: dict[str, Any] = {name: _together(results, name) for name in MAPS}
    further: dict[str, Any] = dict(extras or {})
    numbers: Mapping[str, Tensor | None] = _numbers(results, over_prior)
    if as_numpy:
        numbers, maps, further = to_host(numbers, maps, further)
        maps, further = _as_arrays(maps), _as_arrays(further)
    else:
        (numbers,) = to_host(numbers)
    K = torch.stack([result.K for result in results])
    poses, estimated = [pose_of(result.evidence) for result in results], guidance.estimated
    output = MetricDepthOutput(
        prediction=maps.pop("depth_m"),
        **maps,
        scale=numbers["scale"],
        shift=numbers["shift"],
        global_scale=numbers["global_scale"],
        prior_scale=numbers.get("prior_scale"),
        prior_error=numbers.get("prior_error"),
        K=K.numpy() if as_numpy else K.to(results[0].depth_m.device),
        history=list(history),
        poses=[pose for pose in poses if pose is not None],
        extras=further,
        verdicts=[result.verdict for result in results],
        unit=guidance.unit,
        warnings=[*_warnings(results), *(() if estimated is None else estimated.warnings), *remarks],
        assumed=list(guidance.assumed),
    )
    if estimated is not None:
        output.scale_from, output.scale_spread = estimated.scale.source, estimated.scale.spread
    if guidance.unit is None and over_prior is not None:
        return _in_the_priors_metres(output, over_prior)
    return output


def _together(results: Sequence[ImageResult], name: str) -> Tensor | None:
    """What every image has, along the first axis, a single one not copied; ``None`` if one has none."""
    given = [each for result in results if (each := getattr(result, name)) is not None]
    if len(given) < len(results):
        return None
    return joined(given)


def _numbers(results: Sequence[ImageResult], over_prior: Tensor | None) -> dict[str, Tensor]:
    """Numbers of every image and member, by their names in ``MetricDepthOutput``, on their device."""
    names = ("scale", "shift", "global_scale")
    numbers = {name: torch.stack([getattr(result, name) for result in results]) for name in names}
    if over_prior is not None:
        numbers["prior_scale"] = over_prior.median(1).values.view(len(results), -1)
    prior_error = _together(results, "prior_error")
    if prior_error is not None:
        numbers["prior_error"] = prior_error.amin((1, 2, 3))
    return numbers


def _as_arrays(maps: Mapping[str, Tensor | None]) -> dict[str, np.ndarray | None]:
    """Maps ``(N, C, H, W)`` as arrays with the channels last."""
    return {name: None if x is None else x.permute(0, 2, 3, 1).numpy() for name, x in maps.items()}


def to_host(*groups: Mapping[str, Tensor | None]) -> list[dict[str, Tensor | None]]:
    """Tensors on the CPU; those of a CUDA device are all copied before it is waited for, once."""
    given = [x for group in groups for x in group.values() if x is not None]
    # Elsewhere a copy that is not waited for would be read too early.
    copies = [
        {name: None if x is None else x.to("cpu", non_blocking=x.is_cuda) for name, x in group.items()}
        for group in groups
    ]
    for device in {x.device for x in given if x.is_cuda}:
        torch.cuda.current_stream(device).synchronize()
    return copies


def _in_the_priors_metres(output: MetricDepthOutput, over_prior: Tensor) -> MetricDepthOutput:
    """Convert an output without a unit to the metres of a metric prior."""
    factor = 1.0 / float(over_prior.median())
    spread = SD_PER_MAD * float((over_prior * factor).clamp_min(1e-9).log().abs().median())

    def moved(E: np.ndarray) -> np.ndarray:
        return np.block([[E[:3, :3], factor * E[:3, 3:]], [E[3:]]])

    warning = Message(
        "scale.from-prior",
        "No length is known: the metres are the prior's own, with its errors. Its depth and the depth from "
        f"the views differ by {100 * spread:.0f} % in the median.",
    )
    output.prediction = output.prediction * factor
    output.uncertainty = None if output.uncertainty is None else output.uncertainty * factor
    for name in ("global_scale", "prior_scale"):
        setattr(output, name, getattr(output, name) * factor)
    output.history = [replace(step, g_s=step.g_s * factor) for step in output.history]
    output.poses = [
        replace(pose, E=tuple(map(moved, pose.E)), E_given=tuple(map(moved, pose.E_given)))
        for pose in output.poses
    ]
    output.unit, output.scale_from, output.scale_spread, output.rescaled = "m", "prior", spread, factor
    output.warnings = [m for m in output.warnings if m.code != NO_UNIT.code] + [warning]
    return output


def image_labels(count: int) -> list[str]:
    """What a sentence about each of so many images begins with."""
    return [""] if count == 1 else [f"Image {i}: " for i in range(1, count + 1)]


def _warnings(results: Sequence[ImageResult]) -> list[Message]:
    """Messages about every image, each with its label."""
    labelled = zip(image_labels(len(results)), results, strict=True)
    return [message.labelled(label) for label, result in labelled for message in _messages(result)]


def _messages(result: ImageResult) -> list[Message]:
    """Messages about one image: its verdict, how little of it is seen, and what its evidence warns of."""
    verdict = result.verdict
    messages = [] if verdict.message is None else [verdict.message]
    messages += verdict.remarks
    share = result.visible_share
    if share < LITTLE_OVERLAP:
        sentence = (
            f"Only {share:.0%} of the left image is seen by a right camera at this depth; "
            "few pixels determine the scale."
        )
        messages.append(Message("views.overlap", sentence))
    # Mistakes of a pose are reasons of the verdict already.
    return messages + [message for message in warnings_of(result.evidence) if not message.forbids_trust]
