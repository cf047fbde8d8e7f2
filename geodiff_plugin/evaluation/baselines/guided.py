"""Methods that call the prior plainly or guide it, each by one preset, and those without its network.

Paper: Algorithm 1, S5.1, S5.3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from PIL import Image
from torch import Tensor

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
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline
from geodiff_plugin.runtime.checks import needs_network
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance
from geodiff_plugin.scale.space import SPACES

Preset = Callable[..., GeometryGuidance]
"""``(right, K, E, **changes)`` -> guidance."""


def call_arguments(settings: Settings) -> dict[str, Any]:
    """Keywords of the pipeline call that ``settings`` decide, seeded afresh."""
    generator = torch.Generator(settings.device).manual_seed(settings.seed)
    given = {"num_inference_steps": settings.steps, "processing_resolution": settings.resolution}
    arguments = {name: value for name, value in given.items() if value is not None}
    return {"ensemble_size": settings.ensemble, "generator": generator} | arguments


def prior_space(pipe: Any) -> str:
    """Space in which the prior's output is affine, as its adapter says."""
    return find_adapter(pipe)(pipe).space


def _notes(out: Any) -> dict[str, Any]:
    """Scale, shift, poses and visibility of a guided result, as JSON values."""
    notes: dict[str, Any] = {"warnings": list(out.warnings)}
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
    """The answer of one guided call of a pipeline with guidance enabled; arguments as ``call_arguments``."""
    spread = arguments.get("ensemble_size", 1) > 1
    out = pipe(Image.fromarray(sample.left), guidance=guidance, output_uncertainty=spread, **arguments)
    uncertainty, confidence = (None if m is None else m[0, ..., 0] for m in (out.uncertainty, out.confidence))
    return Prediction(
        out.prediction[0, ..., 0], None, prior_space(pipe), uncertainty, confidence, _notes(out)
    )


def plain_configuration(settings: Settings) -> dict[str, Any]:
    """Every setting but the prior."""
    return {key: value for key, value in asdict(settings).items() if key != "prior"}


def guided_configuration(preset: Preset, settings: Settings) -> dict[str, Any]:
    """Every hyperparameter of a preset and every setting but the prior, as JSON values.

    A decoder in a folder counts by its files as well: one that was trained further keeps its name.
    """
    any_camera = np.array([[32.0, 0, 16], [0, 32.0, 16], [0, 0, 1]])
    to_the_right = np.eye(4)
    to_the_right[0, 3] = 0.1
    guidance = preset(np.zeros((32, 32, 3), np.uint8), any_camera, to_the_right)
    chosen = plain_configuration(settings)
    if decoder := folder_fingerprint(Path(guidance.config.decoder)):
        chosen["decoder_files"] = decoder
    return chosen | {"guidance": guidance.as_run().to_dict()}


def posed_views(sample: StereoSample, views: int) -> tuple[Any, Any, Any]:
    """``(right, K, E)`` of a sample as ``GeometryGuidance`` takes them, of at most ``views`` views."""
    more = sample.extra_views[: views - 2]
    if not more:
        return sample.right, (sample.K_left, sample.K_right), sample.E
    images, Ks, Es = zip((sample.right, sample.K_right, sample.E), *more, strict=True)
    return images, (sample.K_left, *Ks), (np.eye(4), *Es)


def guidance_for(
    sample: StereoSample, settings: Settings, priors: PriorCache, preset: Preset, **changes: Any
) -> GeometryGuidance:
    """The guidance of a preset by a sample's views, with the evidence that other methods made of them."""
    guidance = preset(*posed_views(sample, settings.views), **changes)
    guidance.evidence_store = priors.evidence
    guidance.measured_baseline = guidance.measured_baseline or sample.measured_baseline
    return guidance


def guided_method(name: str, title: str, summary: str, preset: Preset) -> Method:
    """A method that guides the prior under one preset; its configuration is ``guided_configuration``.

    It does not apply where it takes gradients through a network that does not see z_t.
    """

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        guidance, pipe = guidance_for(sample, settings, priors, preset), priors.get(settings)
        if needs_network(guidance) and find_adapter(pipe)(pipe).network_input is None:
            raise NotApplicable("no gradient to z_t, which this prior's network does not see")
        return guided_prediction(pipe, sample, guidance, call_arguments(settings))

    return Method(name, title, summary, run, partial(guided_configuration, preset), uses_prior=True)


