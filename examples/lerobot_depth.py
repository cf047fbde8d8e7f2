"""Add metric depth to a LeRobot dataset that contains both images of a stereo rig.

SOURCE is a dataset, as a folder or a Hub ID. The script copies it to a new folder and adds the feature
``observation.depth``. By default it runs offline on a small dataset of the bundled pair:

    python -m examples.lerobot_depth
    python -m examples.lerobot_depth recorded/ --calib calib.txt --out with-depth \
        --left observation.images.left --right observation.images.right

It needs Python 3.12 and ``pip install "lerobot[dataset]>=0.6.1"``. Videos are decoded and encoded again. If
the calibration has lens distortion, the left images are stored without it, as the depth is.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin import Rig, StereoFrame, enable_geometry_guidance, live, load_prior, read_calibration
from geodiff_plugin.bundled.demo_pair import read_demo_pair

DEPTH = "observation.depth"
#: Features that LeRobot adds itself.
ADDED = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def image_feature(height: int, width: int, channels: int, dtype: str = "video") -> dict[str, Any]:
    """Return LeRobot's description of images, stored as a video or one by one (``"image"``)."""
    return {"dtype": dtype, "shape": (height, width, channels), "names": ["height", "width", "channels"]}


def open_dataset(source: str | Path) -> Any:
    """Open a dataset with uint8 images and depth in metres."""
    from lerobot.datasets import LeRobotDataset

    root = source if Path(source).is_dir() else None
    return LeRobotDataset(str(source), root=root, return_uint8=True, depth_output_unit="m")


def record(folder: Path, episodes: list[int], left: np.ndarray, right: np.ndarray) -> None:
    """Record episodes of the given lengths that show one pair ``(H, W, 3)`` uint8, for a demonstration."""
    from lerobot.datasets import LeRobotDataset

    sides = {"observation.images.left": left, "observation.images.right": right}
    features = {key: image_feature(*image.shape) for key, image in sides.items()}
    features["observation.state"] = {"dtype": "float32", "shape": (1,), "names": ["joint"]}
    dataset = LeRobotDataset.create("local/recorded", fps=10, features=features, root=folder)
    for length in episodes:
        for i in range(length):
            dataset.add_frame(sides | {"observation.state": np.array([i], np.float32), "task": "look"})
        dataset.save_episode()
    dataset.finalize()


def channels_last(value: Any) -> np.ndarray:
    """Convert an image ``(3, H, W)`` to ``(H, W, 3)`` uint8, and depth ``(1, H, W)`` to ``(H, W, 1)``."""
    image = np.moveaxis(np.asarray(value), 0, -1)
    if image.shape[-1] == 3 and image.dtype != np.uint8:
        image = np.rint(image * 255).astype(np.uint8)
    return np.ascontiguousarray(image)


def to_frame(item: dict[str, Any], features: dict[str, Any]) -> dict[str, Any]:
    """Convert a frame that was read to the form that ``add_frame`` expects."""
    frame = {"task": item["task"]}
    for key, feature in features.items():
        if feature["dtype"] in ("image", "video"):
            frame[key] = channels_last(item[key])
        elif feature["dtype"] == "string":
            frame[key] = item[key]
        else:
            frame[key] = np.asarray(item[key], feature["dtype"]).reshape(feature["shape"])
    return frame


def stereo_frames(source: Any, left: str, right: str) -> Iterator[StereoFrame]:
    for i in range(len(source)):
        item = source[i]
        yield StereoFrame(channels_last(item[left]), channels_last(item[right]), stamp=item)


def create_copy(source: Any, features: dict[str, Any], options: argparse.Namespace) -> Any:
    """Create an empty dataset with the features of another one and a depth map."""
    from lerobot.configs import DepthEncoderConfig
    from lerobot.datasets import LeRobotDataset

    described = {
        key: {name: each[name] for name in ("dtype", "shape", "names")} for key, each in features.items()
    }
    size = channels_last(source[0][options.left]).shape[:2]
    described[DEPTH] = image_feature(*size, 1, "image" if options.tiff else "video")
    for key in (*source.meta.depth_keys, DEPTH):
        described[key]["info"] = {"is_depth_map": True}
    return LeRobotDataset.create(
        f"local/{options.out.name}",
        fps=source.fps,
        features=described,
        root=options.out,
        robot_type=source.meta.robot_type,
        depth_encoder=DepthEncoderConfig(depth_max=options.max_depth),
    )


