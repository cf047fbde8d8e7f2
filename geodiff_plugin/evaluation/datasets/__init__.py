"""Data sets in their official layouts (paper S5.1, Tables 1 to 3), and one table of them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.datasets.layouts import LAYOUTS
from geodiff_plugin.evaluation.datasets.sample import CHANGES, Dataset, SampleRef, StereoSample

__all__ = ["DATASETS", "Dataset", "SampleRef", "StereoSample", "find_pairs", "load"]

#: Every data set by name, in the order in which results are listed.
DATASETS: dict[str, Dataset] = {dataset.name: dataset for dataset in LAYOUTS}


def load(ref: SampleRef) -> StereoSample:
    """Read the sample that ``ref`` points to, and change it as ``ref`` asks."""
    sample = DATASETS[ref.dataset].load(ref)
    for key, (_, changed) in CHANGES.items():
        if key in ref.files:
            sample = changed(sample, ref.files[key], ref.name)
    return sample


def find_pairs(root: str | Path, datasets: Iterable[str] | None = None, **options: object) -> list[SampleRef]:
    """References to every metric pair of the ``datasets``, all by default, below ``root``, in their order.

    ``options`` are for the sets that know them (``pairs``, ``pixel_centre``); ``None`` is their default.
    ``ValueError`` where ``root`` is no folder, or for a name that is not in ``DATASETS``.
    """
    root = Path(root)
    refs = []
    for name in DATASETS if datasets is None else datasets:
        if name not in DATASETS:
            bad_value("datasets", f"one of {', '.join(DATASETS)}", repr(name))
        dataset = DATASETS[name]
        given = {key: options[key] for key in dataset.options if options.get(key) is not None}
        refs += dataset.find(root, **given)
    if not refs and not os.path.isdir(root):
        bad_value("root", "an existing folder", str(root))
    return refs
