"""Methods that call the prior plainly or guide it, each by one preset (paper Algorithm 1, S5.1, S5.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from geodiff_plugin.config import DEFAULT, PAPER, PRIOR_FIT, GuidanceConfig, config_from_text
from geodiff_plugin.evaluation.baselines.base import (
    Method,
    NotApplicable,
    Prediction,
    PriorCache,
    Settings,
    folder_fingerprint,
)
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import find_adapter
from geodiff_plugin.runtime.checks import needs_network

__all__ = [
    "GUIDED_METHODS",
    "Preset",
    "call_arguments",
    "default_variant",
    "guided_configuration",
    "guided_method",
    "guided_prediction",
    "paper_variant",
    "posed_views",
    "prior_space",
]

Preset = Callable[[Any, Any, Any], GeometryGuidance]


def call_arguments(settings: Settings) -> dict[str, Any]:
    """Keywords of the pipeline call that ``settings`` decide, seeded afresh."""
    arguments: dict[str, Any] = {
        "ensemble_size": settings.ensemble,
        "generator": torch.Generator(settings.device).manual_seed(settings.seed),
    }
    if settings.steps is not None:
        arguments["num_inference_steps"] = settings.steps
    if settings.resolution is not None:
        arguments["processing_resolution"] = settings.resolution
    return arguments


def prior_space(pipe: Any) -> str:
    """Space in which the prior's output is affine, as its adapter says."""
    return find_adapter(pipe)(pipe).space


def _summary(out: Any) -> dict[str, Any]:
    """Scale, shift and visibility of a guided result, as JSON values."""
    notes: dict[str, Any] = {"warnings": list(out.warnings)}
    for name in ("scale", "shift", "global_scale"):
        values = getattr(out, name)
        if values is not None:
            notes[name] = [round(float(value), 6) for value in values.flatten()]
    if out.poses:
        notes["pose"] = out.poses[0].status
        notes["residual_px_given"] = [round(px, 3) for px in out.poses[0].residual_px_given]
        notes["residual_px"] = [round(px, 3) for px in out.poses[0].residual_px]
    if out.visible is not None:
        notes["visible"] = round(float(np.mean(out.visible)), 4)
    return notes


def guided_prediction(
    pipe: Any, sample: StereoSample, guidance: GeometryGuidance, arguments: dict[str, Any]
) -> Prediction:
    """The answer of one guided call.

    Args:
        pipe: a pipeline with guidance enabled.
        sample: its left image is asked for.
        guidance: made for it.
        arguments: of the call, as ``call_arguments`` gives them.
    """
    spread = arguments.get("ensemble_size", 1) > 1
    out = pipe(Image.fromarray(sample.left), guidance=guidance, output_uncertainty=spread, **arguments)
    return Prediction(
        depth_m=out.prediction[0, ..., 0],
        space=prior_space(pipe),
        uncertainty=None if out.uncertainty is None else out.uncertainty[0, ..., 0],
        confidence=None if out.confidence is None else out.confidence[0, ..., 0],
        notes=_summary(out),
    )


def guided_configuration(preset: Preset, settings: Settings) -> dict[str, Any]:
    """Every hyperparameter of a preset and every setting but the prior, as JSON values.

    A decoder in a folder counts by its files as well: one that was trained further keeps its name.
    """
    any_camera = np.array([[32.0, 0, 16], [0, 32.0, 16], [0, 0, 1]])
    to_the_right = np.eye(4)
    to_the_right[0, 3] = 0.1
    guidance = preset(np.zeros((32, 32, 3), np.uint8), any_camera, to_the_right)
    chosen = {key: value for key, value in asdict(settings).items() if key != "prior"}
    if decoder := folder_fingerprint(Path(guidance.config.decoder)):
        chosen["decoder_files"] = decoder
    return chosen | {"guidance": guidance.as_run().to_dict()}


def posed_views(sample: StereoSample, views: int) -> tuple[Any, Any, Any]:
    """``(right, K, E)`` of a sample as ``GeometryGuidance`` takes them.

    Args:
        sample: of two views or more.
        views: the most to take, the left one counted; a sample that has fewer gives all it has.
    """
    more = sample.extra_views[: views - 2]
    if not more:
        return sample.right, (sample.K_left, sample.K_right), sample.E
    images, Ks, Es = zip((sample.right, sample.K_right, sample.E), *more, strict=True)
    return images, (sample.K_left, *Ks), (np.eye(4), *Es)


