"""Resumable runs of methods over samples, in one process or several.

Data flow: references + methods + settings -> records in ``samples.jsonl``.
Paper: S5.1.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import PartialState
from tqdm import tqdm

from geodiff_plugin import __version__
from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines import find_method
from geodiff_plugin.evaluation.baselines.base import Method, NotApplicable, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.baselines.files import map_name
from geodiff_plugin.evaluation.crops import crop_mask
from geodiff_plugin.evaluation.datasets import DATASETS, load
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample
from geodiff_plugin.evaluation.records import append_record, clean_records, read_records, record_key
from geodiff_plugin.evaluation.scoring import score
from geodiff_plugin.formats import write_depth_npy
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.runtime.machine import PeakMemory

__all__ = ["RECORDS_NAME", "headline", "processes", "run"]

RECORDS_NAME = "samples.jsonl"
_BROKEN = (OSError, ValueError)


def processes(settings: Settings) -> PartialState:
    """The processes of this run, one or as many as ``torchrun`` or ``accelerate launch`` started.

    On the CPU accelerate needs ``cpu=True``, or it takes several processes for several runs of one.
    """
    return PartialState(cpu=torch.device(settings.device).type == "cpu")


def headline(record: dict[str, Any]) -> float | None:
    """AbsRel over all pixels with truth: not aligned, or aligned for a method without metres."""
    if record["status"] != "ok":
        return None
    both = record["all_pixels"]
    return (both["raw"] or both["aligned"])["abs_rel"]


def _keys(
    refs: Sequence[SampleRef],
    methods: Iterable[Method],
    settings: Settings,
    fingerprint: Callable[[Settings], str],
    crop: str,
) -> dict[tuple[str, str], str]:
    """``(label, method)`` -> key of its record, the same in every process."""
    keys = {}
    for method in methods:
        own, prior = method.own_settings(settings), ""
        if method.uses_prior:
            prior = f"{own.prior} {fingerprint(own)}"
        configuration = method.configuration(own) | ({} if crop == "none" else {"crop": crop})
        for ref in refs:
            key = record_key(ref, method.base_name, configuration, prior, __version__)
            keys[ref.label, method.name] = key
    return keys


@lru_cache(maxsize=1)
def _cropped(sample: StereoSample, crop: str) -> StereoSample:
    """The sample with the truth inside of a crop only; images and cameras stay whole.

    One object for all methods, so that scoring computes once what depends on the sample only.
    """
    if crop == "none":
        return sample
    valid = sample.valid & crop_mask(crop, sample.valid.shape)
    if not valid.any():
        bad_value(f"the truth of {sample.label}", f"known somewhere in the crop {crop!r}", "unknown there")
    return replace(sample, valid=valid)


def _measure(
    method: Method, sample: StereoSample, settings: Settings, priors: PriorCache, crop: str
) -> tuple[dict[str, Any], Prediction | None]:
    """Run and score one method on one sample; its seconds are those that it takes alone."""
    priors.evidence.take_spared_seconds()
    start = time.perf_counter()
    try:
        with PeakMemory(torch.device(settings.device)) as memory:
            prediction = method.run(sample, method.own_settings(settings), priors)
    except NotApplicable as reason:
        return {"status": "not applicable", "reason": str(reason)}, None
    seconds = time.perf_counter() - start + priors.evidence.take_spared_seconds()
    scores = score(_cropped(sample, crop), prediction, DATASETS[sample.dataset].cap_m)
    notes = {"sample": dict(sample.notes), "method": dict(prediction.notes)}
    cost = {"seconds": round(seconds, 3), "peak_bytes": memory.peak_bytes}
    return {"status": "ok", **cost, **scores, "notes": notes}, prediction


def _depth_path(depth_folder: Path, ref: SampleRef, method: Method) -> Path:
    """Where the depth map of a method and a sample is saved."""
    own_folder = depth_folder / re.sub(r"[^\w.=+-]+", "_", method.name)
    return own_folder / f"{map_name(ref.dataset, ref.name)}.npy"


def _lacks_map(record: dict[str, Any], path: Path) -> bool:
    """Whether a finished record is of a metric map that is not saved, or in whose place another run's is."""
    if record["status"] != "ok" or record["all_pixels"]["raw"] is None:
        return False
    return not path.is_file() or record.get("map") != file_digest(path)


