"""Random weights that two implementations can share without sharing a file: drawn by parameter name.

Used on both sides of every parity fixture, ours and (copied into the throw-away environment) the authors'.
Needs numpy and torch only. Every parameter and floating buffer is drawn, also those that are initialised to
zero: a network whose last layer is zero answers zero, and parity with it would be meaningless.
"""

import zlib

import numpy as np
import torch


def draw(name: str, shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Float32 normals of a name and a seed, the same on every machine."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return rng.standard_normal(shape).astype(np.float32)


def weight(name: str, shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """A weight of a sensible size: matrices by their fan-in, gains about one, offsets about zero."""
    values = draw(name, shape, seed)
    if len(shape) > 1:
        return values / np.sqrt(max(int(np.prod(shape[1:])), 1))
    return (1.0 if name.endswith("weight") else 0.0) + 0.1 * values


def named_state(shapes: dict[str, tuple[int, ...]], seed: int = 0) -> dict[str, torch.Tensor]:
    """A state dict of those names and shapes."""
    return {name: torch.from_numpy(weight(name, shape, seed)) for name, shape in shapes.items()}


def fill(
    module: torch.nn.Module, prefix: str = "", rename=lambda name: name, seed: int = 0
) -> torch.nn.Module:
    """Set every parameter of a module, in place.

    Args:
        module: gets the weights.
        prefix: before every name, to distinguish networks (``"unet."``).
        rename: from the module's names to the shared ones, where the two sides differ.
        seed: of the draw.
    """
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            shared = prefix + rename(name)
            parameter.copy_(torch.from_numpy(weight(shared, tuple(parameter.shape), seed)))
    return module
