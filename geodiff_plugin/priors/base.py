"""What an adapter tells guidance about a prior, which never sees a camera (paper S4)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from geodiff_plugin.priors.loading import Layout, build_pipeline
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline


class DepthPrior:
    """Adapter of one kind of pipeline; as it stands, of any ``DepthDiffusionPipeline``.

    A subclass names its ``pipeline_class`` and writes ``recognises``; the rest where its pipeline is another.

    Attributes:
        pipeline_class: of the pipelines that it understands.
        space: what the decoded map is affine in, key of ``SPACES``.
        max_steps: most denoising steps that make sense, ``None`` for any number. A guided call of a prior
            with one step makes as many updates in it as it would have made in ``min_steps`` steps.
        deterministic: the same image gives the same map, so that an ensemble has one member.
        takes_prompt: the call takes ``prompt_depth``, depths that the network starts from.
        latents: channels of the scheduler's latents that are depth; no gradient step touches the others.
        network_input: channels of the network's first argument that are the depth latent z_t; ``None``
            if z_t is no input of the network, so that only its output can be guided.
    """

    pipeline_class: type[Any] = DepthDiffusionPipeline

    def __init__(self, pipe: Any) -> None:
        self._pipe = pipe
        self.space: str = pipe.config.get("prediction_type")
        self.max_steps: int | None = getattr(pipe, "max_steps", None)
        self.deterministic: bool = getattr(pipe, "deterministic", False)
        self.takes_prompt: bool = getattr(pipe, "takes_prompt", False)
        self.latents: slice = getattr(pipe, "depth_channels", slice(None))
        self.network_input: slice | None = self.latents if getattr(pipe, "sees_latents", True) else None

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Whether a folder is of this kind, by its component configs, never by ``_class_name``."""
        return False

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> Any:
        """The pipeline of a folder that it recognises; ``space`` is what the user said, or ``None``."""
        return build_pipeline(cls.pipeline_class, layout, dtype, prediction_type=space)

    def network(self) -> tuple[Any, str]:
        """Where the loop calls the network once a step: an object and the name of the method on it."""
        return self._pipe, "denoise"

    def decode(self, z0: Tensor) -> Tensor:
        """Unclipped relative map ``(B, 1, H, W)`` float32, about [0, 1], with the graph of ``z0``.

        It may lack the rows and columns beyond the last whole cell of the latent; a guided call repeats them.
        """
        return self._pipe.decode_relative(z0)

    def encode(self, x: Tensor) -> Tensor:
        """Clean latent of a map ``(B, 1, H, W)`` on the padded grid, about the inverse of ``decode``."""
        return self._pipe.encode_relative(x)

    def metric_range(self, samples: slice) -> tuple[Tensor, Tensor] | None:
        """Metres ``(B,)`` of ``x = 0`` and of ``x = 1`` by the prior itself; ``None`` for a relative one."""
        own = getattr(self._pipe, "own_range", None)
        return None if own is None else own[samples].unbind(1)

    def valid(self, samples: slice) -> Tensor | None:
        """``(B, 1, H, W)`` bool, where on the processing grid the prior says anything, ``None`` for all."""
        valid = getattr(self._pipe, "valid", None)
        return None if valid is None else valid[samples]
