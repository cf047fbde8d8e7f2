"""Where the images show the same points: SIFT, learned matchers, and optical flow after a first depth."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from geodiff_plugin._checks import bad_value
from geodiff_plugin.geometry import plane_rays, project_rays
from geodiff_plugin.pose.tracks import Tracks
from geodiff_plugin.types import CameraView

#: Longer side of the left image that matches are sought on, pixels; residuals are in pixels of this grid.
LONG_SIDE = 832
# SIFT. The nearest descriptor must be nearer than this share of the second nearest (Lowe 2004). The number of
# points decides the time of matching. The contrast is low, so that blank walls give some points as well.
_RATIO, _MOST_POINTS, _CONTRAST = 0.8, 4000, 0.01
# Flow: one match a cell of so many pixels a side, whose grey has this standard deviation, of 255, or more.
# Flow there and back may differ by so many pixels; flow further than that is no correction of a warp.
_CELL_PX, _LEAST_CONTRAST, _THERE_AND_BACK_PX, _FARTHEST_PX = 10, 2.0, 0.5, 24.0
#: Weights of the learned matchers by name. SuperPoint's, which both use, are for research alone.
MATCHERS = {
    "lightglue": "ETH-CVG/lightglue_superpoint",
    "superglue": "magic-leap-community/superglue_outdoor",
}
_CLASSES = {"lightglue": "LightGlueForKeypointMatching", "superglue": "SuperGlueForKeypointMatching"}
# Left points of two pairs that agree to this share of a pixel are one point.
_SAME_PX = 0.25

FirstDepth = Callable[[Sequence[CameraView]], Tensor]
"""Right views with poses -> a rough depth ``(1, 1, h, w)`` of the left image, metres, without holes."""


@dataclass(frozen=True, eq=False)
class GreyViews:
    """Grey images ``(H, W)`` uint8 on the grid of the matches, all at about as many pixels per radian.

    Beside them ``K_left (3, 3)`` and ``K_rights (V, 3, 3)`` float64.
    """

    left: np.ndarray
    rights: tuple[np.ndarray, ...]
    K_left: np.ndarray
    K_rights: np.ndarray


Matcher = Callable[[GreyViews], Tracks]


def _grey(image_01: Tensor, K_image: Tensor, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """A grey image shrunk by a factor <= 1, and its K."""
    pixels = image_01.detach().cpu().float().permute(1, 2, 0).contiguous().numpy()
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if pixels.shape[-1] == 3 else pixels[..., 0]
    K = K_image.detach().cpu().double().numpy().copy()
    height, width = grey.shape
    size = max(1, round(width * factor)), max(1, round(height * factor))
    if factor < 1.0:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        scale = np.array([size[0] / width, size[1] / height])
        K[:2, :2] *= scale[:, None]
        K[:2, 2] = (K[:2, 2] + 0.5) * scale - 0.5
    return np.rint(grey * 255.0).clip(0, 255).astype(np.uint8), K


def grey_views(left_01: Tensor, rights: Sequence[CameraView], K_left: Tensor) -> GreyViews:
    """Images as matches are sought in them, of ``left_01 (3, H, W)`` in [0, 1] with its ``K_left (3, 3)``."""
    left, K = _grey(left_01, K_left, min(1.0, LONG_SIDE / max(left_01.shape[-2:])))
    small = []
    for image, K_right, _ in rights:
        as_fine = float(K[0, 0] / K_right[0, 0])
        small.append(_grey(image, K_right, min(1.0, as_fine, 2 * LONG_SIDE / max(image.shape[-2:]))))
    return GreyViews(left, tuple(grey for grey, _ in small), K, np.stack([K_right for _, K_right in small]))


def sift_features(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points ``(N, 2)`` float64 of a grey image ``(H, W)`` uint8, the centre of its first pixel at (0, 0).

    With RootSIFT ``(N, 128)`` float32 of unit length (Arandjelovic and Zisserman 2012).
    """
    sift = cv2.SIFT.create(nfeatures=_MOST_POINTS, contrastThreshold=_CONTRAST)
    points, descriptors = sift.detectAndCompute(grey, None)
    if not points:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-7))
    return np.array([p.pt for p in points], np.float64), root.astype(np.float32)


