"""The cases whose results are frozen: one function each, which returns arrays and text by name.

They use public names only, so that a change of the structure needs no change here.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers import AutoencoderTiny
from PIL import Image

import tests.scenes.dataset  # noqa: F401  registers synthetic-plain
from geodiff_plugin import GeometryGuidance, Rig, enable_geometry_guidance, load_prior, read_calibration
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.evaluation.datasets import find_pairs, load
from tests.contracts.tiny_priors import CALL, TINY
from tests.tiny import plane_pair

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
KEPT = (
    *("prediction", "confidence", "support", "photometric_error", "visible", "uncertainty", "prior_error"),
    *("scale", "shift", "global_scale"),
)
Result = dict[str, Any]

CASES: dict[str, Callable[[], Result]] = {}
#: Cases of real pairs, left out where these are absent.
NEEDS_DATA: set[str] = set()


def case(function: Callable[[], Result]) -> Callable[[], Result]:
    """Register a case under its function's name."""
    CASES[function.__name__] = function
    return function


def real(function: Callable[[], Result]) -> Callable[[], Result]:
    """The same, of a case that reads the real pairs."""
    NEEDS_DATA.add(function.__name__)
    return case(function)


def maps_of(output: Any) -> Result:
    """What is frozen of an output."""
    result = {name: np.asarray(getattr(output, name)) for name in KEPT if getattr(output, name) is not None}
    for i, report in enumerate(output.poses):
        result[f"pose_{i}"] = np.stack(report.E)
    return result


@cache
def bundled_prior() -> Any:
    return enable_geometry_guidance(load_prior("bundled"))


@cache
def pair() -> tuple[Image.Image, Image.Image, Rig, np.ndarray]:
    """The bundled pair: left, right, cameras, and its true depth in metres."""
    rig = read_calibration(DEMO_PAIR_FOLDER / "calib.txt")
    left, right = (Image.open(DEMO_PAIR_FOLDER / f"{side}.png").convert("RGB") for side in ("left", "right"))
    depth = np.asarray(Image.open(DEMO_PAIR_FOLDER / "depth_mm.png"), np.float32) / 1000.0
    return left, right, rig, depth


def small() -> tuple[Image.Image, Image.Image, np.ndarray, np.ndarray, np.ndarray]:
    """Left, right, K, E and depth of the bundled pair at 192 pixels of width."""
    left, right, rig, depth = pair()
    width = 192
    height = round(left.height * width / left.width)
    zoom = np.array([width / left.width, height / left.height, 1.0])
    K = rig.K_left.copy()
    K[:2, 2] += 0.5
    K = zoom[:, None] * K
    K[:2, 2] -= 0.5
    resized = [image.resize((width, height), Image.Resampling.BOX) for image in (left, right)]
    rows = np.linspace(0, depth.shape[0] - 1, height).round().astype(int)
    columns = np.linspace(0, depth.shape[1] - 1, width).round().astype(int)
    return resized[0], resized[1], K, rig.E, depth[np.ix_(rows, columns)]


def call(pipe: Any, image: Any, guidance: GeometryGuidance, **options: Any) -> Any:
    options = {"generator": torch.Generator().manual_seed(0)} | options
    return pipe(image, guidance=guidance, **options)


def some_points(depth: np.ndarray, K: np.ndarray, count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    v, u = (rng.integers(0, side, count) for side in depth.shape)
    z = depth[v, u]
    points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], 1)
    return points[z > 0].astype(np.float32)


def of_small(**options: Any) -> Callable[[Callable[..., GeometryGuidance]], Callable[..., GeometryGuidance]]:
    """Register a call on the small pair, guided by what the function makes of left, right, K, E and depth."""

    def register(guide: Callable[..., GeometryGuidance]) -> Callable[..., GeometryGuidance]:
        def run() -> Result:
            of_pair = small()
            return maps_of(call(bundled_prior(), of_pair[0], guide(*of_pair), **options))

        CASES[guide.__name__] = run
        return guide

    return register


@case
def default_bundled_pair() -> Result:
    left, right, rig, _ = pair()
    return maps_of(call(bundled_prior(), left, GeometryGuidance(right, (rig.K_left, rig.K_right), rig.E)))


@case
def plain_wall() -> Result:
    """A rendered room of plain walls, whose matches know little."""
    (ref,) = find_pairs("synthetic-plain:1@320x240")
    sample = load(ref)
    guidance = GeometryGuidance(sample.right, (sample.K_left, sample.K_right), sample.E)
    return maps_of(call(bundled_prior(), Image.fromarray(sample.left), guidance))


