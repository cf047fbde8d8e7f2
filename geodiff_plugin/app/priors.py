"""The priors that a page offers, loaded once for all its visitors."""

from __future__ import annotations

from typing import Any

import torch

from geodiff_plugin._checks import check_choice
from geodiff_plugin.priors import load_prior
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance

__all__ = ["Priors"]


class Priors:
    """The priors that this page offers, each loaded once, when it is first used.

    Args:
        names: as ``load_prior`` takes them; a visitor can choose among these alone.
        device: where they run.
    """

    def __init__(self, names: tuple[str, ...], device: torch.device) -> None:
        self.names, self.device = names, device
        self._loaded: dict[str, Any] = {}

    def get(self, name: str) -> Any:
        """The pipeline, with guidance enabled and its bars off."""
        check_choice(name, "prior", self.names)
        if name not in self._loaded:
            pipe = load_prior(name).to(self.device)
            pipe.set_progress_bar_config(disable=True)
            self._loaded[name] = enable_geometry_guidance(pipe)
        return self._loaded[name]
