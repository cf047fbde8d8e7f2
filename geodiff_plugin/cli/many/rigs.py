"""Cameras of a rig, read once for all of its pairs.

Data flow: arguments of a pair -> ``Rig``, read or remembered.
Paper: none.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from geodiff_plugin.cli.arguments import DepthArguments
from geodiff_plugin.cli.inputs import read_rig
from geodiff_plugin.cli.many.digests import CAMERA_FILES, file_digests
from geodiff_plugin.formats.reading import has_pose_per_image
from geodiff_plugin.types import Rig

__all__ = ["RigStore"]

#: What stands before the number of a camera in names of KITTI.
NUMBERED = "image_"
Size = tuple[int, int]
#: What of the arguments cameras are read from, beside the images' names.
CAMERA_OPTIONS = (*CAMERA_FILES, "fx", "fy", "cx", "cy", "baseline", "cropped")


class RigStore:
    """``read_rig`` that remembers what it read last, and its warnings; not for several threads at a time."""

    def __init__(self) -> None:
        self._key: Any = None
        self._rig: Rig | None = None
        self._warnings: tuple[str, ...] = ()
        self._by_image: dict[tuple[Path, ...], bool] = {}

    def _is_by_image(self, calib: tuple[Path, ...]) -> bool:
        if calib and calib not in self._by_image:
            self._by_image[calib] = has_pose_per_image(calib)
        return self._by_image.get(calib, False)

    def read(
        self,
        arguments: DepthArguments,
        cameras: Size | None,
        left_size: Size,
        right_size: Size | None,
        sentences: Sequence[str] = (),
    ) -> Rig:
        """As ``read_rig``; KITTI's asks names for the camera's number, some have a pose for every image.

        What reading adds to ``sentences``, where the caller collects warnings, is warned of again when the
        cameras are remembered. A file that was corrected meanwhile is read anew.
        """
        views: tuple[Any, ...] = (arguments.left, arguments.right)
        if not self._is_by_image(arguments.calib):
            views = tuple(
                path.parent if path is not None and NUMBERED not in path.name else path for path in views
            )
        options = tuple(getattr(arguments, name) for name in CAMERA_OPTIONS)
        key = (views, options, file_digests(arguments, CAMERA_FILES), cameras, left_size, right_size)
        if self._rig is None or key != self._key:
            before = len(sentences)
            self._rig, self._key = read_rig(arguments, cameras, left_size, right_size), key
            self._warnings = tuple(sentences[before:])
        else:
            for sentence in self._warnings:
                warnings.warn(sentence, stacklevel=2)
        return self._rig
