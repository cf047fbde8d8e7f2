"""The images of pairs that are frames of videos or of a bag."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin.formats import recordings
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef


class Views:
    """The images of pairs that are frames of videos or of a bag, each opened once."""

    def __init__(self, options: DepthOptions) -> None:
        self._options = options
        self._videos, self._open = dict[Path, recordings.VideoReader | recordings.BagReader](), ExitStack()

    def close(self) -> None:
        """Close the videos."""
        self._open.close()

    def of(self, ref: PairRef) -> Sequence[np.ndarray] | None:
        """Left and right view of a pair of frames, ``(H, W, 3)`` in [0, 1]; ``None`` for one of files."""
        if (frame := ref.frame) is None:
            return None
        for path in {ref.left, ref.right or ref.left} - set(self._videos):
            bag = (self._options.bag_topics(), self._options.tolerance) if recordings.is_bag(path) else None
            reader: Any = recordings.VideoReader(path) if bag is None else recordings.BagReader(path, *bag)
            self._videos[path] = self._open.enter_context(reader)
        left = self._videos[ref.left].read(frame)
        if ref.right is None:
            return recordings.both_halves(left, "LEFT")
        return left, self._videos[ref.right].read(frame)
