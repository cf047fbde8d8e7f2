"""The renderer as a data set: unlimited, seeded, with exact depth, occlusion and material.

Importing this module registers it, as described in docs/how-to/extending.md.

Data flow: seeds -> references -> ``StereoSample``.
Paper: stands in where its data sets cannot be shown (S5.2, S5.3).
"""

from __future__ import annotations

import re
from itertools import count, islice
from pathlib import Path

import numpy as np
import torch

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.evaluation.datasets import DATASETS
from geodiff_plugin.evaluation.datasets.sample import Dataset, SampleRef, StereoSample, make_sample
from tests.scenes import render_pair
from tests.scenes.cameras import intrinsics
from tests.scenes.effects import indoor_cameras
from tests.scenes.layouts import sample_scene
from tests.scenes.render import render_linear
from tests.scenes.scene import Camera, Material
from tests.views import made_rig

__all__ = ["SYNTHETIC", "find_synthetic", "is_reflective", "load_synthetic"]

SIZE = (384, 512)
REFLECTIVE_FRACTION = 0.01
_ROOT = re.compile(r"synthetic(-reflective|-posed|-plain|-repeated)?:(\d+)(?:\+(\d+))?(?:@(\d+)x(\d+))?")
# Mirrors of one percent of the image still have thirty pixels here.
_SCAN = (48, 64)


def find_synthetic(root: Path) -> list[SampleRef]:
    """References to rendered pairs.

    Args:
        root: ``synthetic:N`` for N pairs from seed 0 on, ``synthetic:N+S`` for N from seed S on, and
            ``@WIDTHxHEIGHT`` after either for another size than 512x384 pixels; ``synthetic-reflective:``
            with the same for the first N scenes with a mirror or glass on at least 1 % of the left image
            (one in seven has), ``synthetic-posed:`` for the first N that have a general pose,
            ``synthetic-plain:`` for rectified pairs of rooms with plain walls, ``synthetic-repeated:`` for
            rooms with a repeated pattern. Any other path holds none. Even seeds give rectified pairs, odd
            ones a general pose.

    Raises:
        ValueError: a width or height of 0.
    """
    matched = _ROOT.fullmatch(str(root))
    if matched is None:
        return []
    seeds = count(int(matched[3] or 0))
    if matched[1] == "-posed":
        seeds = filter(lambda seed: seed % 2 == 1, seeds)
    elif matched[1] == "-reflective":
        seeds = filter(is_reflective, seeds)
    size = (int(matched[5]), int(matched[4])) if matched[4] else SIZE
    if min(size) < 1:
        bad_value("DIR", "synthetic:N@WIDTHxHEIGHT with sides of at least 1 pixel", str(root))
    return [_ref(seed, size, matched[1]) for seed in islice(seeds, int(matched[2]))]


def _ref(seed: int, size: tuple[int, int], which: str | None) -> SampleRef:
    files = {"seed": seed, "size": size, "posed": seed % 2 == 1}
    if which == "-plain":
        return SampleRef("synthetic", f"plain{seed:04d}", files | {"kind": "plain", "posed": False})
    if which == "-repeated":
        return SampleRef("synthetic", f"repeated{seed:04d}", files | {"kind": "repeated"})
    return SampleRef("synthetic", f"seed{seed:04d}", files)


def is_reflective(seed: int) -> bool:
    """Whether a scene shows a mirror or glass on at least 1 % of its left image; seen at 64x48 pixels."""
    scene = sample_scene(seed)
    kinds = (int(Material.MIRROR), int(Material.GLASS))
    if not torch.isin(scene.material, torch.tensor(kinds)).any():
        return False
    camera = Camera(intrinsics(_SCAN, scene.fov_deg), scene.T_world_from_camera)
    material = render_linear([scene], [camera], [0], _SCAN, "cpu", antialias=False).material
    return float(torch.isin(material, torch.tensor(kinds)).float().mean()) >= REFLECTIVE_FRACTION


def _image(image_01: torch.Tensor) -> np.ndarray:
    return np.rint(image_01.permute(1, 2, 0).numpy() * 255).astype(np.uint8)


def load_synthetic(ref: SampleRef) -> StereoSample:
    """Render one pair.

    Args:
        ref: ``files`` holds ``seed``, ``size`` (H, W) and ``posed``, and the ``kind`` of indoor scenes.

    Returns:
        The sample, with camera effects and different exposures; ``material`` has Booster's meaning of 2 and 3
        (mirror, glass).
    """
    seed, size = ref.files["seed"], ref.files["size"]
    kind, posed = ref.files.get("kind"), ref.files["posed"]
    effects = True if kind is None else indoor_cameras(seed)
    pair = render_pair(seed, kind, size, posed=posed, effects=effects)
    valid = pair.left.valid[0].numpy()
    rig = made_rig(pair.K_left.numpy(), pair.K_right.numpy(), pair.E.numpy(), source="renderer")
    return make_sample(
        ref,
        (_image(pair.left.image_01), _image(pair.right.image_01)),
        rig,
        np.where(valid, pair.left.depth_m[0].numpy(), 0),
        {"truth": "exact", "kind": pair.kind},
        occluded=valid & pair.occluded[0].numpy(),
        material=pair.left.material[0].numpy().astype(np.uint8),
    )


SYNTHETIC = Dataset(
    name="synthetic",
    find=find_synthetic,
    load=load_synthetic,
    cap_m=None,
    needs_folder=False,
    obtain="rendered by this package, offline: give synthetic:N as DIR (or synthetic:N+FIRST_SEED; @256x192 "
    "after either for that size; synthetic-reflective:N for scenes with mirrors or glass, synthetic-posed:N "
    "for pairs in a general pose, synthetic-plain:N for rooms with plain walls, synthetic-repeated:N for "
    "repeated patterns).",
)

DATASETS[SYNTHETIC.name] = SYNTHETIC
