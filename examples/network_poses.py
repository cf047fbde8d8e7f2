"""Convert poses of Depth Anything 3, VGGT or MapAnything to a capture (transforms.json) for metric depth.

These networks return a pose and intrinsics per image, for the size at which they processed it and without a
metric scale. This script writes a transforms.json next to the images, which `geodiff capture` reads; with
--known-length its results are in metres. Prediction files are .npz:

    da3           extrinsics (N, 3, 4) world-to-camera, intrinsics (N, 3, 3)
    vggt          extrinsic (N, 3, 4) world-to-camera, intrinsic (N, 3, 3), from pose_encoding_to_extri_intri
    mapanything   camera_poses (N, 4, 4) camera-to-world, intrinsics (N, 3, 3)

each with the size of the network's images as `size` (width, height), or with `depth` or `images` of that
size. All three use OpenCV's axes. VGGT scales an image to a fixed width and crops its height around the
centre, or pads it to a square (--padded). By default the script runs offline on small synthetic predictions
of all three:

    python -m examples.network_poses vggt predictions.npz images/
    geodiff capture images/ --out depth --known-length NAME:X1,Y1,X2,Y2,METRES
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
SUFFIXES = (".jpg", ".jpeg", ".png")
#: Sides are rounded to multiples of 14; a larger difference of the aspect ratios indicates a crop.
SAME_SHAPE = 0.05
#: Keys of poses and intrinsics, and whether poses are world-to-camera, per network.
NETWORKS = {
    "da3": ("extrinsics", "intrinsics", True),
    "vggt": ("extrinsic", "intrinsic", True),
    "mapanything": ("camera_poses", "intrinsics", False),
}


def camera_to_world(poses: np.ndarray, world_to_camera: bool) -> np.ndarray:
    """Return ``(N, 4, 4)`` camera-to-world poses from ``(N, 3, 4)`` or ``(N, 4, 4)``, possibly batched."""
    poses = np.asarray(poses, float).reshape(-1, *np.shape(poses)[-2:])
    E = np.tile(np.eye(4), (len(poses), 1, 1))
    E[:, : poses.shape[1]] = poses
    return np.linalg.inv(E) if world_to_camera else E


def network_size(data: dict[str, np.ndarray]) -> tuple[int, int]:
    """Return ``(width, height)`` of the network's images."""
    if "size" in data:
        return int(data["size"][0]), int(data["size"][1])
    if "depth" in data:
        depth = np.squeeze(data["depth"])
        return depth.shape[-1], depth.shape[-2]
    if "images" in data:
        images = data["images"]
        sides = images.shape[-2:] if images.shape[-3] == 3 else images.shape[-3:-1]
        return sides[1], sides[0]
    raise SystemExit("The file lacks the size of the network's images; add size, depth or images.")


def to_image(K: np.ndarray, of: tuple[int, int], size: tuple[int, int], padded: bool) -> np.ndarray:
    """Convert intrinsics of a network's (scaled, cropped or padded) image to the original image."""
    factors = np.array(size) / np.array(of)
    if abs(factors[0] / factors[1] - 1) > SAME_SHAPE:
        factors = np.full(2, max(size) / max(of) if padded else size[0] / of[0])
    centre = np.array(size) / 2 + factors * (K[:2, 2] + 0.5 - np.array(of) / 2) - 0.5
    return np.array([[factors[0] * K[0, 0], 0, centre[0]], [0, factors[1] * K[1, 1], centre[1]], [0, 0, 1]])


def write_transforms(network: str, predictions: Path, images: Path, padded: bool = False) -> Path:
    """Write ``images/transforms.json`` for images passed to the network in order of their names."""
    poses, intrinsics, world_to_camera = NETWORKS[network]
    with np.load(predictions) as file:
        data = dict(file)
    E = camera_to_world(data[poses], world_to_camera)
    Ks = data[intrinsics].reshape(-1, 3, 3)
    paths = sorted(path for path in images.iterdir() if path.suffix.lower() in SUFFIXES)
    if len(paths) != len(E):
        raise SystemExit(
            f"{len(E)} poses for {len(paths)} images in {images}: Check that this is the network's input."
        )
    frames = []
    for path, pose, K in zip(paths, E, Ks, strict=True):
        with Image.open(path) as image:
            size = image.size
        K = to_image(K, network_size(data), size, padded)
        frame = {
            "file_path": path.name,
            "transform_matrix": (pose @ OPENGL).tolist(),
            "w": size[0],
            "h": size[1],
        }
        frame |= {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
        frames.append(frame | {"colmap_im_id": len(frames)})  # marks lengths as having no known unit
    path = images / "transforms.json"
    path.write_text(json.dumps({"frames": frames}, indent=1))
    return path


def stub(
    network: str, folder: Path, size: tuple[int, int] = (640, 480), of: tuple[int, int] = (518, 392)
) -> Path:
    """Write a synthetic prediction of a network next to three images."""
    poses, intrinsics, world_to_camera = NETWORKS[network]
    rng = np.random.default_rng(0)
    E = np.tile(np.eye(4), (3, 1, 1))
    E[:, 0, 3] = 0.1, 0.2, 0.4
    for number in range(3):
        rgb = rng.integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
        Image.fromarray(rgb).save(folder / f"{number}.png")
    K = np.array([[400.0, 0, of[0] / 2 - 0.5], [0, 400.0, of[1] / 2 - 0.5], [0, 0, 1]])
    given = np.linalg.inv(E)[:, :3] if world_to_camera else E
    data = {poses: given, intrinsics: np.tile(K, (3, 1, 1)), "size": np.array(of)}
    np.savez(folder / f"{network}.npz", **data)
    return folder / f"{network}.npz"


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "network", nargs="?", choices=NETWORKS, help="source of the file (default: synthetic files of all)"
    )
    parser.add_argument("predictions", nargs="?", type=Path, help=".npz of the network's output")
    parser.add_argument("images", nargs="?", type=Path, help="folder with the network's input images")
    parser.add_argument("--padded", action="store_true", help="images were padded to a square, not cropped")
    options = parser.parse_args(argv)
    if options.predictions and options.images:
        print(write_transforms(options.network, options.predictions, options.images, options.padded))
        return
    from geodiff_plugin import Capture

    for network in NETWORKS if options.network is None else [options.network]:
        with tempfile.TemporaryDirectory() as folder:
            capture = Capture.open(write_transforms(network, stub(network, Path(folder)), Path(folder)))
            frame = capture.frame("2")
            print(
                f"{network}: {len(capture)} frames, unit {capture.unit}, 2 at {frame.E[:3, 3].round(3)}, "
                f"focal length {frame.camera.K[0, 0]:.1f} px"
            )


if __name__ == "__main__":
    main()
