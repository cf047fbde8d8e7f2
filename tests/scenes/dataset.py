"""The renderer as a data set: unlimited, seeded, with exact depth, occlusion and material.

Importing this module registers it, as docs/how-to/extending.md tells everybody to.

Data flow: seeds -> references -> ``StereoSample``.
Paper: stands in where its data sets cannot be shown (S5.2, S5.3).
"""

from __future__ import annotations

import re
from itertools import count, islice
from pathlib import Path

import numpy as np
import torch

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.datasets import DATASETS
from geodiff_plugin.evaluation.datasets.sample import Dataset, SampleRef, StereoSample, make_sample
from geodiff_plugin.types import Rig
from tests.scenes import render_pair
from tests.scenes.cameras import intrinsics
from tests.scenes.effects import indoor_cameras
from tests.scenes.layouts import sample_scene
from tests.scenes.render import render_linear
from tests.scenes.scene import Camera, Material

__all__ = ["SYNTHETIC", "find_synthetic", "is_reflective", "load_synthetic"]

SIZE = (384, 512)
REFLECTIVE_SHARE = 0.01
_ROOT = re.compile(r"synthetic(-reflective|-posed|-plain)?:(\d+)(?:\+(\d+))?(?:@(\d+)x(\d+))?")
# Mirrors of one percent of the image still have thirty pixels here.
_SCAN = (48, 64)


def find_synthetic(root: Path) -> list[SampleRef]:
    """References to rendered pairs.

    Args:
        root: ``synthetic:N`` for N pairs from seed 0 on, ``synthetic:N+S`` for N from seed S on, and
            ``@WIDTHxHEIGHT`` after either for another size than 512x384 pixels; ``synthetic-reflective:``
            with the same for the first N scenes with a mirror or glass on at least 1 % of the left image
            (one in seven has), ``synthetic-posed:`` for the first N that have a general pose,
            ``synthetic-plain:`` for rectified pairs of rooms with plain walls. Any other path holds none.
            Even seeds give rectified pairs, odd ones a general pose.

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
    return [_ref(seed, size, plain=matched[1] == "-plain") for seed in islice(seeds, int(matched[2]))]


def _ref(seed: int, size: tuple[int, int], *, plain: bool) -> SampleRef:
    if plain:
        return SampleRef("synthetic", f"plain{seed:04d}", {"seed": seed, "size": size, "kind": "plain"})
    return SampleRef("synthetic", f"seed{seed:04d}", {"seed": seed, "posed": seed % 2 == 1, "size": size})


def is_reflective(seed: int) -> bool:
    """Whether a scene shows a mirror or glass on at least 1 % of its left image; seen at 64x48 pixels."""
    scene = sample_scene(seed)
    kinds = (int(Material.MIRROR), int(Material.GLASS))
    if not torch.isin(scene.material, torch.tensor(kinds)).any():
        return False
    camera = Camera(intrinsics(_SCAN, scene.fov_deg), scene.T_world_from_camera)
    material = render_linear([scene], [camera], [0], _SCAN, "cpu", antialias=False).material
    return float(torch.isin(material, torch.tensor(kinds)).float().mean()) >= REFLECTIVE_SHARE


def _image(image_01: torch.Tensor) -> np.ndarray:
    return np.rint(image_01.permute(1, 2, 0).numpy() * 255).astype(np.uint8)


def load_synthetic(ref: SampleRef) -> StereoSample:
    """Render one pair.

    Args:
        ref: ``files`` holds ``seed``, ``size`` (H, W), and ``posed``, or ``kind`` for a rectified pair of it.

    Returns:
        The sample, with camera effects and different exposures; ``material`` has Booster's meaning of 2 and 3
        (mirror, glass).
    """
    seed, size = ref.files["seed"], ref.files["size"]
    if "kind" in ref.files:
        pair = render_pair(seed, ref.files["kind"], size, effects=indoor_cameras(seed))
    else:
        pair = render_pair(seed, size=size, posed=ref.files["posed"], effects=True)
    valid = pair.left.valid[0].numpy()
    rig = Rig(pair.K_left.numpy(), pair.K_right.numpy(), pair.E.numpy(), source="renderer")
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
    "for pairs in a general pose, synthetic-plain:N for rooms with plain walls).",
)

DATASETS[SYNTHETIC.name] = SYNTHETIC
