"""Methods that run the prior without guidance, guide it, or guide a replacement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from geodiff_plugin.config import FAST, PAPER, PRIOR_FIT, GuidanceConfig, config_from_text
from geodiff_plugin.evaluation.baselines.method import (
    Method,
    NotApplicable,
    Prediction,
    PriorCache,
    Settings,
    folder_fingerprint,
)
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.options import SpeedOptions
from geodiff_plugin.priors import prior_of
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.map import DepthMapPipeline
from geodiff_plugin.runtime.guided_call import enable_geometry_guidance
from geodiff_plugin.scale.space import SPACES

#: ``(right, K, E, **changes)`` -> guidance.
Preset = Callable[..., GeometryGuidance]
Run = Callable[[StereoSample, Settings, PriorCache], Prediction]


def call_arguments(settings: Settings) -> dict[str, Any]:
    """Return the keywords of the pipeline call determined by ``settings``, with a new seeded generator."""
    generator = torch.Generator(settings.device).manual_seed(settings.seed)
    given = {"num_inference_steps": settings.steps, "processing_resolution": settings.resolution}
    arguments = {name: value for name, value in given.items() if value is not None}
    return {"ensemble_size": settings.ensemble, "generator": generator} | arguments


def _notes(out: Any) -> dict[str, Any]:
    """Return scale, shift, poses and visibility of a guided result as JSON values."""
    notes: dict[str, Any] = {"findings": [finding.as_record() for finding in out.findings]}
    for name in ("scale", "shift", "global_scale"):
        values = getattr(out, name)
        if values is not None:
            notes[name] = [round(float(value), 6) for value in values.flatten()]
    if out.poses:
        notes["pose"] = out.poses[0].status
        for name in ("residual_px_given", "residual_px"):
            notes[name] = [round(px, 3) for px in getattr(out.poses[0], name)]
    if out.visible is not None:
        notes["visible"] = round(float(np.mean(out.visible)), 4)
    return notes


def guided_prediction(
    pipe: Any, sample: StereoSample, guidance: GeometryGuidance, arguments: dict[str, Any]
) -> Prediction:
    """Return the prediction of one guided call of a pipeline with guidance enabled."""
    spread = arguments.get("ensemble_size", 1) > 1
    out = pipe(Image.fromarray(sample.left), guidance=guidance, output_uncertainty=spread, **arguments)
    uncertainty, confidence = (None if m is None else m[0, ..., 0] for m in (out.uncertainty, out.confidence))
    return Prediction(
        out.prediction[0, ..., 0], None, prior_of(pipe).space, uncertainty, confidence, _notes(out)
    )


def _plain_configuration(settings: Settings) -> dict[str, Any]:
    without = ("prior", *(each.name for each in fields(SpeedOptions)))  # results are equal up to rounding
    return {key: value for key, value in asdict(settings).items() if key not in without}


def guided_configuration(preset: Preset, settings: Settings) -> dict[str, Any]:
    """Return all hyperparameters of a preset, the files of its decoder, and all settings except the prior."""
    camera = np.array([[32.0, 0, 16], [0, 32.0, 16], [0, 0, 1]])
    pose = np.eye(4)
    pose[0, 3] = 0.1
    guidance = preset(np.zeros((32, 32, 3), np.uint8), camera, pose)
    chosen = _plain_configuration(settings)
    if decoder := folder_fingerprint(Path(guidance.config.decoder)):
        chosen["decoder_files"] = decoder
    return chosen | {"guidance": guidance.as_run().to_dict()}


def posed_views(sample: StereoSample, views: int) -> tuple[Any, Any, Any]:
    """Return ``(right, K, E)`` of at most ``views`` views of a sample for ``GeometryGuidance``."""
    more = sample.extra_views[: views - 2]
    if not more:
        return sample.right, (sample.K_left, sample.K_right), sample.E
    images, Ks, Es = zip((sample.right, sample.K_right, sample.E), *more, strict=True)
    return images, (sample.K_left, *Ks), (np.eye(4), *Es)


def guidance_of(
    sample: StereoSample, settings: Settings, priors: PriorCache, preset: Preset, **changes: Any
) -> GeometryGuidance:
    """Return a preset's guidance for a sample's views, reusing evidence computed by other methods."""
    guidance = preset(*posed_views(sample, settings.views), **changes)
    guidance.evidence_store = priors.evidence
    guidance.calibrated = True
    guidance.measured_baseline = guidance.measured_baseline or sample.E_true is not None
    return guidance


def _run_guided(preset: Preset, sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    guidance = guidance_of(sample, settings, priors, preset)
    pipe = priors.get(settings)
    if guidance.through_network and prior_of(pipe).network_input is None:
        raise NotApplicable("no gradient to z_t, which is not an input of this prior's network")
    return guided_prediction(pipe, sample, guidance, call_arguments(settings))


def _guided(name: str, title: str, summary: str, preset: Preset, run: Run | None = None) -> Method:
    """Return a method with one preset; it guides the prior unless it has a ``run``."""
    run = run or partial(_run_guided, preset)
    return Method(name, title, summary, run, partial(guided_configuration, preset), uses_prior=True)


def _run_plain(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    """Run the paper's row "Marigold": the output is aligned with ground truth."""
    pipe = priors.get(settings)
    out = pipe(Image.fromarray(sample.left), **call_arguments(settings))
    return Prediction(None, relative=out.prediction[0, ..., 0], space=prior_of(pipe).space)


