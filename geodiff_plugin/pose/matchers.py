"""Matches of distinct points by name: SIFT, or a learned matcher whose weights the user has.

Data flow: name -> matcher: grey views -> tracks.
Paper: none; Lindenberger et al. 2023 (LightGlue), Sarlin et al. 2020 (SuperGlue), by transformers.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.pose.tracks import Tracks
from geodiff_plugin.pose.views import GreyViews, sparse_tracks

__all__ = ["MATCHERS", "Matcher", "find_matcher"]

Matcher = Callable[[GreyViews], Tracks]

#: Short names of learned matchers -> hub ids. SuperPoint's points, which both use, are for research alone.
MATCHERS = {
    "lightglue": "ETH-CVG/lightglue_superpoint",
    "superglue": "magic-leap-community/superglue_outdoor",
}
#: What they are of in transformers, by ``model_type``.
_CLASSES = {"lightglue": "LightGlueForKeypointMatching", "superglue": "SuperGlueForKeypointMatching"}
#: Both photographs are brought to this size where the folder does not say, ``(height, width)``.
_SIZE = (480, 640)
#: Left points of two pairs that agree to this share of a pixel are one.
_SAME_PX = 0.25


def find_matcher(name: str) -> Matcher:
    """The matcher of a name.

    Args:
        name: ``"sift"``; ``"lightglue"`` or ``"superglue"`` for weights that the hub's cache holds; or a
            folder or hub id with weights of either. Nothing is downloaded, and no code of a folder is run.

    Raises:
        ValueError: no such weights on this machine, or none that fit.
    """
    if name == "sift":
        return sparse_tracks
    folder = _folder(name)
    model = _load(folder)
    size = _size(folder)

    def matched(views: GreyViews) -> Tracks:
        pairs = [_pair(model, views.left, right, size) for right in views.rights]
        left_px, right_px, seen = _joined(pairs)
        return Tracks(left_px, right_px, seen, views.K_left, views.K_rights)

    return matched


def _folder(name: str) -> Path:
    if Path(name).is_dir():
        return Path(name)
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError

    hub_id = MATCHERS.get(name, name)
    try:
        return Path(snapshot_download(hub_id, local_files_only=True))
    except (LocalEntryNotFoundError, HFValidationError, OSError):
        expected = f"'sift', {', '.join(map(repr, MATCHERS))}, a folder, or a hub id whose weights are cached"
        bad_value("matcher", expected, repr(name), f"Fetch it once while online: hf download {hub_id}.")


def _entries(file: Path) -> dict[str, Any]:
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _size(folder: Path) -> tuple[int, int]:
    size = _entries(folder / "preprocessor_config.json").get("size")
    if not isinstance(size, dict):
        return _SIZE
    height, width = size.get("height"), size.get("width")
    if not (isinstance(height, int) and isinstance(width, int)):
        return _SIZE
    return min(max(height, 16), 4096), min(max(width, 16), 4096)


def _load(folder: Path) -> Any:
    config = _entries(folder / "config.json")
    kind, points = config.get("model_type"), config.get("keypoint_detector_config")
    detector = points.get("model_type") if isinstance(points, dict) else None
    if kind not in _CLASSES or detector not in (None, "superpoint"):
        got = f"one of type {kind!r}" + ("" if detector is None else f" on points of type {detector!r}")
        bad_value(f"matcher in {folder}", f"one of {' or '.join(_CLASSES)}, on SuperPoint's points", got)
    if not any(folder.glob("*.safetensors")):
        bad_value(f"weights of the matcher in {folder}", "safetensors", "none of them")
    import transformers

    try:
        model, found = getattr(transformers, _CLASSES[kind]).from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # whatever a damaged file makes of it
        bad_value(f"weights of the matcher in {folder}", "readable", f"{type(error).__name__}: {error}")
    left_out = sorted(found["missing_keys"])
    if left_out or found.get("mismatched_keys"):
        got = f"{len(left_out)} missing, such as {left_out[0]}" if left_out else "some of another shape"
        bad_value(f"weights of the matcher in {folder}", "those of its config, name by name", got)
    return model.eval()


def _pair(
    model: Any, left: np.ndarray, right: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Matched pixels ``(M, 2)`` of two grey images, the centre of the first pixel at (0, 0)."""
    resized = [cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA) for image in (left, right)]
    values = torch.from_numpy(np.stack(resized).astype(np.float32) / 255.0)
    with torch.no_grad():
        out = model(pixel_values=values[None, :, None].expand(1, 2, 3, *size))
    keypoints, matches = out.keypoints[0].double().numpy(), out.matches[0, 0].numpy()
    of_left = np.flatnonzero(matches > -1)
    found = []
    for points, image in ((keypoints[0][of_left], left), (keypoints[1][matches[of_left]], right)):
        index = points * np.array(size[::-1])  # of pixels at the model's size
        found.append((index + 0.5) * np.array(image.shape[::-1]) / np.array(size[::-1]) - 0.5)
    return found[0], found[1]


def _joined(
    pairs: list[tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left points of all pairs, each once, with their places in every right image and where they have one."""
    keys = [np.rint(left_px / _SAME_PX).astype(int) for left_px, _ in pairs]
    unique = np.unique(np.concatenate(keys), axis=0)
    row_of = {tuple(key): row for row, key in enumerate(unique)}
    right_px, seen = np.zeros((len(pairs), len(unique), 2)), np.zeros((len(pairs), len(unique)), bool)
    left_px = unique * _SAME_PX
    for v, (own, (left, right)) in enumerate(zip(keys, pairs, strict=True)):
        rows = np.array([row_of[tuple(key)] for key in own], dtype=int)
        left_px[rows], right_px[v, rows], seen[v, rows] = left, right, True
    return left_px, right_px, seen
