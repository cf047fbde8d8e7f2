"""A stand-in for the parts of LeRobot 0.6.1 that ``examples/lerobot_depth.py`` uses, kept in memory.

Source: ``datasets/lerobot_dataset.py``, ``datasets/feature_utils.py`` (checks of a frame),
``datasets/dataset_reader.py`` and ``datasets/depth_utils.py`` (quantization) of huggingface/lerobot.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
DEPTH_MIN, SHIFT, CODES = 0.01, 3.5, 4095


@dataclass
class DepthEncoderConfig:
    depth_max: float = 10.0


def quantized(depth_m: np.ndarray, depth_max: float) -> np.ndarray:
    """Depth in metres after encoding as 12 bits, spaced logarithmically, and decoding."""
    low, high = np.log([DEPTH_MIN + SHIFT, depth_max + SHIFT])
    codes = np.rint((np.log(depth_m + SHIFT) - low) / (high - low) * CODES).clip(0, CODES)
    return np.exp(low + codes * (high - low) / CODES) - SHIFT


class LeRobotDataset:
    written: dict[Path, LeRobotDataset] = {}

    def __init__(self, repo_id: str, root: Any, return_uint8: bool = False, depth_output_unit: str = "mm"):
        self.__dict__ |= vars(self.written[Path(root)])
        self.as_uint8, self.factor = return_uint8, {"m": 1, "mm": 1000}[depth_output_unit]

    @classmethod
    def create(
        cls,
        repo_id: str,
        fps: int,
        features: dict[str, Any],
        root: Path,
        robot_type: str | None = None,
        depth_encoder: DepthEncoderConfig | None = None,
    ) -> LeRobotDataset:
        root.mkdir(parents=True)
        made = cls.written[root] = cls.__new__(cls)
        indices = {key: {"dtype": "int64", "shape": (1,), "names": None} for key in INDICES}
        made.fps, made.features = fps, features | indices
        depths = [key for key, each in features.items() if each.get("info", {}).get("is_depth_map")]
        made.meta = SimpleNamespace(depth_keys=depths, robot_type=robot_type)
        made.depth_max = (depth_encoder or DepthEncoderConfig()).depth_max
        made.frames, made.episode, made.pending, made.finalized = [], 0, 0, False
        return made

    def add_frame(self, frame: dict[str, Any]) -> None:
        assert set(frame) == set(self.features) - {*INDICES} | {"task"}
        for key, value in frame.items():
            if key != "task":
                feature = self.features[key]
                assert isinstance(value, np.ndarray) and value.shape == feature["shape"]
                assert feature["dtype"] in ("video", "image", value.dtype)
                if feature["dtype"] in ("video", "image"):
                    depth = key in self.meta.depth_keys
                    assert value.dtype == (np.float32 if depth else np.uint8)
        self.frames.append(frame | {"episode_index": self.episode})
        self.pending += 1

    def save_episode(self) -> None:
        assert self.pending
        self.episode, self.pending = self.episode + 1, 0

    def finalize(self) -> None:
        assert not self.pending
        self.finalized = True

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> dict[str, Any]:
        assert self.finalized
        item = dict(self.frames[index])
        item["episode_index"] = torch.tensor(item["episode_index"])
        for key, feature in self.features.items():
            if feature["dtype"] in ("video", "image"):
                value = torch.from_numpy(np.moveaxis(item[key], -1, 0).copy())
                if key not in self.meta.depth_keys:
                    item[key] = value if self.as_uint8 and feature["dtype"] == "video" else value / 255
                    continue
                if feature["dtype"] == "video":
                    value = torch.from_numpy(quantized(value.numpy(), self.depth_max)).float()
                item[key] = value * self.factor
            elif key not in INDICES:
                item[key] = torch.from_numpy(item[key]).squeeze()
        return item
