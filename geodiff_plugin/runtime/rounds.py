"""Number of denoising steps of a guided call, and of rounds in each.

Data flow: steps that guidance wants, that the call asks for and that the prior has -> steps and rounds.
Paper: none; its prior takes as many steps as it is asked for.
"""

from __future__ import annotations

from geodiff_plugin._checks import bad_value
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.priors import DepthPrior

__all__ = ["plan_steps"]


def plan_steps(
    guidance: GeometryGuidance, prior: DepthPrior, requested: int | None, pipeline_default: int | None
) -> tuple[int, int]:
    """Denoising steps of a guided call, and how often each makes its updates.

    A prior that can only take fewer steps than guidance wants makes the updates of all of them in those
    that it has, each round with its own search, as a step would have.

    Args:
        guidance: says how many steps it wants.
        prior: says how many make sense.
        requested: ``num_inference_steps`` of the call.
        pipeline_default: used if none is requested.

    Raises:
        ValueError: more steps are requested than the prior has.
    """
    wanted = guidance.denoising_steps(requested, pipeline_default)
    if prior.max_steps is None or wanted <= prior.max_steps:
        return wanted, 1
    if requested is not None:
        cure = "Leave it out: the prior was trained for so few."
        bad_value("num_inference_steps", f"at most {prior.max_steps} with this prior", requested, cure)
    return prior.max_steps, -(-wanted // prior.max_steps)