def _run_plain(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    """The paper's row "Marigold": an oracle aligns what comes out."""
    pipe = priors.get(settings)
    out = pipe(Image.fromarray(sample.left), **call_arguments(settings))
    return Prediction(None, relative=out.prediction[0, ..., 0], space=prior_space(pipe))


def _without(weight: str) -> Preset:
    return partial(GeometryGuidance, weights={**DEFAULT.weights, weight: 0.0})


_SEARCH = "the search for the scale alone: no correction, no gradient updates, no refinement"
_FIT = "a plain call, fitted to the matches and refined once: no guided step"
_AFFINE = partial(GeometryGuidance, optimize_latents=False, crisp=False)
_PLAIN = "the stock pipeline, scale and shift by least squares against the truth"

GUIDED_METHODS = (
    Method("prior-aligned", "prior + oracle", _PLAIN, _run_plain, plain_configuration, uses_prior=True),
    guided_method("search-only", "search only", _SEARCH, GeometryGuidance.search_only),
    guided_method("scale-shift-only", "scale, shift", "the default preset on scale and shift only", _AFFINE),
    guided_method("paper", "paper", "the prior guided with the paper's own numbers", GeometryGuidance.paper),
    guided_method("prior-fit", "prior fit", _FIT, partial(GeometryGuidance, config=PRIOR_FIT)),
    guided_method("guided", "guided", "the prior guided with the default preset", GeometryGuidance),
    guided_method(
        "photometric-only", "photometric", "the default preset without matches", _without("matches")
    ),
    guided_method(
        "matches-only", "matches", "the default preset without the photometric error", _without("photometric")
    ),
)


def _run_estimated(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    """The default preset with the poses withheld but for the length of the first baseline."""
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


def variant(base: str, config: GuidanceConfig, text: str) -> Method:
    """A preset with some knobs changed.

    Args:
        base: its name.
        config: the preset.
        text: ``knob=value``, several joined by ``+``; ``weights.matches=0`` changes one weight, and
            ``guided:pose=estimated`` withholds the poses.

    Raises:
        InputError: another form, an unknown knob, or a value that it cannot have.
    """
    name = f"{base}:{text}"
    if name == "guided:pose=estimated":
        summary = "the prior guided with the default preset, poses estimated from the photographs"
        configured = partial(guided_configuration, GeometryGuidance)
        return Method(name, "guided, poses estimated", summary, _run_estimated, configured, uses_prior=True)
    changed = config_from_text(text.split("+"), config, "methods")
    title, preset = f"{base}, {text.replace('+', ', ')}", partial(GeometryGuidance, config=changed)
    return guided_method(name, title, f"{base} with {text}", preset)


def default_variant(text: str) -> Method:
    """The default preset with some knobs changed."""
    return variant("guided", DEFAULT, text)


def paper_variant(text: str) -> Method:
    """Algorithm 1 as printed with some knobs changed."""
    return variant("paper", PAPER, text)


class ConstantPrior(DepthDiffusionPipeline):
    """A pipeline of one step whose network is ``answer``; guided, it makes the updates of all steps in it.

    Args:
        module: any network of the prior that it stands in for, which says where the work is done.
        scheduler: a ``DirectScheduler``.
        prediction_type: what the relative map is affine in.
        default_denoising_steps: rounds of updates when guided.
        default_processing_resolution: longer side, pixels; 0 for the image's own.

    Attributes:
        answer: padded image ``(1, 3, H, W)`` in [-1, 1] -> latent ``(1, C, h, w)``.
        decode: latent -> unclipped relative map ``(1, 1, H, W)``, differentiable.
        encode: its inverse.
    """

    max_steps = 1
    deterministic = True
    sees_latents = False
    answer: Callable[[Tensor], Tensor]
    decode: Callable[[Tensor], Tensor]
    encode: Callable[[Tensor], Tensor]

    def __init__(
        self,
        module: torch.nn.Module,
        scheduler: Any,
        prediction_type: str = "depth",
        default_denoising_steps: int = 1,
        default_processing_resolution: int = 0,
    ) -> None:
        super().__init__()
        modules = {"module": module, "scheduler": scheduler}
        self.register_prior(modules, prediction_type, default_denoising_steps, default_processing_resolution)

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Any, **options: Any
    ) -> dict[str, Tensor]:
        """The answer, which is all that there is."""
        return {"image_latent": self.answer(image)}

    def denoise(self, latents: Tensor, timestep: Tensor, condition: dict[str, Tensor]) -> Tensor:
        """The answer, whatever the latents."""
        return condition["image_latent"]

    def decode_relative(self, z0: Tensor) -> Tensor:
        """The prior's decoder, or none."""
        return self.decode(z0)

    def encode_relative(self, x: Tensor) -> Tensor:
        """The prior's encoder, or none."""
        return self.encode(x)


#: ``answer``, ``decode`` and ``encode`` of a ``ConstantPrior``, and what resizes and pads for its latent.
Start = tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor], Callable[[Tensor], Tensor], Any]