@of_small(num_inference_steps=3)
def preset_paper(left, right, K, E, depth) -> GeometryGuidance:
    return GeometryGuidance.paper(right, K, E)


@of_small(num_inference_steps=3)
def preset_marigold_dc(left, right, K, E, depth) -> GeometryGuidance:
    return GeometryGuidance.marigold_dc(some_points(depth, K), K)


@of_small()
def gradient_updates(left, right, K, E, depth) -> GeometryGuidance:
    return GeometryGuidance(right, K, E, guidance_steps=3, lr_latents=0.03)


@of_small()
def updates_without_correction(left, right, K, E, depth) -> GeometryGuidance:
    return GeometryGuidance(right, K, E, fit_matches=False, guidance_steps=4)


@of_small()
def points_alone(left, right, K, E, depth) -> GeometryGuidance:
    return GeometryGuidance.from_points(some_points(depth, K), K)


@of_small()
def points_and_view(left, right, K, E, depth) -> GeometryGuidance:
    return GeometryGuidance(right, K, E, points=some_points(depth, K, 60))


def _third_view() -> list[tuple[Any, np.ndarray, np.ndarray]]:
    wide = plane_pair(size=(96, 128), focal=120.0)
    near = plane_pair(size=(96, 128), focal=120.0, baseline=0.05, rotation_y=0.03)
    return [(wide.left, wide.K, np.eye(4)), (wide.right, wide.K, wide.E), (near.right, near.K, near.E)]


@case
def three_views() -> Result:
    views = _third_view()
    return maps_of(call(bundled_prior(), views[0][0], GeometryGuidance.from_views(views)))


@case
def refined_pose() -> Result:
    views = _third_view()
    (left, K, _), _, (right, K_right, E) = views
    E = E.copy()
    turn = np.deg2rad(1.5)
    E[:3, :3] = E[:3, :3] @ np.array(
        [[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]]
    )
    return maps_of(call(bundled_prior(), left, GeometryGuidance(right, (K, K_right), E)))


@case
def estimated_pose() -> Result:
    left, right, rig, _ = pair()
    guidance = GeometryGuidance.from_unposed_images(
        left, right, baseline_m=float(np.linalg.norm(rig.E[:3, 3])), K=rig.K_left
    )
    return maps_of(call(bundled_prior(), left, guidance))


@case
def batch_of_two() -> Result:
    left, right, K, E, _ = small()
    guidance = GeometryGuidance([right, right], K, [E, E])
    return maps_of(call(bundled_prior(), [left, left.transpose(Image.Transpose.ROTATE_180)], guidance))


@of_small(ensemble_size=2, output_uncertainty=True)
def ensemble_of_two(left, right, K, E, depth) -> GeometryGuidance:
    return GeometryGuidance(right, K, E)


@case
def tiny_decoder() -> Result:
    left, right, K, E, _ = small()
    torch.manual_seed(3)
    tiny = AutoencoderTiny(
        encoder_block_out_channels=(8, 8),
        decoder_block_out_channels=(8, 8),
        num_encoder_blocks=(1, 1),
        num_decoder_blocks=(1, 1),
        latent_channels=4,
    )
    with tempfile.TemporaryDirectory() as folder:
        tiny.save_pretrained(folder)
        guidance = GeometryGuidance(right, K, E, decoder=folder)
        return maps_of(call(enable_geometry_guidance(TINY["marigold"]()), left, guidance))


@of_small()
def exposure(left, right, K, E, depth) -> GeometryGuidance:
    dark = Image.fromarray((np.asarray(right) * 0.6 + 10).astype(np.uint8))
    return GeometryGuidance(dark, K, E, fit_matches=False, guidance_steps=3)


@case
def mirror() -> Result:
    """A region whose matches lie behind it, as in a mirror."""
    left, right, K, E, _ = small()
    views = [np.array(left), np.array(right)]
    for view, shift in zip(views, (0, 2), strict=True):
        view[20:70, 60 - shift : 120 - shift] = np.array(left)[40:90, 30:90]
    return maps_of(call(bundled_prior(), views[0], GeometryGuidance(views[1], K, E)))


