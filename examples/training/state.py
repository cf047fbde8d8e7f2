"""State of a training run on disk, so that a killed run can resume.

Data flow: U-Net, its moving average, AdamW moments, counters -> ``state.safetensors`` + ``state.json``
    -> the same.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file

__all__ = ["Average", "Progress", "restore", "store"]


@dataclass
class Progress:
    """Counters of a run.

    Attributes:
        step: optimiser steps of the U-Net.
        samples: scenes shown.
        seconds: wall-clock time of the U-Net's training, over all starts.
        seed: seed of the run.
    """

    step: int = 0
    samples: int = 0
    seconds: float = 0.0
    seed: int = 0


class Average:
    """Exponential moving average of a module's parameters, in float32, with a warm start.

    Args:
        module: the module to follow.
        decay: weight of the previous average, in [0, 1).
    """

    def __init__(self, module: torch.nn.Module, decay: float) -> None:
        self.decay = decay
        self.values = {name: value.detach().float().clone() for name, value in module.state_dict().items()}

    @torch.no_grad()
    def update(self, module: torch.nn.Module, step: int) -> None:
        """Move towards ``module``; early on the decay is ``(1 + step) / (10 + step)``."""
        decay = min(self.decay, (1 + step) / (10 + step))
        now = [value.detach().float() for value in module.state_dict().values()]
        torch._foreach_lerp_(list(self.values.values()), now, 1.0 - decay)

    def copy_to(self, module: torch.nn.Module) -> None:
        """Write the average into ``module``."""
        module.load_state_dict(self.values)


def store(
    folder: Path,
    unet: torch.nn.Module,
    average: Average,
    optimiser: torch.optim.Optimizer,
    progress: Progress,
) -> None:
    """Write the state; a rename makes it visible, so an interruption leaves the previous state."""
    tensors = {f"unet.{name}": value for name, value in unet.state_dict().items()}
    tensors |= {f"average.{name}": value for name, value in average.values.items()}
    for name, parameter in unet.named_parameters():
        for key, value in optimiser.state.get(parameter, {}).items():
            tensors[f"adam.{key}.{name}"] = torch.as_tensor(value)
    part = folder / "state.part"
    counters = {"progress": json.dumps(asdict(progress))}
    save_file(
        {name: value.detach().cpu().contiguous() for name, value in tensors.items()}, part, metadata=counters
    )
    part.replace(folder / "state.safetensors")
    (folder / "state.json").write_text(json.dumps(asdict(progress), indent=2) + "\n")


def restore(
    folder: Path, unet: torch.nn.Module, average: Average, optimiser: torch.optim.Optimizer
) -> Progress | None:
    """Load the state into the given objects.

    Returns:
        The counters, or ``None`` if the folder has no state.
    """
    path = folder / "state.safetensors"
    if not path.exists():
        return None
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        progress = Progress(**json.loads(file.metadata()["progress"]))
    unet.load_state_dict({k.removeprefix("unet."): v for k, v in tensors.items() if k.startswith("unet.")})
    for name, value in average.values.items():
        value.copy_(tensors[f"average.{name}"])
    for name, parameter in unet.named_parameters():
        keys = ("step", "exp_avg", "exp_avg_sq")
        if f"adam.step.{name}" in tensors:
            optimiser.state[parameter] = {
                key: tensors[f"adam.{key}.{name}"].to(parameter.device if key != "step" else "cpu")
                for key in keys
            }
    return progress
