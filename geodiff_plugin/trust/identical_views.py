"""Check whether the left image and a right view are identical."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from geodiff_plugin._internal.strips import row_strips
from geodiff_plugin.findings import REASON, Finding, FindingKind
from geodiff_plugin.geometry import image_size
from geodiff_plugin.trust.check import Check, FactSheet
from geodiff_plugin.trust.stages import ResultStage

IDENTICAL = FindingKind(
    "views.identical",
    REASON,
    "The left and right images are identical",
    cause="The same file was passed twice.",
    hint="Use two images from different viewpoints.",
    explains=("*",),
)


@dataclass(frozen=True)
class Difference:
    """Maximum differences of pixel values in [0, 1]."""

    largest: float  # between the left image and the most similar right view of the same size
    contrast: float  # between two pixels of the left image


class IdenticalViews(Check[Difference]):
    """Detects one file given twice, if no value differs by more than rounding.

    The finding suppresses all others.
    """

    kinds = (IDENTICAL,)
    #: Maximum difference, 1.5 grey levels of 8 bits. A recompressed copy differs by one level.
    MAX_DIFFERENCE = 1.5 / 255
    #: Maximum difference as a fraction of the contrast, because any two nearly black images differ by little.
    MAX_OF_CONTRAST = 0.05

    @classmethod
    def scalars(cls, stage: ResultStage) -> dict[str, Tensor]:
        left_01 = stage.native.left.image_01
        views = [view.image_01 for view in stage.native.rights if view.image_01.shape == left_01.shape]
        if not views:
            return {}
        darkest, brightest = left_01.aminmax()
        differences = [_largest_difference(view_01, left_01) for view_01 in views]
        return {"largest": _reduced(torch.amin, differences), "contrast": brightest - darkest}

    @classmethod
    def of_result(cls, stage: ResultStage, numbers: Mapping[str, float]) -> Difference | None:
        return Difference(**numbers) if numbers else None

    @classmethod
    def findings(cls, facts: FactSheet, earlier: Sequence[Finding]) -> Iterator[Finding]:
        fact = facts[cls]
        if fact and fact.largest < min(cls.MAX_DIFFERENCE, cls.MAX_OF_CONTRAST * fact.contrast):
            yield Finding(
                IDENTICAL,
                "The left image and a right view are identical. Use two images from different viewpoints.",
            )


def _largest_difference(image_01: Tensor, left_01: Tensor) -> Tensor:
    """Compute the maximum difference ``()`` of two images of one size, in strips to save memory."""
    strips = row_strips(*image_size(left_01))
    return _reduced(torch.amax, [(image_01[:, rows] - left_01[:, rows]).abs().amax() for rows in strips])


def _reduced(reduction: Callable[[Tensor], Tensor], numbers: Sequence[Tensor]) -> Tensor:
    """Reduce tensors ``()`` to one; a single tensor is returned without a kernel launch."""
    return numbers[0] if len(numbers) == 1 else reduction(torch.stack(list(numbers)))
