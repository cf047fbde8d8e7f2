"""What the spaces of priors are affine in, in NumPy."""

import numpy as np
import torch

#: What a space is affine in: from metres, and back.
TO = {
    "depth": (lambda z: z, lambda v: v),
    "disparity": (lambda z: 1 / z, lambda v: 1 / v),
    "log": (np.log, np.exp),
    "log1p": (np.log1p, np.expm1),
    "sqrt_disparity": (lambda z: z**-0.5, lambda v: v**-2.0),
}
#: Spaces that grow with depth.
GROWS = ("depth", "log", "log1p")


def tensor(values) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32)


def metres(x: np.ndarray, near: float, far: float, space: str) -> np.ndarray:
    """Depth of a relative map between two ends."""
    to, back = TO[space]
    a, b = (to(near), to(far)) if space in GROWS else (to(far), to(near))
    return back(a + (b - a) * x)