def guided_method(name: str, title: str, summary: str, preset: Preset) -> Method:
    """A method that guides the prior under one preset.

    Args:
        name: key in ``METHODS``.
        title: column heading.
        summary: one sentence.
        preset: ``(right, K, E)`` -> guidance.

    Returns:
        The method; its configuration is ``guided_configuration``. It does not apply where it takes gradients
        through a network that does not see z_t.
    """

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        guidance, pipe = preset(*posed_views(sample, settings.views)), priors.get(settings)
        guidance.evidence_store = priors.evidence
        guidance.measured_baseline = guidance.measured_baseline or sample.measured_baseline
        if needs_network(guidance) and find_adapter(pipe)(pipe).network_input is None:
            raise NotApplicable("no gradient to z_t, which this prior's network does not see")
        return guided_prediction(pipe, sample, guidance, call_arguments(settings))

    return Method(name, title, summary, run, partial(guided_configuration, preset), uses_prior=True)


def _run_plain(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    """The paper's row "Marigold": an oracle aligns what comes out."""
    pipe = priors.get(settings)
    out = pipe(Image.fromarray(sample.left), **call_arguments(settings))
    return Prediction(depth_m=None, relative=out.prediction[0, ..., 0], space=prior_space(pipe))


def _plain_configuration(settings: Settings) -> dict[str, Any]:
    return {key: value for key, value in asdict(settings).items() if key != "prior"}


def _changed(**leaves: Any) -> Preset:
    """The default preset with some knobs changed."""
    return partial(GeometryGuidance, **leaves)


GUIDED_METHODS = (
    Method(
        "prior-aligned",
        "prior + oracle",
        "the stock pipeline, scale and shift by least squares against the truth",
        _run_plain,
        _plain_configuration,
        uses_prior=True,
    ),
    *(
        guided_method(*row)
        for row in (
            (
                "search-only",
                "search only",
                "the search for the scale alone: no correction, no gradient updates, no refinement",
                GeometryGuidance.search_only,
            ),
            (
                "scale-shift-only",
                "scale, shift",
                "the default preset on scale and shift only",
                _changed(optimize_latents=False, refine=False),
            ),
            ("paper", "paper", "the prior guided with the paper's own numbers", GeometryGuidance.paper),
            (
                "prior-fit",
                "prior fit",
                "a plain call, fitted to the matches and refined once: no guided step",
                _changed(config=PRIOR_FIT),
            ),
            ("guided", "guided", "the prior guided with the default preset", GeometryGuidance),
            (
                "photometric-only",
                "photometric",
                "the default preset without matches",
                _changed(weights={**DEFAULT.weights, "matches": 0.0}),
            ),
            (
                "matches-only",
                "matches",
                "the default preset without the photometric error",
                _changed(weights={**DEFAULT.weights, "photometric": 0.0}),
            ),
        )
    ),
)


def _variant(base: str, preset: GuidanceConfig, text: str) -> Method:
    config = config_from_text(text.split("+"), preset, "methods")
    title = f"{base}, {text.replace('+', ', ')}"
    return guided_method(
        f"{base}:{text}", title, f"{base} with {text}", partial(GeometryGuidance, config=config)
    )


def _estimated(name: str) -> Method:
    """The default preset with the poses withheld but for the length of the first baseline."""

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        more = sample.extra_views[: settings.views - 2]
        try:
            guidance = GeometryGuidance.from_photographs(
                [sample.left, sample.right, *(image for image, _, _ in more)],
                K=[sample.K_left, sample.K_right, *(K for _, K, _ in more)],
                baseline_m=float(np.linalg.norm(sample.E[:3, 3])),
            )
        except ValueError as error:
            raise NotApplicable(f"no pose could be estimated ({error})") from error
        return guided_prediction(priors.get(settings), sample, guidance, call_arguments(settings))

    summary = "the prior guided with the default preset, poses estimated from the photographs"
    configuration = partial(guided_configuration, GeometryGuidance)
    return Method(f"guided:{name}", "guided, poses estimated", summary, run, configuration, uses_prior=True)


def default_variant(text: str) -> Method:
    """The default preset with some knobs changed.

    Args:
        text: ``knob=value``, several joined by ``+``; ``weights.matches=0`` changes one weight,
            ``pose=estimated`` withholds the poses.

    Raises:
        InputError: another form, an unknown knob, or a value that it cannot have.
    """
    if text == "pose=estimated":
        return _estimated(text)
    return _variant("guided", DEFAULT, text)


def paper_variant(text: str) -> Method:
    """Algorithm 1 as printed with some knobs changed; argument and errors as ``default_variant``."""
    return _variant("paper", PAPER, text)