@case
def half_precision() -> Result:
    left, right, K, E, _ = small()
    pipe, result = enable_geometry_guidance(load_prior("bundled")), {}
    for dtype in (torch.float16, torch.bfloat16):
        out = call(pipe.to(dtype), left, GeometryGuidance(right, K, E), processing_resolution=128)
        result |= {f"{name}_{str(dtype)[6:]}": value for name, value in maps_of(out).items()}
    return result


def _tiny_prior(key: str) -> Callable[[], Result]:
    def run() -> Result:
        left, right, K, E, _ = small()
        pipe, further = enable_geometry_guidance(TINY[key]()), CALL.get(key, {})
        return maps_of(call(pipe, left, GeometryGuidance(right, K, E), **further))

    return run


for _key in TINY:  # one-step, flow and feed-forward priors among them, with random weights
    CASES[f"prior_{_key}"] = _tiny_prior(_key)


def _kitti() -> Iterator[Path]:
    yield from sorted((DATA / "kitti2015" / "training" / "image_2").glob("*_10.png"))


@real
def default_kitti() -> Result:
    left = next(_kitti())
    root = left.parents[1]
    right = Image.open(root / "image_3" / left.name)
    calibration = root / "calib_cam_to_cam" / f"{left.name.split('_')[0]}.txt"
    guidance = GeometryGuidance.from_calibration(right, calibration)
    return maps_of(call(bundled_prior(), Image.open(left), guidance))


def _middlebury() -> Path:
    return next((DATA / "middlebury2014").iterdir())


@real
def default_middlebury() -> Result:
    folder = _middlebury()
    guidance = GeometryGuidance.from_calibration(Image.open(folder / "im1.png"), folder / "calib.txt")
    return maps_of(call(bundled_prior(), Image.open(folder / "im0.png"), guidance))


@real
def default_posed() -> Result:
    folder, views = DATA / "mvsnet" / "7scenes_f600", []
    for i in range(2):
        words = (folder / "cams" / f"{i:08d}_cam.txt").read_text().split()
        E = np.linalg.inv(np.array(words[1:17], float).reshape(4, 4))
        u, _, vt = np.linalg.svd(E[:3, :3])
        E[:3, :3] = u @ vt
        image = Image.open(next((folder / "images").glob(f"{i:08d}.*")))
        views.append((image, np.array(words[18:27], float).reshape(3, 3), E))
    return maps_of(call(bundled_prior(), views[0][0], GeometryGuidance.from_views(views)))


def _command(*arguments: str, cwd: str) -> str:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    run = subprocess.run(
        [sys.executable, "-m", "geodiff_plugin", *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


def _files(folder: Path) -> Result:
    result: Result = {"files": "\n".join(sorted(str(p.relative_to(folder)) for p in folder.rglob("*.*")))}
    for path in sorted(folder.rglob("depth.npy")):
        result[path.relative_to(folder).as_posix()] = np.load(path)
    return result


@case
def command_one_pair() -> Result:
    files = [str(DEMO_PAIR_FOLDER / name) for name in ("left.png", "right.png")]
    with tempfile.TemporaryDirectory() as cwd:
        _command("depth", *files, "--calib", str(DEMO_PAIR_FOLDER / "calib.txt"), "--out", "out", cwd=cwd)
        return _files(Path(cwd) / "out")


@case
def command_folder() -> Result:
    left, right, K, E, _ = small()
    with tempfile.TemporaryDirectory() as cwd:
        for side, image in (("lefts", left), ("rights", right)):
            (Path(cwd) / side).mkdir()
            for i in range(2):
                image.rotate(180 * i).save(Path(cwd) / side / f"{i}.png")
        np.savetxt(Path(cwd) / "K.txt", K)
        np.savetxt(Path(cwd) / "E.txt", E)
        _command("depth", "lefts", "rights", "--K", "K.txt", "--E", "E.txt", "--out", "out", cwd=cwd)
        return _files(Path(cwd) / "out")


@real
def evaluation_record() -> Result:
    """Numbers of ``geodiff eval pairs`` on one pair, but for times, versions and paths."""
    with tempfile.TemporaryDirectory() as cwd:
        arguments = ("--datasets", "middlebury2014", "--methods", "guided,sgbm", "--out", "out")
        _command("eval", "pairs", str(DATA), *arguments, cwd=cwd)
        lines = (Path(cwd) / "out" / "samples.jsonl").read_text().splitlines()
        numbers = {}
        for record in map(json.loads, lines):
            metrics = record["all_pixels"]["raw"]
            numbers[record["method"]] = np.array([metrics[name] for name in sorted(metrics)], float)
        return numbers
