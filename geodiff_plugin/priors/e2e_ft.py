"""Marigold E2E-FT and Stable Diffusion E2E-FT: one step from zeros.

Data flow: folder -> ``E2EFTPipeline``.
Paper: none (Martin Garcia et al., arXiv 2409.11355, WACV 2025).
"""

from __future__ import annotations

import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.priors.layout import Layout
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.marigold import MarigoldPrior
from geodiff_plugin.priors.pipelines.e2e_ft import E2EFTPipeline

__all__ = ["E2EFTPrior"]


class E2EFTPrior(MarigoldPrior):
    """Adapter of ``E2EFTPipeline``; network, input and decoder are Marigold's."""

    max_steps: int | None = 1
    deterministic = True
    licence: dict[str, str] = {}  # the authors' repository does not say

    @staticmethod
    def matches(pipe: object) -> bool:
        """Any instance of ``E2EFTPipeline``."""
        return isinstance(pipe, E2EFTPipeline)

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Marigold's components, and a schedule that Marigold has not: trailing, betas as they were.

        That is what the authors' training script saves. Marigold v1-0 is leading, v1-1 rescales its betas,
        the LCM says how many steps it was distilled from. A folder that keeps Marigold's own scheduler
        cannot be recognised by its configs: there "e2e-ft" in the name decides, or ``e2e-ft:`` before it.
        """
        if not MarigoldPrior.recognises(layout):
            return False
        schedule = layout.config("scheduler")
        return (
            layout.index.get("initial_latents") == "zeros"
            or "e2e-ft" in layout.name.lower()
            or (
                schedule.get("timestep_spacing") == "trailing"
                and not schedule.get("rescale_betas_zero_snr")
                and "original_inference_steps" not in schedule
                and layout.index.get("default_denoising_steps", 1) == 1
            )
        )

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> E2EFTPipeline:
        """The folder's networks; of its scheduler the betas.

        Raises:
            ValueError: weights that do not fit; a model of normals.
        """
        if "normals" in layout.name.lower():
            bad_value("prior", "a model of depth", repr(layout.name), "Its sibling *-e2e-ft-depth is one.")
        space = space or layout.index.get("prediction_type") or "depth"
        return build_pipeline(E2EFTPipeline, layout, dtype, prediction_type=space)