def problem_of(source: Any, options: argparse.Namespace) -> str | None:
    """Return why depth cannot be added to a dataset, or ``None``."""
    for option, key in (("--left", options.left), ("--right", options.right)):
        if key not in source.features:
            images = [k for k, each in source.features.items() if each["dtype"] in ("image", "video")]
            return f"{option} {key} is not in the dataset; its images are {', '.join(images)}"
    return f"the dataset already contains {DEPTH}" if DEPTH in source.features else None


def add_depth(source: Any, pipe: Any, rig: Rig, options: argparse.Namespace) -> None:
    """Copy a dataset with the depth of every frame; a copy that is not finished is deleted."""
    features = {
        k: each for k, each in source.features.items() if k not in ADDED and each["dtype"] != "language"
    }
    dataset = create_copy(source, features, options)
    try:
        depth_m = copy_frames(source, features, dataset, pipe, rig, options)
    except BaseException:
        try:
            dataset.finalize()  # LeRobot would write its last files after they are deleted
        finally:
            shutil.rmtree(options.out, ignore_errors=True)
        raise
    stored_m = channels_last(open_dataset(options.out)[len(source) - 1][DEPTH])
    known = depth_m > 0
    error_mm = 1000 * np.abs(stored_m - depth_m)[known].max(initial=0)
    print(f"last frame: stored depth differs by at most {error_mm:.1f} mm")
    if not known.all():
        print(f"{np.mean(~known):.1%} of it are unknown, stored as {stored_m[~known].max():.2f} m")


def copy_frames(
    source: Any, features: dict[str, Any], dataset: Any, pipe: Any, rig: Rig, options: argparse.Namespace
) -> np.ndarray:
    """Write all frames with their depth to a dataset; return the last depth ``(H, W, 1)`` in metres."""
    frames = stereo_frames(source, options.left, options.right)
    episode = 0
    for result in live(pipe, frames, rig, every_frame=True, num_inference_steps=options.steps):
        if (number := int(result.stamp["episode_index"])) != episode:
            dataset.save_episode()
            episode = number
        # 0 where depth is unknown or not reliable
        depth_m = result.output.with_holes(options.min_confidence).prediction[0].astype(np.float32)
        dataset.add_frame(to_frame(result.stamp, features) | {options.left: result.left, DEPTH: depth_m})
        print(f"episode {episode}, frame {result.number}: {result.output.verdict.status}")
        for finding in result.output.findings if result.checked else ():
            print(f"{finding.severity.value}: {finding}")
    dataset.save_episode()
    dataset.finalize()
    return depth_m


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", nargs="?", metavar="SOURCE", help="dataset (default: the bundled pair)")
    parser.add_argument("--calib", type=Path, help="calibration of the rig")
    parser.add_argument("--left", default="observation.images.left", help="feature with the left images")
    parser.add_argument("--right", default="observation.images.right", help="feature with the right images")
    parser.add_argument("--tiff", action="store_true", help="store depth as lossless TIFF, not as a video")
    parser.add_argument("--max-depth", type=float, default=10.0, help="maximum depth of depth videos, metres")
    parser.add_argument("--min-confidence", type=float, default=0.0, help="depth below is stored as unknown")
    parser.add_argument("--prior", default="bundled", help="'bundled', a Hugging Face model ID or a folder")
    parser.add_argument("--steps", type=int, default=None, help="denoising steps (default: from the prior)")
    parser.add_argument("--out", type=Path, default=Path("lerobot-depth"), help="new folder of the copy")
    options = parser.parse_args(argv)
    if (options.source is None) != (options.calib is None):
        parser.error("expected a dataset and its calibration, or neither")

    if options.out.exists():
        parser.error(f"--out {options.out} exists; choose a new folder")
    source = None if options.source is None else open_dataset(options.source)
    if source is not None and (problem := problem_of(source, options)):
        parser.error(problem)
    pipe = enable_geometry_guidance(load_prior(options.prior))
    if source is not None:
        size = channels_last(source[0][options.left]).shape[1::-1]
        rig = read_calibration(options.calib, image_size=size, distorted=True)
        add_depth(source, pipe, rig, options)
        return
    pair = read_demo_pair()
    left, right = (np.rint(image * 255).astype(np.uint8) for image in (pair.left, pair.right))
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder) / "recorded", [2, 1], left, right)
        add_depth(open_dataset(Path(folder) / "recorded"), pipe, pair.rig, options)


if __name__ == "__main__":
    main()
