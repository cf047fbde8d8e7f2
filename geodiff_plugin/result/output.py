"""``MetricDepthOutput``, into which the ``ImageResult`` of every image is stacked once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from diffusers.utils import BaseOutput
from torch import Tensor

from geodiff_plugin._certain import SD_PER_MAD
from geodiff_plugin._reprojection import PosedCamera, depth_in_camera
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.estimate import NO_UNIT
from geodiff_plugin.result.finish import ImageResult
from geodiff_plugin.result.indicators import pose_of, warnings_of
from geodiff_plugin.scale.space import joined
from geodiff_plugin.types import PoseReport, StepReport, Verdict

#: The user is warned if the visible share is below this: few pixels then determine the scale.
LITTLE_OVERLAP = 0.3
#: Fields of ``ImageResult`` that are maps.
MAPS = ("depth_m", "uncertainty", "relative", "visible", "photometric_error", "confidence", "support")


@dataclass
class MetricDepthOutput(BaseOutput):
    """Metric depth with confidence, diagnostics and warnings.

    ``N`` images, ``E`` ensemble members, ``H W`` the resolution of the input image (or of the processing grid
    with ``match_input_resolution=False``). Maps are shaped as ``prediction`` unless said otherwise.

    Attributes:
        prediction: metres; ``(N, H, W, 1)`` numpy or ``(N, 1, H, W)`` torch, as ``output_type`` says.
        uncertainty: metres, median absolute deviation of the ensemble members, each refined like
            ``prediction``; ``None`` without ``output_uncertainty=True``, or with fewer than two members.
        latent: ``(N * E, 4, h, w)`` final latents, with ``output_latent=True``.
        relative: median unclipped relative depth, about [0, 1].
        scale: ``(N, E)`` softplus of the learnt scale.
        shift: ``(N, E)`` softplus of the learnt shift.
        global_scale: ``(N, E)`` metres, the pre-selected g_s of Eq. 16.
        prior_scale: ``(N, E)`` median factor from a metric prior's metres to the result, else ``None``.
        visible: boolean, in front of a right camera and inside its image; ``None`` without a right view.
        photometric_error: [0, 1] mean absolute difference between the left image and the warped right view
            that matches the pixel best; 0 where not visible; ``None`` without a right view.
        confidence: [0, 1] probability that the depth is within 10 % of the truth, 0 where there is no depth
            (``valid``); ``None`` without ``crisp``, or without matches and points.
        support: [0, 1] how much matches and points, at the pixel or nearby on the same surface, determine the
            depth; ``None`` where ``confidence`` is.
        prior_error: ``(N,)`` error of the prior alone, standard deviation in log depth, estimated from
            left-out matches or points; ``None`` where none were compared.
        K: ``(N, 3, 3)`` intrinsics of the output grid, pixels.
        history: one ``StepReport`` per round of a guided step and batch chunk.
        poses: one ``PoseReport`` per image with right views.
        extras: further maps of the prior by name (GeoWizard's ``"normals"``), but for their channels.
        verdicts: one ``Verdict`` per image: whether the depth can be trusted, and why not.
        unit: ``"m"``, or ``None`` if no length is known: lengths are then in the unit of the given poses, or
            of the first estimated baseline.
        scale_from: source of the scale of estimated poses: ``"baseline"``, ``"known length"``, ``"points"``,
            ``"prior"`` or ``"none"``; ``None`` for given poses, but ``"prior"`` where they had no unit.
        scale_spread: relative spread of that scale over matches or the prior's map; ``None`` if unknown.
        rescaled: factor from the lengths of ``GeometryGuidance`` to metres, if only the prior knows the unit.
        warnings: sentences for the user about this result, and those that the guidance gave when it was made;
            each has a ``code`` (``geodiff_plugin.messages``, docs/reference/messages.md).
        assumed: likewise on assumed inputs, such as the right camera's principal point.
    """

    prediction: np.ndarray | torch.Tensor
    uncertainty: np.ndarray | torch.Tensor | None = None
    latent: torch.Tensor | None = None
    relative: np.ndarray | torch.Tensor | None = None
    scale: torch.Tensor | None = None
    shift: torch.Tensor | None = None
    global_scale: torch.Tensor | None = None
    prior_scale: torch.Tensor | None = None
    visible: np.ndarray | torch.Tensor | None = None
    photometric_error: np.ndarray | torch.Tensor | None = None
    confidence: np.ndarray | torch.Tensor | None = None
    support: np.ndarray | torch.Tensor | None = None
    prior_error: torch.Tensor | None = None
    K: np.ndarray | torch.Tensor | None = None
    history: list[StepReport] = field(default_factory=list)
    poses: list[PoseReport] = field(default_factory=list)
    unit: str | None = "m"
    scale_from: str | None = None
    scale_spread: float | None = None
    rescaled: float = 1.0
    extras: dict[str, np.ndarray | torch.Tensor] = field(default_factory=dict)
    verdicts: list[Verdict] = field(default_factory=list)
    warnings: list[Message] = field(default_factory=list)
    assumed: list[Message] = field(default_factory=list)

    @property
    def verdict(self) -> Verdict:
        """The verdict on all images: the first that is not trusted, else not judged, else trusted."""
        if not self.verdicts:
            raise AttributeError("This output has no verdict: no guided call made it.")
        return min(self.verdicts, key=lambda v: ("not trusted", "not judged", "trusted").index(v.status))

    @property
    def valid(self) -> np.ndarray | torch.Tensor:
        """Boolean, shaped as ``prediction``: where there is a depth.

        Further away than the cameras can measure, where the views differ by less than 0.3 px, as in a sky,
        there is none: ``prediction`` is that distance there, so that it can be shown, and ``confidence`` 0.
        Clouds, meshes and other exports leave such pixels out.
        """
        positive = self.prediction > 0
        return positive if self.confidence is None else positive & (self.confidence > 0)

    def into(self, K: np.ndarray, E: np.ndarray, size: tuple[int, int]) -> np.ndarray | torch.Tensor:
        """The depth as another camera sees it: of an infrared pair in the colour camera, say.

        Where several surfaces lie behind a pixel the nearest counts. Between the pixels of one surface, which
        the prior makes dense, there are no holes. What the left camera does not see has no depth, 0, nor has
        what is not ``valid``.

        Args:
            K: ``(3, 3)`` pixels of that camera's image, without lens distortion.
            E: ``(4, 4)`` pose of that camera in the left camera's frame, in the output's unit.
            size: ``(width, height)`` of its image.

        Returns:
            Depth along z of that camera, shaped as ``prediction``: ``(N, height, width, 1)`` numpy or ``(N,
            1, height, width)`` torch, float32.

        Raises:
            InputError: a K, E or size that is none.
        """
        camera = PosedCamera.checked(K, E, size)
        if self.K is None:
            raise AttributeError("This output has no K: no guided call made it.")
        Ks = self.K if isinstance(self.K, np.ndarray) else self.K.numpy(force=True)
        known = self.prediction * self.valid
        depths = known[..., 0] if isinstance(known, np.ndarray) else known[:, 0].numpy(force=True)
        pairs = zip(depths, Ks.astype(np.float64), strict=True)
        seen = np.stack([depth_in_camera(depth, K_left, camera) for depth, K_left in pairs])
        if isinstance(self.prediction, np.ndarray):
            return seen[..., None]
        return torch.from_numpy(seen[:, None]).to(self.prediction.device)

    def __repr__(self) -> str:
        """Sizes, range and verdict in a few lines, and no array."""
        depth = self.prediction
        depth = depth if isinstance(depth, np.ndarray) else depth.numpy(force=True)
        unit = "" if self.unit is None else f" {self.unit}"
        lines = [f"depth {depth.shape}, {np.nanmin(depth):.3g} to {np.nanmax(depth):.3g}{unit}"]
        lines += [": ".join([verdict.status, *verdict.reasons[:1]]) for verdict in self.verdicts]
        lines += [f"{len(self.warnings)} warnings", f"{len(self.assumed)} assumptions"]
        return "MetricDepthOutput(" + "\n  ".join(lines) + ")"


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
