"""The prior alone, with scale and shift from the truth: the paper's row "Marigold".

Data flow: ``StereoSample`` -> stock pipeline call -> relative depth, to be aligned by an oracle.
Paper: S5.1, Tables 1 to 3 (aligned methods).
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from PIL import Image

from geodiff_plugin.evaluation.baselines._guidance import call_arguments, prior_space
from geodiff_plugin.evaluation.baselines.base import Method, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample

__all__ = ["PRIOR_ALIGNED"]


def _run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
    pipe = priors.get(settings)
    out = pipe(Image.fromarray(sample.left), **call_arguments(settings))
    return Prediction(depth_m=None, relative=out.prediction[0, ..., 0], space=prior_space(pipe))


def _configuration(settings: Settings) -> dict[str, Any]:
    return {key: value for key, value in asdict(settings).items() if key != "prior"}


PRIOR_ALIGNED = Method(
    name="prior-aligned",
    title="prior + oracle",
    summary="the stock pipeline, scale and shift by least squares against the truth",
    run=_run,
    configuration=_configuration,
    uses_prior=True,
)