def guided_map(
    values: Any, space: str, sample: StereoSample, settings: Settings, priors: PriorCache, preset: Preset
) -> Prediction:
    """Guide a map ``(h, w)``, affine in ``space`` and not finite in holes, as a preset guides the prior."""
    pipe = priors.get(replace(settings, prior="map", space=space))
    guidance = guidance_of(sample, settings, priors, preset)
    call = call_arguments(replace(settings, steps=None, ensemble=1)) | {"depth_map": values}
    return guided_prediction(pipe, sample, guidance, call)


def _photometric_updates(right: Any, K: Any, E: Any) -> GeometryGuidance:
    """Update with photometric error and regularization only, initialised by the search, with Adam."""
    updates: dict[str, Any] = {"guidance_steps": 50, "lr_latents": 0.01, "min_steps": 1}
    return GeometryGuidance(
        right, K, E, weights=PAPER.weights, fit_matches=False, refine_edges=False, **updates
    )


def _run_reprojection(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    pipe = priors.get(settings)
    call = call_arguments(settings) | {"match_input_resolution": False}
    relative = pipe(Image.fromarray(sample.left), **call).prediction[0, ..., 0]
    if settings.resolution is None:
        settings = replace(settings, resolution=pipe.default_processing_resolution or 0)
    return guided_map(relative, prior_of(pipe).space, sample, settings, priors, _photometric_updates)


class RampPrior(DepthMapPipeline):
    """Predicts the latent of a ground plane, near at the bottom, in one step with a prior's ``adapter``."""

    takes_map = False
    adapter: Any

    def prepare_condition(self, image: Tensor, ensemble_size: int, *_: Any, **__: Any) -> dict[str, Tensor]:
        """Return the ramp's latent."""
        near, far = (0.0, 1.0) if SPACES[self.adapter.space].grows_with_depth else (1.0, 0.0)
        rows = torch.linspace(far, near, image.shape[-2], device=image.device).view(1, 1, -1, 1)
        ramp = rows.expand(len(image), 1, -1, image.shape[-1])
        return {"image_latent": self.adapter.encode(ramp)}

    def decode(self, z0: Tensor) -> Tensor:
        """Decode with the prior's decoder."""
        return self.adapter.decode(z0)

    def encode(self, x: Tensor) -> Tensor:
        """Encode with the prior's encoder."""
        return self.adapter.encode(x)


def _run_ramp(preset: Preset, sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    """Make a guided call on a ramp, with as many rounds of updates as the preset uses with this prior."""
    pipe = priors.get(settings)
    adapter = prior_of(pipe)
    of_preset = preset(*posed_views(sample, settings.views))
    rounds = of_preset.denoising_steps(settings.steps, pipe.default_denoising_steps)
    ramp = RampPrior(DirectScheduler(), adapter.space, rounds, pipe.default_processing_resolution or 0)
    ramp.adapter = adapter
    ramp.image_processor = pipe.image_processor
    ramp.to(pipe.device).set_progress_bar_config(disable=True)
    guidance = guidance_of(sample, settings, priors, preset, min_steps=rounds)
    arguments = {} if settings.resolution is None else {"processing_resolution": settings.resolution}
    return guided_prediction(enable_geometry_guidance(ramp), sample, guidance, arguments)


def _run_estimated(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    """Run the default preset with estimated poses, given only the length of the first baseline."""
    more = sample.extra_views[: settings.views - 2]
    try:
        guidance = GeometryGuidance.from_unposed_images(
            [sample.left, sample.right, *(image for image, _, _ in more)],
            K=[sample.K_left, sample.K_right, *(K for _, K, _ in more)],
            baseline_m=float(np.linalg.norm(sample.E[:3, 3])),
        )
    except ValueError as error:
        raise NotApplicable(f"no pose could be estimated ({error})") from error
    return guided_prediction(priors.get(settings), sample, guidance, call_arguments(settings))


_PLAIN = "the stock pipeline, scale and shift fitted to ground truth by least squares"
_SEARCH = "scale search only: no match fitting, no gradient updates, no refinement"
_FIT = "a single fit to the matches and one refinement: no guided steps"
_UPDATES = "no diffusion: 50 photometric updates of the prior's map"
_RAMP = "the default preset without the U-Net: search, match fitting and refinement on a ramp's latent"
_AFFINE = partial(GeometryGuidance, optimize_latents=False, refine_edges=False)
_BELIEVING = partial(GeometryGuidance, reject_reflections=False)  # a ramp contradicts no reflection

GUIDED_METHODS = (
    Method("prior-aligned", "prior + oracle", _PLAIN, _run_plain, _plain_configuration, uses_prior=True),
    _guided("search-only", "search only", _SEARCH, GeometryGuidance.search_only),
    _guided(
        "scale-shift-only", "scale, shift", "the default preset optimizing scale and shift only", _AFFINE
    ),
    _guided("paper", "paper", "the prior guided with the paper's parameters", GeometryGuidance.paper),
    _guided("prior-fit", "prior fit", _FIT, partial(GeometryGuidance, config=PRIOR_FIT)),
    _guided("guided", "guided", "the prior guided with the default preset", GeometryGuidance),
    _guided("fast", "fast", "the prior guided with the fast preset", partial(GeometryGuidance, config=FAST)),
    _guided("reprojection-only", "reprojection only", _UPDATES, _photometric_updates, _run_reprojection),
    _guided("no-diffusion", "no diffusion", _RAMP, _BELIEVING, partial(_run_ramp, _BELIEVING)),
)


def variant(base: str, config: GuidanceConfig, text: str) -> Method:
    """Return a preset with changed parameters (``name=value``, joined by ``+``), or ``pose=estimated``."""
    name = f"{base}:{text}"
    if name == "guided:pose=estimated":
        summary = "the prior guided with the default preset, poses estimated from the images"
        return _guided(name, "guided, poses estimated", summary, GeometryGuidance, _run_estimated)
    changed = config_from_text(text.split("+"), config, "methods")
    title = f"{base}, {text.replace('+', ', ')}"
    preset = partial(GeometryGuidance, config=changed)
    return _guided(name, title, f"{base} with {text}", preset)
