"""Data sets in their official layouts (paper S5.1), and the selection of samples."""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.evaluation.datasets.layouts import LAYOUTS
from geodiff_plugin.evaluation.datasets.middlebury import MIDDLEBURY
from geodiff_plugin.evaluation.datasets.sample import (
    CHANGES,
    Dataset,
    SampleRef,
    StereoSample,
    changed_ref,
    two_numbers,
)
from geodiff_plugin.evaluation.datasets.scannet import SCANNET
from geodiff_plugin.evaluation.datasets.splits import split_of
from geodiff_plugin.evaluation.options import SampleOptions

__all__ = ["DATASETS", "Dataset", "SampleRef", "StereoSample", "find_pairs", "load"]

#: All data sets by name, in the order of the results.
DATASETS: dict[str, Dataset] = {dataset.name: dataset for dataset in (*LAYOUTS, *MIDDLEBURY, SCANNET)}


def load(ref: SampleRef) -> StereoSample:
    """Read the sample of ``ref``, and apply its change."""
    sample = DATASETS[ref.dataset].load(ref)
    for key, (_, changed) in CHANGES.items():
        if key in ref.files:
            sample = changed(sample, ref.files[key], ref.name)
    return sample


def find_pairs(root: str | Path, datasets: Iterable[str] | None = None, **options: object) -> list[SampleRef]:
    """Find references to all metric pairs of the ``datasets`` in ``root``; ``options`` apply to some sets."""
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
    """Return the folder of the samples: the given one, or the bundled pair."""
    return options.data or DEMO_PAIR_FOLDER


def all_refs(options: SampleOptions, datasets: Sequence[str] = ()) -> list[SampleRef]:
    """Return references to all samples of the named data sets, or of those in the options."""
    given = {name: getattr(options, name, None) for name in ("pairs", "pixel_centre")}
    return find_pairs(data_of(options), datasets or options.datasets or None, **given)


def in_split(refs: Sequence[SampleRef], split: str, data: Path) -> list[SampleRef]:
    """Return samples of a split, a key of ``SPLITS``, or all for "all"; ``ValueError`` if there are none."""
    kept = [ref for ref in refs if split == "all" or split_of(ref.dataset, ref.name) == split]
    if refs and not kept:
        found = ", ".join(ref.label for ref in refs)
        hint = "geodiff_plugin/evaluation/datasets/splits.toml lists both splits."
        bad_value(
            "DIR (--data)", f"a folder with a sample of the split '{split}'", f"{data} with {found}", hint
        )
    return kept


def some_pairs(refs: Sequence[SampleRef], data: Path, scenes: Sequence[str] = ()) -> list[SampleRef]:
    """Return samples whose label contains one of ``scenes``; ``ValueError`` for none, or equal labels."""
    kept = [ref for ref in refs if not scenes or any(scene in ref.label for scene in scenes)]
    if not kept:
        found = ", ".join(ref.label for ref in refs) or "no sample of any known dataset"
        wanted = f" with {', '.join(scenes)} in its name" if scenes else ""
        hint = (
            "For your own pair, create a folder with left.png, right.png, calib.txt and depth.npy. "
            "geodiff eval list states how to obtain public datasets; docs/how-to/extending.md describes "
            "how to add others."
        )
        bad_value("DIR (--data)", f"a folder with a sample{wanted}", f"{data} with {found}", hint)
    # E.g. two resolutions of a set, whose records would be indistinguishable.
    label, count = Counter(ref.label for ref in kept).most_common(1)[0]
    if count > 1:
        hint = "Pass the folder of one of them, such as one resolution."
        bad_value(
            "DIR (--data)", "a folder with one sample of each name", f"{data} with several {label}", hint
        )
    return kept


def select(options: SampleOptions, refs: Sequence[SampleRef] | None = None) -> list[SampleRef]:
    """Select samples by ``split`` and ``scenes``, draw ``sample``, keep the first ``limit``, perturb them."""
    data = data_of(options)
    refs = in_split(all_refs(options) if refs is None else refs, getattr(options, "split", "all"), data)
    kept = some_pairs(refs, data, options.scenes)
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
