"""Converters of published checkpoints, one kind a file, one table.

Data flow: an unpickled checkpoint -> the kind that it is -> a folder of safetensors.
Paper: none.

A new kind is a new file and one line in ``CONVERTERS``.
"""

from __future__ import annotations

from geodiff_plugin.cli.converters.depthfm import DEPTHFM
from geodiff_plugin.cli.converters.kinds import Converter
from geodiff_plugin.cli.converters.ppd import PPD

__all__ = ["CONVERTERS", "Converter"]

CONVERTERS: dict[str, Converter] = {
    "depthfm": DEPTHFM,
    "ppd": PPD,
}
