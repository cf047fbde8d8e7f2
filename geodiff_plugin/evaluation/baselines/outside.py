"""Depth that others compute: models of transformers, and maps in files (paper S5.1)."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines.base import (
    Method,
    NotApplicable,
    Prediction,
    PriorCache,
    Settings,
    folder_fingerprint,
)
from geodiff_plugin.evaluation.baselines.guided import (
    call_arguments,
    guidance_for,
    guided_configuration,
    guided_prediction,
)
from geodiff_plugin.evaluation.datasets.sample import StereoSample, disparity_to_depth, read_depth_m, read_npy
from geodiff_plugin.formats import read_depth_png, read_pfm
from geodiff_plugin.guidance.guidance import GeometryGuidance


def hf_method(name: str) -> Method:
    """A depth checkpoint of transformers, hub id or folder; relative ones are scored aligned only.

    It is loaded when it is first run, where errors are those of ``load_prior``.
    """
    if not name:
        bad_value("methods", "hf:MODEL with a hub id or a folder", "'hf:'")

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        left_01 = torch.from_numpy(sample.left).permute(2, 0, 1)[None].to(settings.device) / 255.0
        model = priors.depth_model(name, settings)
        values = model.predict(left_01, sample.left.shape[:2])[0, 0]
        depth_m = model.metres(values).cpu().numpy() if model.metric else None
        return Prediction(depth_m, relative=values.cpu().numpy(), space=model.config.prediction_type)

    def configuration(settings: Settings) -> dict[str, Any]:
        files = folder_fingerprint(Path(name))
        return {"device": settings.device, "dtype": settings.dtype, "files": files}

    title = Path(name).name
    return Method(f"hf:{name}", title, f"{title} by transformers", run, configuration, uses_prior=False)


KINDS = {
    "depth": "metres",
    "disparity": "pixels of the left view, rectified pairs",
    "relative-depth": "depth up to scale and shift",
    "relative-disparity": "inverse depth up to scale and shift",
}
"""What the maps of a folder are; ``depth`` unless the method says otherwise."""
_SUFFIXES = (".npy", ".pfm", ".png")


def map_name(dataset: str, sample: str) -> str:
    """Name of a sample's map without its suffix, the one that ``--save-depth`` writes."""
    return f"{dataset}_{sample}"


def _read(path: Path, kind: str) -> np.ndarray:
    """``(H, W)`` float64; NaN where it is not known: 0 in metric maps and PNG files, not finite anywhere."""
    signed = False
    if kind == "depth":
        values = read_depth_m(path, "map")
    elif path.suffix == ".png":
        values, _ = read_depth_png(path, 256.0, "map")
    else:
        values = read_pfm(path, "map") if path.suffix == ".pfm" else read_npy(path, "map")
        signed = kind.startswith("relative")
    known = np.isfinite(values) & (signed | (values > 0))
    return np.where(known, values.astype(np.float64), np.nan)


def _prediction(values: np.ndarray, sample: StereoSample, kind: str) -> Prediction:
    """A map at the image's size; bilinear, so that a hole grows by the pixels that it mixes into."""
    size, resized = sample.left.shape[:2], values
    if values.shape != tuple(size):
        given = torch.from_numpy(values)[None, None]
        resized = F.interpolate(given, tuple(size), mode="bilinear", align_corners=False)[0, 0].numpy()
    if kind.startswith("relative"):
        return Prediction(None, relative=resized, space=kind.removeprefix("relative-"))
    if kind == "depth":
        return Prediction(resized)
    if not sample.rectified:
        raise NotApplicable("not rectified")
    disparity_px = resized * (size[1] / values.shape[1])  # pixels of the map -> pixels of the image
    depth_m = disparity_to_depth(disparity_px, sample.K_left, sample.K_right, sample.E)
    return Prediction(np.where(depth_m > 0, depth_m, np.nan), space="disparity")


def files_method(text: str, guided: bool = False) -> Method:
    """Maps that were made elsewhere, in a folder: files:DIR or files:KIND:DIR; prior-map:DIR guides them.

    Args:
        text: ``DIR`` or ``KIND:DIR`` with a key of ``KINDS``. The map of a sample is
            ``DIR/<dataset>_<sample>`` with the suffix .npy, .pfm or .png (16 bit: millimetres for depth,
            pixels * 256 for disparity), of any size; 0 and what is not finite is unknown. The method does
            not apply to samples without a file.
        guided: the maps are the prior of the default preset.

    Raises:
        ValueError: no such folder. When run: a file that is damaged.
    """
    kind, colon, named = text.partition(":")
    if not (colon and kind in KINDS):
        kind, named = "depth", text
    folder = Path(named)
    if not named or not os.path.isdir(folder):
        cure = f"KIND is one of {', '.join(KINDS)}."
        bad_value("methods", "files:DIR or files:KIND:DIR with an existing folder", repr(text), cure)

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        stem = map_name(sample.dataset, sample.name)
        path = next((folder / (stem + s) for s in _SUFFIXES if (folder / (stem + s)).is_file()), None)
        if path is None:
            raise NotApplicable("no map in the folder")
        values = _read(path, kind)
        if not guided:
            return _prediction(values, sample, kind)
        pipe = priors.get(replace(settings, prior="map", space=kind.removeprefix("relative-")))
        guidance = guidance_for(sample, settings, priors, GeometryGuidance)
        call = call_arguments(replace(settings, steps=None, ensemble=1)) | {"depth_map": values}
        return guided_prediction(pipe, sample, guidance, call)

    def configuration(settings: Settings) -> dict[str, Any]:
        maps = {"kind": kind, "files": folder_fingerprint(folder)}
        return maps | (guided_configuration(GeometryGuidance, settings) if guided else {})

    title = f"guided {folder.resolve().name}" if guided else folder.resolve().name
    summary = f"maps of {folder.resolve().name} ({KINDS[kind]})" + (", guided" if guided else "")
    name = f"{'prior-map' if guided else 'files'}:{text}"
    return Method(name, title, summary, run, configuration, uses_prior=False)