def match_features(left: tuple[np.ndarray, np.ndarray], right: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Indices ``(M, 2)`` of features that are each other's nearest and pass the ratio test from the left."""
    if min(len(left[0]), len(right[0])) < 2:
        return np.zeros((0, 2), int)
    alike = left[1] @ right[1].T  # unit vectors: distance^2 = 2 - 2 alike
    rows = np.arange(len(alike))
    best = alike.argmax(1)
    nearest = alike[rows, best]
    mutual = alike.argmax(0)[best] == rows
    alike[rows, best] = -1.0
    second = alike.max(1)
    kept = mutual & ((1.0 - nearest) < _RATIO**2 * (1.0 - second))
    return np.c_[rows[kept], best[kept]]


def sparse_tracks(views: GreyViews) -> Tracks:
    """SIFT points of the left image with their matches in the right ones."""
    left = sift_features(views.left)
    right_px = np.zeros((len(views.rights), len(left[0]), 2))
    seen = np.zeros(right_px.shape[:2], bool)
    for v, image in enumerate(views.rights):
        right = sift_features(image)
        of_left, of_right = match_features(left, right).T
        right_px[v, of_left], seen[v, of_left] = right[0][of_right], True
    return Tracks(left[0], right_px, seen, views.K_left, views.K_rights).seen_anywhere()


def _flow(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Dense inverse search (Kroeger et al. 2016), ``(H, W, 2)`` pixels."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)
    return dis.calc(source, target, None)


def _read(field: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Values of a map ``(H, W, 2)`` at pixels ``(N, 2)``, bilinear."""
    at = px.astype(np.float32)[:, None]
    return cv2.remap(field, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]


def _dense_matches(
    left: np.ndarray, right: np.ndarray, uv: np.ndarray, visible: np.ndarray, centres: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Right pixels ``(N, 2)`` of cell centres, which ``uv`` predicts, and which of them hold."""
    warped = cv2.remap(right, uv, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    there, back = _flow(left, warped), _flow(warped, left)
    flow = _read(there, centres)
    landed = centres + flow
    off = np.linalg.norm(flow + _read(back, landed), axis=1)
    column, row = np.clip(np.rint(landed), 0, (left.shape[1] - 1, left.shape[0] - 1)).astype(int).T
    values, window = left.astype(np.float32), (_CELL_PX + 1,) * 2
    spread = cv2.blur(values**2, window) - cv2.blur(values, window) ** 2
    holds = (off < _THERE_AND_BACK_PX) & (np.linalg.norm(flow, axis=1) < _FARTHEST_PX) & visible[row, column]
    holds &= spread[centres[:, 1], centres[:, 0]] > _LEAST_CONTRAST**2
    holds &= ((landed >= 0) & (landed <= np.array(left.shape[::-1]) - 1)).all(1)
    return _read(uv, landed).astype(np.float64), holds


def dense_tracks(views: GreyViews, depth_m: Tensor, Ts: np.ndarray) -> Tracks:
    """The centres of the left image's cells with their places by optical flow in the right images.

    ``depth_m (1, 1, H, W)`` is rough, on the left grid, without holes, and goes with the poses ``Ts
    (V, 4, 4)``, ``T_right_from_left``.
    """
    size = views.left.shape
    rows, columns = (np.arange(_CELL_PX // 2, side, _CELL_PX) for side in size)
    centres = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    right_px = np.zeros((len(Ts), len(centres), 2))
    seen = np.zeros((len(Ts), len(centres)), bool)
    for v, (image, K, T) in enumerate(zip(views.rights, views.K_rights, Ts, strict=True)):
        K_left, K_right, T_right = (
            torch.as_tensor(m, dtype=torch.float32, device="cpu")[None] for m in (views.K_left, K, T)
        )
        rays = plane_rays(K_left, K_right, T_right, (size[0], size[1]))
        uv, z = (part[0].numpy() for part in project_rays(depth_m, rays))
        visible = (uv >= 0).all(-1) & (uv <= np.array(image.shape[::-1]) - 1).all(-1) & (z > 0)
        right_px[v], seen[v] = _dense_matches(views.left, image, uv, visible, centres)
    return Tracks(centres.astype(np.float64), right_px, seen, views.K_left, views.K_rights).seen_anywhere()


def find_matcher(name: str) -> Matcher:
    """The matcher of a name.

    ``"sift"``; ``"lightglue"`` or ``"superglue"`` for weights that the hub's cache holds; or a folder or hub
    id with weights of either. Nothing is downloaded, and no code of a folder is run. Raises ``InputError``
    where no such weights are on this machine, or none that fit.
    """
    if name == "sift":
        return sparse_tracks
    folder = _folder(name)
    model, asked = _load(folder), _entries(folder / "preprocessor_config.json").get("size", {})
    size = asked.get("height", 480), asked.get("width", 640)

    def matched(views: GreyViews) -> Tracks:
        pairs = [_learned_pair(model, views.left, right, size) for right in views.rights]
        return Tracks(*_joined(pairs), views.K_left, views.K_rights)

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
    """The entries of a JSON file; none where it cannot be read."""
    try:
        return dict(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}


def _load(folder: Path) -> Any:
    kind = _entries(folder / "config.json").get("model_type")
    if kind not in MATCHERS:
        bad_value(f"matcher in {folder}", f"one of {' or '.join(MATCHERS)}", f"one of type {kind!r}")
    import transformers

    weights = f"weights of the matcher in {folder}"
    try:
        model, loading = getattr(transformers, _CLASSES[kind]).from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # whatever a damaged file makes of it
        bad_value(weights, "readable safetensors", f"{type(error).__name__}: {error}")
    if missing := sorted(loading["missing_keys"]):
        bad_value(weights, "those of its config", f"{len(missing)} missing, such as {missing[0]}")
    return model.eval()


def _learned_pair(
    model: Any, left: np.ndarray, right: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Matched pixels ``(M, 2)`` of two grey images, the centre of the first pixel at (0, 0)."""
    resized = [cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA) for image in (left, right)]
    values = torch.from_numpy(np.stack(resized).astype(np.float32) / 255.0)
    with torch.no_grad():
        out = model(pixel_values=values[None, :, None].expand(1, 2, 3, *size))
    keypoints, matches = out.keypoints[0].double().numpy(), out.matches[0, 0].numpy()
    of_left, scale = np.flatnonzero(matches > -1), np.array(size[::-1])
    left_px, right_px = (
        (points * scale + 0.5) * np.array(image.shape[::-1]) / scale - 0.5
        for points, image in ((keypoints[0][of_left], left), (keypoints[1][matches[of_left]], right))
    )
    return left_px, right_px


def _joined(pairs: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left points of all pairs, each once, with their places in every right image and where they have one."""
    keys = [np.rint(left_px / _SAME_PX).astype(int) for left_px, _ in pairs]
    unique = np.unique(np.concatenate(keys), axis=0)
    row_of = {tuple(key): row for row, key in enumerate(unique)}
    right_px, seen = np.zeros((len(pairs), len(unique), 2)), np.zeros((len(pairs), len(unique)), bool)
    left_px = unique * _SAME_PX
    for v, (key_of, (left, right)) in enumerate(zip(keys, pairs, strict=True)):
        rows = np.array([row_of[tuple(key)] for key in key_of], dtype=int)
        left_px[rows], right_px[v, rows], seen[v, rows] = left, right, True
    return left_px, right_px, seen
