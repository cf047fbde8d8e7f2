"""Interface of a prior's adapter: decoding, space, network call; it never sees a camera.

Paper: S4 ("can be integrated with any DB-MDE framework following a similar schema").
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.loading import build_pipeline
from geodiff_plugin.priors.pipelines.base import DepthDiffusionPipeline

__all__ = ["DepthPrior", "OwnPipelinePrior"]


class DepthPrior(Protocol):
    """Adapter of one kind of pipeline.

    The grid needs no word of its own: the pipeline's ``image_processor`` resizes and pads, what it returns
    tells scale per axis and padding, and ``decode`` answers on that padded grid.

    Attributes:
        space: what the decoded map is affine in, key of ``SPACES``.
        max_steps: most denoising steps that make sense, ``None`` for any number. A guided call of a prior
            with one step makes as many updates in it as it would have made in ``min_steps`` steps.
        deterministic: the same image gives the same map, so that an ensemble has one member.
        latents: channels of the scheduler's latents that are depth; no gradient step touches the others.
        network_input: channels of the network's first argument that are the depth latent z_t; ``None``
            if z_t is no input of the network, so that only its output can be guided.
        takes_prompt: whether the call takes ``prompt_depth``, depths that the network starts from.
        licence: of the weights by hub id, for those that are known.
    """

    space: str
    max_steps: int | None
    deterministic: bool
    latents: slice
    network_input: slice | None
    takes_prompt: bool
    licence: dict[str, str]

    @staticmethod
    def matches(pipe: Any) -> bool:
        """Whether this adapter understands the live pipeline."""

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Whether a folder is of this kind, by its component configs, never by ``_class_name``."""

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> Any:
        """The pipeline of a folder that it recognises; ``space`` is what the user said, or ``None``.

        Raises:
            ValueError: weights missing or left over; an unknown space.
        """

    def __init__(self, pipe: Any) -> None: ...

    def network(self) -> tuple[Any, str]:
        """Where the loop calls the network once a step: an object and the name of the method on it."""

    def decode(self, z0: Tensor) -> Tensor:
        """Unclipped relative map ``(B, 1, H, W)`` float32, about [0, 1], with the graph of ``z0``.

        It may lack the rows and columns beyond the last whole cell of the latent; a guided call repeats them.
        """

    def encode(self, x: Tensor) -> Tensor:
        """Clean latent of a map ``(B, 1, H, W)`` on the padded grid, about the inverse of ``decode``."""

    def metric_range(self, samples: slice) -> tuple[Tensor, Tensor] | None:
        """What the prior itself says in metres, from which the search for the scale then starts.

        Args:
            samples: which members of the running call, once its condition is prepared.

        Returns:
            Depths of ``x = 0`` and of ``x = 1``, ``(B,)`` metres each; ``None`` for a relative prior.
        """

    def known(self, samples: slice) -> Tensor | None:
        """Where the prior says anything; what it gives elsewhere is no evidence of its scale or quality.

        Args:
            samples: as in ``metric_range``.

        Returns:
            ``(B, 1, H, W)`` bool on the processing grid; ``None`` for everywhere.
        """


class OwnPipelinePrior:
    """Adapter of a ``DepthDiffusionPipeline``, which says of itself what guidance must know.

    A subclass names its ``pipeline_class`` and writes ``recognises``; ``load`` if its folder is not in
    diffusers' layout.

    Args:
        pipe: the live pipeline.
    """

    pipeline_class: type[DepthDiffusionPipeline] = DepthDiffusionPipeline
    licence: dict[str, str] = {}
    takes_prompt = False

    def __init__(self, pipe: DepthDiffusionPipeline) -> None:
        self._pipe = pipe
        self.space = pipe.config.prediction_type
        self.max_steps, self.deterministic = pipe.max_steps, pipe.deterministic
        self.latents = pipe.depth_channels
        self.network_input = pipe.depth_channels if pipe.sees_latents else None

    @classmethod
    def matches(cls, pipe: Any) -> bool:
        """Any instance of ``pipeline_class``."""
        return isinstance(pipe, cls.pipeline_class)

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """No folder: which are of its kind is for a subclass to say."""
        return False

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> DepthDiffusionPipeline:
        """Components by the names of the constructor, each from its own subfolder."""
        return build_pipeline(cls.pipeline_class, layout, dtype, prediction_type=space)

    def network(self) -> tuple[Any, str]:
        """The pipeline's own ``denoise``, whose first argument is the latents."""
        return self._pipe, "denoise"

    def decode(self, z0: Tensor) -> Tensor:
        """The pipeline's ``decode_relative``."""
        return self._pipe.decode_relative(z0)

    def encode(self, x: Tensor) -> Tensor:
        """The pipeline's ``encode_relative``."""
        return self._pipe.encode_relative(x)

    def metric_range(self, samples: slice) -> tuple[Tensor, Tensor] | None:
        """A relative prior has none."""
        return None

    def known(self, samples: slice) -> Tensor | None:
        """A network says something everywhere."""
        return None
