"""``MetricDepthOutput``, and how the ``ImageResult`` of every image is stacked into it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from diffusers.utils import BaseOutput
from torch import Tensor

from geodiff_plugin._internal.camera_checks import check_posed_camera
from geodiff_plugin._internal.statistics import SD_PER_MAD
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.findings import Finding, dedupe
from geodiff_plugin.pose.estimate import NO_UNIT
from geodiff_plugin.result.finish import ImageResult
from geodiff_plugin.result.readings import Reprojected, reproject
from geodiff_plugin.result.sigma import depth_sigma, geometric_sigma
from geodiff_plugin.scale.space import cat_samples
from geodiff_plugin.trust import Verdict
from geodiff_plugin.types import PoseReport, StepReport

#: Fields of ``ImageResult`` that are maps.
MAPS = ("depth_m", "uncertainty", "relative", "visible", "photometric_error", "confidence", "support")


@dataclass
class MetricDepthOutput(BaseOutput):
    """Metric depth with confidence, diagnostics and warnings.

    ``N`` images, ``E`` ensemble members, ``H W`` the resolution of the input image (or of the processing grid
    with ``match_input_resolution=False``). Maps have the shape of ``prediction`` unless stated otherwise.

    Attributes:
        prediction: metres; ``(N, H, W, 1)`` numpy or ``(N, 1, H, W)`` torch, depending on ``output_type``.
        uncertainty: metres, median absolute deviation of the ensemble members, each refined like
            ``prediction``; ``None`` without ``output_uncertainty=True`` or with fewer than two members.
        latent: ``(N * E, 4, h, w)`` final latents, with ``output_latent=True``.
        relative: median unclipped relative depth, about [0, 1].
        scale: ``(N, E)`` softplus of the learnt scale.
        shift: ``(N, E)`` softplus of the learnt shift.
        global_scale: ``(N, E)`` metres, the pre-selected g_s of Eq. 16.
        prior_scale: ``(N, E)`` median factor from a metric prior's metres to the result, else ``None``.
        visible: boolean, in front of a right camera and inside its image; ``None`` without a right view.
        photometric_error: [0, 1] mean absolute difference between the left image and the warped right view
            that matches the pixel best; 0 where not visible; ``None`` without a right view.
        confidence: [0, 1] probability that the depth is within 10 % of ground truth, given correct
            calibration; 0 where there is no depth (``valid``); ``None`` without ``refine_edges``, or without
            matches and points.
        support: [0, 1] data support: how far matches and points at the pixel, or nearby on the same surface,
            determine the depth; ``None`` if ``confidence`` is.
        prior_error: ``(N,)`` error of the prior alone, standard deviation in log depth, estimated from
            held-out matches or points; ``None`` if none were compared.
        measurable_m: ``(N,)`` metres, the farthest depth that the views or points can measure, where the
            standard error of a good match is 10 %; ``None`` without a right view.
        K: ``(N, 3, 3)`` intrinsics of the output grid, pixels.
        history: one ``StepReport`` per round of a guided step and batch chunk.
        poses: one ``PoseReport`` per image with right views.
        extras: further maps of the prior by name (GeoWizard's ``"normals"``), shaped like ``prediction``
            except for their channels.
        verdicts: one ``Verdict`` per image: whether the depth can be trusted, and the reasons if not. Trusted
            means that no inconsistency was found; it is not a guarantee.
        unit: ``"m"``, or ``None`` if no length is known: lengths are then in the unit of the given poses, or
            of the first estimated baseline.
        scale_from: source of the scale of estimated poses: ``"baseline"``, ``"known length"``, ``"points"``,
            ``"prior"`` or ``"none"``; ``None`` for given poses, but ``"prior"`` if they had no unit.
        scale_rel_std: relative standard deviation of that scale over matches or the prior's map; ``None`` if
            unknown.
        rescaled: factor from the lengths of ``GeometryGuidance`` to metres, if only the prior has a unit.
        findings: messages for the user about this result and its input, each with a ``code`` and a
            ``severity`` (``geodiff_plugin.findings``, docs/reference/messages.md).
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
    measurable_m: torch.Tensor | None = None
    K: np.ndarray | torch.Tensor | None = None
    history: list[StepReport] = field(default_factory=list)
    poses: list[PoseReport] = field(default_factory=list)
    unit: str | None = "m"
    scale_from: str | None = None
    scale_rel_std: float | None = None
    rescaled: float = 1.0
    extras: dict[str, np.ndarray | torch.Tensor] = field(default_factory=dict)
    verdicts: list[Verdict] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    @property
    def verdict(self) -> Verdict:
        """The verdict on all images: the first that is not trusted, else not judged, else trusted."""
        if not self.verdicts:
            raise AttributeError("This output has no verdict: it was not made by a guided call.")
        return min(self.verdicts, key=lambda v: ("not trusted", "not judged", "trusted").index(v.status))

    @property
    def valid(self) -> np.ndarray | torch.Tensor:
        """Boolean, shaped like ``prediction``: where there is a depth.

        There is none beyond the distance that the cameras can measure, where the views differ by less than
        0.3 px, as in the sky. There ``prediction`` is that distance, so that it can be displayed, and
        ``confidence`` is 0. Clouds, meshes and other exports exclude such pixels.
        """
        positive = self.prediction > 0
        return positive if self.confidence is None else positive & (self.confidence > 0)

    @cached_property
    def sigma(self) -> np.ndarray | torch.Tensor | None:
        """Standard deviation of the depth, metres, shaped like ``prediction``; computed on first use.

        It is **conditional on a correct calibration**, as ``confidence`` is. NaN where there is no depth
        (``valid``); ``None`` if ``confidence`` is. docs/explanation/trust.md defines it.
        """
        if self.confidence is None:
            return None
        sigma_m = _sigma(self)
        if isinstance(self.prediction, np.ndarray):
            return sigma_m[..., None]
        return torch.from_numpy(sigma_m[:, None]).to(self.prediction.device)

    def reliable(
        self, min_confidence: float = 0.0, max_sigma: float | None = None
    ) -> np.ndarray | torch.Tensor:
        """Boolean, shaped like ``prediction``: where a depth is ``valid`` and passes both thresholds.

        Args:
            min_confidence: minimum ``confidence``, [0, 1].
            max_sigma: maximum ``sigma``, metres; ``None`` for any.

        A depth whose confidence or sigma is unknown does not pass a threshold for it.
        """
        kept = self.valid
        if min_confidence > 0:
            kept = kept & (self.confidence is not None and self.confidence >= min_confidence)
        if max_sigma is not None:
            kept = kept & (self.sigma is not None and self.sigma <= max_sigma)
        return kept

    def with_holes(self, min_confidence: float = 0.0, max_sigma: float | None = None) -> MetricDepthOutput:
        """Return a copy without the depths that are not ``reliable`` (same arguments).

        Depth, confidence and uncertainty are 0 there and ``sigma`` is NaN, as where a mask excludes pixels.
        """
        kept = self.reliable(min_confidence, max_sigma)
        names = ("prediction", "confidence", "uncertainty")
        maps: dict[str, Any] = {name: x * kept for name in names if (x := getattr(self, name)) is not None}
        return replace(self, **maps)

    def reproject(self, K: np.ndarray, E: np.ndarray, size: tuple[int, int]) -> Reprojected:
        """Reproject depth and sigma into another camera, such as the colour camera of an infrared pair.

        Z-buffered: the nearest surface wins. The prior makes surfaces dense, so there are no holes between
        the pixels of one surface. Points that the left camera does not see, or that are not ``valid``, have
        depth 0 and sigma NaN.

        Args:
            K: ``(3, 3)`` intrinsics in pixels of that camera's image, without lens distortion.
            E: ``(4, 4)`` pose of that camera in the left camera's frame, in the output's unit.
            size: ``(width, height)`` of its image.

        Returns:
            ``depth`` along z of that camera and its standard deviation ``sigma``, in the output's unit, both
            shaped like ``prediction``: ``(N, height, width, 1)`` numpy or ``(N, 1, height, width)`` torch,
            float32. ``sigma`` belongs to the nearest surface. It is multiplied by the change of that camera's
            depth per change of depth along the left camera's ray, about 1 for nearly parallel cameras.
            ``None`` if the output has no sigma.

        Raises:
            InputError: invalid K, E or size.
        """
        camera = check_posed_camera(K, E, size)
        if self.K is None:
            raise AttributeError("This output has no K: it was not made by a guided call.")
        return reproject(self.prediction * self.valid, self.sigma, self.K, camera)

    def __repr__(self) -> str:
        """Summarize sizes, range and verdict in a few lines, without arrays."""
        depth = self.prediction
        depth = depth if isinstance(depth, np.ndarray) else depth.numpy(force=True)
        unit = "" if self.unit is None else f" {self.unit}"
        lines = [f"depth {depth.shape}, {np.nanmin(depth):.3g} to {np.nanmax(depth):.3g}{unit}"]
        lines += [": ".join([verdict.status, *verdict.reasons[:1]]) for verdict in self.verdicts]
        lines += [f"{len(self.findings)} findings"]
        return "MetricDepthOutput(" + "\n  ".join(lines) + ")"


def stack_results(
    results: Sequence[ImageResult],
    guidance: GeometryGuidance,
    history: Sequence[StepReport],
    *,
    findings: Sequence[Finding] = (),
    extras: Mapping[str, Tensor] | None = None,
    as_numpy: bool = True,
) -> MetricDepthOutput:
    """Stack the results of all images of a call into a ``MetricDepthOutput`` without ``latent``.

    ``history`` has the reports of its steps, ``findings`` those about the input, ``extras`` further maps of
    the prior.
    """
    over_prior = _stack_field(results, "over_prior")
    maps: dict[str, Any] = {name: _stack_field(results, name) for name in MAPS}
    further: dict[str, Any] = dict(extras or {})
    numbers = _numbers(results, over_prior)
    if as_numpy:
        numbers, maps, further = to_host(numbers, maps, further)
        maps, further = _as_arrays(maps), _as_arrays(further)
    else:
        (numbers,) = to_host(numbers)
    K = torch.from_numpy(np.stack([result.camera.K for result in results]))
    poses = [result.evidence.report for result in results]
    estimated = guidance.estimated
    output = MetricDepthOutput(
        prediction=maps.pop("depth_m"),
        **maps,
        **numbers,
        K=K.numpy() if as_numpy else K.to(results[0].depth_m.device),
        history=list(history),
        poses=[pose for pose in poses if pose is not None],
        extras=further,
        verdicts=[result.verdict for result in results],
        unit=guidance.unit,
        findings=list(dedupe(_findings(results), findings)),
    )
    if estimated is not None:
        output.scale_from, output.scale_rel_std = estimated.scale.source, estimated.scale.spread
    if guidance.unit is None and over_prior is not None:
        output = _in_the_priors_metres(output, over_prior)
    if guidance.makes_holes:
        return output.with_holes(guidance.min_confidence, guidance.max_sigma)
    return output


def _sigma(output: MetricDepthOutput) -> np.ndarray:
    """Compute ``output.sigma`` as ``(N, H, W)`` float32 arrays, one image after the other."""

    def on_host(values: np.ndarray | torch.Tensor) -> np.ndarray:
        return values if isinstance(values, np.ndarray) else values.numpy(force=True)

    def channel(maps: np.ndarray | torch.Tensor | None) -> Sequence[Any]:
        if maps is None:
            return [None] * len(output.prediction)
        return list(on_host(maps[..., 0] if isinstance(maps, np.ndarray) else maps[:, 0]))

    columns = map(channel, (output.prediction, output.confidence, output.uncertainty))
    sigma_m = []
    for i, (depth_m, confidence, deviation_m) in enumerate(zip(*columns, strict=True)):
        geometric_m = None
        if output.K is not None and len(output.poses) == len(output.prediction):
            K = on_host(output.K[i]).astype(np.float64)
            facts = output.verdicts[i].facts
            geometric_m = geometric_sigma(depth_m, K, output.poses[i].E, facts)
        sigma_m.append(depth_sigma(depth_m, confidence, geometric_m, deviation_m, output.scale_rel_std))
    return np.stack(sigma_m)


def _stack_field(results: Sequence[ImageResult], name: str) -> Tensor | None:
    """Concatenate a field of all images along the first axis; ``None`` if any image lacks it."""
    given = [each for result in results if (each := getattr(result, name)) is not None]
    if len(given) < len(results):
        return None
    return cat_samples(given)


def _numbers(results: Sequence[ImageResult], over_prior: Tensor | None) -> dict[str, Any]:
    """Collect the numbers of every image and member by their names in the output, on their device."""
    names = ("scale", "shift", "global_scale")
    numbers = {name: torch.stack([getattr(result, name) for result in results]) for name in names}
    if over_prior is not None:
        numbers["prior_scale"] = over_prior.nanmedian(1).values.view(len(results), -1)
    errors = [result.prior_error for result in results if result.prior_error is not None]
    if len(errors) == len(results):  # of some images one number, of others a map
        numbers["prior_error"] = cat_samples([error.amin((1, 2, 3)) for error in errors])
    ranges = [result.measurable_m for result in results if result.measurable_m is not None]
    if len(ranges) == len(results):
        numbers["measurable_m"] = cat_samples(ranges)
    return numbers


def _as_arrays(maps: Mapping[str, Tensor | None]) -> dict[str, np.ndarray | None]:
    """Convert maps ``(N, C, H, W)`` to arrays with channels last."""
    return {name: None if x is None else x.permute(0, 2, 3, 1).numpy() for name, x in maps.items()}


def to_host(*groups: Mapping[str, Tensor | None]) -> list[dict[str, Any]]:
    """Copy tensors to the CPU; all copies from a CUDA device are started before a single synchronization."""
    given = [x for group in groups for x in group.values() if x is not None]
    # On other devices an asynchronous copy could be read too early.
    copies = [
        {name: None if x is None else x.to("cpu", non_blocking=x.is_cuda) for name, x in group.items()}
        for group in groups
    ]
    for device in {x.device for x in given if x.is_cuda}:
        torch.cuda.current_stream(device).synchronize()
    return copies


def _in_the_priors_metres(output: MetricDepthOutput, over_prior: Tensor) -> MetricDepthOutput:
    """Convert an output without a unit to the metres of a metric prior."""
    factor = 1.0 / float(over_prior.nanmedian())
    spread = SD_PER_MAD * float((over_prior * factor).clamp_min(1e-9).log().abs().nanmedian())

    def rescale(E: np.ndarray) -> np.ndarray:
        return np.block([[E[:3, :3], factor * E[:3, 3:]], [E[3:]]])

    warning = Finding(
        "scale.from-prior",
        "No length is known, so the scale is the metric prior's, including its error. The prior's depth and "
        f"the depth from the views differ by {100 * spread:.0f} % (median).",
    )
    output.prediction = output.prediction * factor
    output.uncertainty = None if output.uncertainty is None else output.uncertainty * factor
    for name in ("global_scale", "prior_scale", "measurable_m"):
        value = getattr(output, name)
        setattr(output, name, None if value is None else value * factor)
    output.history = [replace(step, g_s=step.g_s * factor) for step in output.history]
    output.poses = [
        replace(pose, E=tuple(map(rescale, pose.E)), E_given=tuple(map(rescale, pose.E_given)))
        for pose in output.poses
    ]
    output.unit, output.scale_from, output.scale_rel_std, output.rescaled = "m", "prior", spread, factor
    output.findings = [each for each in output.findings if each.code != NO_UNIT.code] + [warning]
    return output


def image_labels(count: int) -> list[str]:
    """Return the prefix of messages about each of ``count`` images."""
    return [""] if count == 1 else [f"Image {i}: " for i in range(1, count + 1)]


def _findings(results: Sequence[ImageResult]) -> list[Finding]:
    """Return the findings about every image, each with its label."""
    labelled = zip(image_labels(len(results)), results, strict=True)
    return [finding.labelled(label) for label, result in labelled for finding in result.verdict.findings]
