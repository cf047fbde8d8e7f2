"""A preset with some knobs changed, as a method: ``guided:gradient=full``.

Data flow: ``preset:knob=value+knob=value`` -> ``Method``.
Paper: S5.3, S7.3, S9 (ablations).
"""

from __future__ import annotations

from functools import partial

import numpy as np

from geodiff_plugin.config import DEFAULT, PAPER, GuidanceConfig, config_from_text
from geodiff_plugin.evaluation.baselines._guidance import (
    call_arguments,
    guided_configuration,
    guided_method,
    guided_prediction,
)
from geodiff_plugin.evaluation.baselines.base import Method, NotApplicable, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.guidance.guidance import GeometryGuidance

__all__ = ["default_variant", "paper_variant"]


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
