"""Data sets in their official layouts (paper S5.1), and which of their samples a command takes."""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import bad_value
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.evaluation.datasets.layouts import LAYOUTS
from geodiff_plugin.evaluation.datasets.sample import (
    CHANGES,
    Dataset,
    SampleRef,
    StereoSample,
    changed_ref,
    two_numbers,
)
from geodiff_plugin.evaluation.options import SampleOptions

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
    """References to every metric pair of the ``datasets`` below ``root``; ``options`` are for some sets."""
    root = Path(root)
    refs = []
    for name in DATASETS if datasets is None else datasets:
        if name not in DATASETS:
            bad_value("datasets", f"one of {', '.join(DATASETS)}", repr(name))
        dataset = DATASETS[name]
        given = {key: options[key] for key in dataset.options if options.get(key) is not None}
        refs += dataset.find(root, **given)
    if not refs and not os.path.isdir(root):
        bad_value("root (DIR, --data)", "an existing folder", str(root))
    return refs


def data_of(options: Any) -> Path:
    """Where the samples are: what was given, or the pair that ships with the package."""
    return options.data or DEMO_PAIR_FOLDER


def all_refs(options: SampleOptions, datasets: Sequence[str] = ()) -> list[SampleRef]:
    """References to all samples of the data: of the named data sets, else of those that the options name."""
    given = {name: getattr(options, name, None) for name in ("pairs", "pixel_centre")}
    return find_pairs(data_of(options), datasets or options.datasets or None, **given)


def some_pairs(refs: Sequence[SampleRef], data: Path, scenes: Sequence[str] = ()) -> list[SampleRef]:
    """The samples whose label contains one of ``scenes``; ``ValueError`` for none, or for two of one name."""
    kept = [ref for ref in refs if not scenes or any(scene in ref.label for scene in scenes)]
    if not kept:
        there = ", ".join(ref.label for ref in refs) or "no sample of any known data set"
        wanted = f" with {', '.join(scenes)} in its name" if scenes else ""
        cure = (
            "A pair of your own is a folder of left.png, right.png, calib.txt and depth.npy. geodiff eval "
            "list says how to obtain the public ones; docs/how-to/extending.md adds others."
        )
        bad_value("DIR (--data)", f"a folder with a sample{wanted}", f"{data} with {there}", cure)
    # As two resolutions of a set have: records could not tell them apart.
    label, count = Counter(ref.label for ref in kept).most_common(1)[0]
    if count > 1:
        cure = "Name the folder of one of them, for instance that of one resolution."
        bad_value(
            "DIR (--data)", "a folder with one sample of each name", f"{data} with several {label}", cure
        )
    return kept


def select(options: SampleOptions, refs: Sequence[SampleRef] | None = None) -> list[SampleRef]:
    """The samples that ``scenes`` names, ``sample`` drawn of them, the first ``limit``, some perturbed."""
    kept = some_pairs(all_refs(options) if refs is None else refs, data_of(options), options.scenes)
    count = getattr(options, "sample", None)
    if count is not None:
        if count > len(kept):
            bad_value("--sample", f"at most {len(kept)}, the number of samples found", count)
        drawn = random.Random(options.seed).sample(range(len(kept)), count)
        kept = [kept[i] for i in sorted(drawn)]
    kept = kept[: options.limit]
    if options.perturb is None:
        return kept
    return [changed_ref(ref, "perturbed", two_numbers(options.perturb, "--perturb")) for ref in kept]