def _stand_in(pipe: Any, start: Start, rounds: int) -> Any:
    """A pipeline that can be guided and answers with ``start``, at the resolution of a live prior."""
    resolution = pipe.default_processing_resolution or 0
    module = next(part for part in pipe.components.values() if isinstance(part, torch.nn.Module))
    constant = ConstantPrior(module, DirectScheduler(), prior_space(pipe), rounds, resolution)
    constant.answer, constant.decode, constant.encode, constant.image_processor = start
    constant.set_progress_bar_config(disable=True)
    return enable_geometry_guidance(constant)


def constant_method(
    name: str,
    title: str,
    summary: str,
    preset: Preset,
    start: Callable[[Any, StereoSample, Settings], Start],
    rounds: int | None = None,
) -> Method:
    """A guided method without a network in its loop.

    Args:
        name: key in ``METHODS``.
        title: column heading.
        summary: one sentence.
        preset: makes the guidance.
        start: live prior, sample, settings -> where the updates begin.
        rounds: of ``inner_steps`` updates; ``None`` for as many as the default takes with this prior.
    """

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        pipe, taken = priors.get(settings), rounds
        if taken is None:
            guidance = preset(*posed_views(sample, settings.views))
            taken = guidance.denoising_steps(settings.steps, pipe.default_denoising_steps)
        with torch.no_grad():
            begun = start(pipe, sample, settings)
        arguments = {} if settings.resolution is None else {"processing_resolution": settings.resolution}
        guidance = guidance_for(sample, settings, priors, preset, min_steps=taken)
        return guided_prediction(_stand_in(pipe, begun, taken), sample, guidance, arguments)

    return Method(name, title, summary, run, partial(guided_configuration, preset), uses_prior=True)


def _ramp(pipe: Any, sample: StereoSample, settings: Settings) -> Start:
    """The latent of a ground plane: near at the bottom, far at the top."""
    adapter = find_adapter(pipe)(pipe)
    near, far = (0.0, 1.0) if SPACES[adapter.space].grows_with_depth else (1.0, 0.0)

    def answer(image: Tensor) -> Tensor:
        rows = torch.linspace(far, near, image.shape[-2], device=image.device)
        return adapter.encode(rows.view(1, 1, -1, 1).expand(len(image), 1, -1, image.shape[-1]))

    return answer, adapter.decode, adapter.encode, pipe.image_processor


def _photometric_updates(right: Any, K: Any, E: Any, **changes: Any) -> GeometryGuidance:
    """Photometric error and pull only, started by the default's search, so that pixels are the change.

    The paper names a rate of 1e-2 and no optimiser. A plain step of that size moves no pixel, because the
    gradient of a mean over all pixels is tiny in each; Adam's do.
    """
    preset: dict[str, Any] = {"weights": PAPER.weights, "inner_steps": 50, "step_latents": 0.01}
    preset |= {"correct": False, "crisp": False}
    return GeometryGuidance(right, K, E, **(preset | changes))


def _plain_map(pipe: Any, sample: StereoSample, settings: Settings) -> Start:
    """The map of a plain call."""
    call = {"match_input_resolution": False, "output_type": "pt"} | call_arguments(settings)
    relative = pipe(Image.fromarray(sample.left), **call).prediction.float()  # (1, 1, h, w), in [0, 1]

    def answer(image: Tensor) -> Tensor:
        size = image.shape[-2:]
        if relative.shape[-2:] == size:
            return relative
        return F.interpolate(relative, size, mode="bilinear", align_corners=False)

    def as_it_is(pixels: Tensor) -> Tensor:
        return pixels

    return answer, as_it_is, as_it_is, MarigoldImageProcessor(vae_scale_factor=1)


CONSTANT_METHODS = (
    constant_method(
        "reprojection-only",
        "reprojection only",
        "no diffusion: the prior's map, its pixels moved by 50 updates of the photometric error",
        _photometric_updates,
        _plain_map,
        rounds=1,
    ),
    constant_method(
        "no-diffusion",
        "no diffusion",
        "the default preset without the U-Net: its search, corrections and refinement on a ramp's latent",
        partial(GeometryGuidance, reject_reflections=False),  # a ramp contradicts nothing
        _ramp,
    ),
)