def _finish(
    ref: SampleRef,
    method: Method,
    sample: StereoSample | None,
    settings: Settings,
    priors: PriorCache,
    crop: str,
    skip_broken: bool,
    depth_folder: Path | None,
) -> tuple[dict[str, Any], StereoSample | None]:
    """Body of one record, and the sample, which is read only once; errors as ``run``."""
    try:
        sample = load(ref) if sample is None else sample
        body, prediction = _measure(method, sample, settings, priors, crop)
    except _BROKEN as error:
        if not skip_broken:
            raise
        return {"status": "broken", "error": str(error)}, sample
    if depth_folder is not None and prediction is not None and prediction.depth_m is not None:
        target = _depth_path(depth_folder, ref, method)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_depth_npy(target, prediction.depth_m)
        body["map"] = file_digest(target)
    return {"rectified": sample.rectified} | body, sample


class _RunningMeans:
    """A progress bar that shows each method's AbsRel so far."""

    def __init__(self, total: int, shown: bool) -> None:
        self._bar = tqdm(total=total, disable=not shown, unit="run")
        self._values: dict[str, list[float]] = {}

    def __enter__(self) -> _RunningMeans:
        return self

    def __exit__(self, *exc: object) -> None:
        self._bar.close()

    def add(self, record: dict[str, Any]) -> None:
        value = headline(record)
        if value is not None:
            self._values.setdefault(record["method"], []).append(value)
            self._bar.set_postfix({name: f"{np.mean(own):.3f}" for name, own in self._values.items()})
        self._bar.update()


def run(
    refs: Sequence[SampleRef],
    methods: Sequence[str],
    settings: Settings,
    out: str | Path,
    *,
    crop: str = "none",
    skip_broken: bool = False,
    save_depth: bool = False,
    progress: bool = True,
) -> list[dict[str, Any]]:
    """Run every method on every sample, but for what ``out`` already holds.

    Started by ``torchrun`` or ``accelerate launch``, the processes share the samples among them.

    Args:
        refs: samples.
        methods: names that ``find_method`` knows.
        settings: the user's choices, the same for every method.
        out: folder of ``samples.jsonl``; made where missing.
        crop: region of the image that is scored, one of ``crops.CROPS``.
        skip_broken: go on after a sample that cannot be read or measured; its record says why.
        save_depth: write each metric depth map to ``out/depth/<method>/<dataset>_<sample>.npy``, where the
            method ``files:out/depth/<method>`` finds it; what is finished but has no map, or that of other
            settings, is run again.
        progress: show a bar with each method's running AbsRel.

    Returns:
        The records of these samples and methods, in the order of ``refs`` and ``methods``: ``status`` is
        ``"ok"``, ``"not applicable"`` (``reason``) or ``"broken"`` (``error``); for the numbers see
        ``scoring.score``.

    Raises:
        ValueError: an unknown method, no samples, or a broken sample without ``skip_broken``.
        OSError: a missing or unreadable file without ``skip_broken``.
    """
    chosen = [find_method(name) for name in methods]
    state, priors, out = processes(settings), PriorCache(), Path(out)
    path = out / RECORDS_NAME
    if state.is_main_process:
        out.mkdir(parents=True, exist_ok=True)
        clean_records(path)
    state.wait_for_everyone()
    shared_cuda = state.num_processes > 1 and settings.device == "cuda"
    device = str(state.device) if shared_cuda else settings.device
    local = replace(settings, device=device)
    keys = _keys(refs, chosen, settings, lambda own: priors.fingerprint(replace(own, device=device)), crop)
    finished = {record["key"]: record for record in read_records(path) if "key" in record}
    mine = list(refs)[state.process_index :: state.num_processes]
    depth_folder = out / "depth" if save_depth else None
    with _RunningMeans(len(mine) * len(chosen), progress and state.is_main_process) as bar:
        for ref in mine:
            sample = None
            for method in chosen:
                key = keys[ref.label, method.name]
                record = finished.get(key)
                if record and depth_folder and _lacks_map(record, _depth_path(depth_folder, ref, method)):
                    record = None
                if record is None:
                    body, sample = _finish(
                        ref, method, sample, local, priors, crop, skip_broken, depth_folder
                    )
                    head = {"key": key, "dataset": ref.dataset, "sample": ref.name, "method": method.name}
                    record = head | body | {"process": state.process_index}
                    append_record(path, record)
                bar.add(record | {"method": method.name})
    state.wait_for_everyone()
    written = {record["key"]: record for record in read_records(path)}
    # A record does not depend on whether its prior or seed was the first that was named or a further one.
    return [
        written[keys[ref.label, method.name]] | {"method": method.name} for ref in refs for method in chosen
    ]
