"""Checkpoints of other people's code to folders that ``--prior`` takes, one kind a file.

Hop: an unpickled checkpoint -> the kind that it is -> a folder of safetensors.
Paper: none.

A new kind is a new file and one line in ``CONVERTERS``.
"""

from __future__ import annotations

from geodiff_plugin.commands.converters.depthfm import DEPTHFM
from geodiff_plugin.commands.converters.kinds import Converter
from geodiff_plugin.commands.converters.ppd import PPD

__all__ = ["CONVERTERS", "Converter"]

CONVERTERS: dict[str, Converter] = {
    "depthfm": DEPTHFM,
    "ppd": PPD,
}
