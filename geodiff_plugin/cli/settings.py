"""Options of ``geodiff depth`` as torch and the guidance need them: device, dtype, configuration.

Data flow: ``DepthArguments``, checked -> ``Settings`` (device, dtype, range, knobs).
Paper: none.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from geodiff_plugin._checks import refuse
from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.checks import camera_pair
from geodiff_plugin.config import PRESETS, GuidanceConfig, config_from_text
from geodiff_plugin.runtime.machine import pick_device

__all__ = ["Settings", "read_settings"]


@dataclass(frozen=True)
class Settings:
    """What was understood.

    Attributes:
        device: where the pipeline runs.
        dtype: of U-Net and VAE.
        options: what ``--option`` gives to the prior's call.
        config: hyperparameters of the guidance: the preset, ``--near`` and ``--far``, and ``--knob``.
        cameras: numbers of the left and the right camera in the calibration, or ``None``.
    """

    device: torch.device
    dtype: torch.dtype
    options: dict[str, str]
    config: GuidanceConfig
    cameras: tuple[int, int] | None


def _configuration(
    typed: tuple[str, ...], preset: str, depth_range: tuple[float, float] | None
) -> GuidanceConfig:
    base = PRESETS[preset]
    config = config_from_text(typed, base, "--knob")
    if config.depth_range is not None:
        refuse("Give depth_range as --near and --far, in metres, not as --knob.")
    if depth_range is None:
        return config
    # The paper's search is over one number, between the same two depths.
    if preset != "paper":
        return config.changed(depth_range=depth_range)
    given = config.g_s_range != base.g_s_range
    return config if given else config.changed(g_s_range=depth_range)


def read_settings(arguments: DepthArguments) -> Settings:
    """The settings of arguments that ``check_arguments`` has seen.

    Raises:
        TypeError, ValueError: a device that is not here, a knob that does not exist.
    """
    near, far = arguments.near, arguments.far
    depth_range = None if near is None or far is None else (near, far)
    return Settings(
        device=pick_device(arguments.device),
        dtype=getattr(torch, arguments.dtype),
        options={name: value for name, _, value in (entry.partition("=") for entry in arguments.option)},
        config=_configuration(arguments.knob, arguments.preset, depth_range),
        cameras=None if arguments.cameras is None else camera_pair(arguments.cameras),
    )
