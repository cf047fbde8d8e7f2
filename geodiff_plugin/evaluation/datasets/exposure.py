"""A sample whose right view was taken with another exposure or tone curve.

Data flow: ``StereoSample`` + gain + gamma -> ``StereoSample``.
Paper: S11 (limits under changing illumination); Middlebury's im1E has such views of a few scenes only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample

__all__ = ["exposed_ref", "with_exposure"]


def exposed_ref(ref: SampleRef, gain: float, gamma: float) -> SampleRef:
    """The reference to a sample with a changed right view; it is named by what was changed."""
    name = f"{ref.name}-gain{gain:g}-gamma{gamma:g}"
    return replace(ref, name=name, files={**ref.files, "right_exposure": (gain, gamma)})


def with_exposure(sample: StereoSample, change: Sequence[float], name: str) -> StereoSample:
    """Change the right view only.

    Args:
        sample: as it was taken.
        change: gain and gamma; a value v in [0, 1] becomes ``gain * v ** gamma``, clipped as a sensor clips
            and rounded to 8 bits again.
        name: of the result.
    """
    gain, gamma = change
    right_01 = np.clip(gain * (sample.right / 255.0) ** gamma, 0.0, 1.0)
    return replace(sample, name=name, right=np.rint(255 * right_01).astype(np.uint8))
