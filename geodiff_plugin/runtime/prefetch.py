"""Prepares the evidence of the next guided call while the network of the current one runs."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin._internal.threads import BackgroundTask, WithinCores
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.evidence.plan import EvidencePlan


def prefetch_evidence(
    guidance: GeometryGuidance, left: Any, device: torch.device, *, among: int = 2, kernels: bool = True
) -> list[EvidencePlan]:
    """Prepare the evidence that the next call with this guidance uses, in the caller's thread.

    Threads share a CUDA stream by default, and the network of the current call is still running on it. The
    evidence uses a separate stream that does not wait for that network.

    Args:
        guidance: guidance of the next call.
        left: its left image, in any form of a call.
        device: device of the pipeline.
        among: number of threads of the program that compute at the same time and share the cores.
        kernels: whether Triton kernels may be used.
    """
    plain = torch.autocast(device.type, enabled=False)
    chosen = without_kernels(not kernels)
    with WithinCores(among), torch.no_grad(), plain, chosen:
        work = partial(guidance.prefetch, left, device)
        return BackgroundTask(work, device, own_stream=True, follows=False).result()
