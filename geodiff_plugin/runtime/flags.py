"""Flags of a guided call on the pipeline: frozen weights, and the running ``GuidedRun``.

Data flow: pipeline -> weights without gradients, and the run that its methods ask for.
Paper: none.
"""

from __future__ import annotations

from typing import Any

import torch

__all__ = ["FrozenWeights", "Running"]


class FrozenWeights:
    """Context manager: ``requires_grad`` off on every weight, else each keeps a graph; back afterwards."""

    def __init__(self, pipe: Any) -> None:
        self._modules = [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)]

    def __enter__(self) -> None:
        self._flags = [(p, p.requires_grad) for m in self._modules for p in m.parameters()]
        for parameter, _ in self._flags:
            parameter.requires_grad_(False)

    def __exit__(self, *exc: object) -> None:
        for parameter, flag in self._flags:
            parameter.requires_grad_(flag)


class Running:
    """Context manager: the pipeline's decode and ensembling ask ``_guided_run`` whether they are guided."""

    def __init__(self, pipe: Any, run: Any) -> None:
        self._pipe, self._run = pipe, run

    def __enter__(self) -> None:
        self._pipe._guided_run = self._run

    def __exit__(self, *exc: object) -> None:
        del self._pipe._guided_run
