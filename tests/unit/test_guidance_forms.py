"""What people have in their hands goes in: lists, 3x4 poses, bfloat16, crops."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance

K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
E = np.eye(4)
E[0, 3] = 0.12
RIGHT = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("K_given", "E_given"),
    [
        (K.tolist(), E.tolist()),
        ([K, K], E),
        ([K.tolist(), K.tolist()], [np.eye(4).tolist(), E.tolist()]),
        ((K, K), [np.eye(4), E]),
        (K, E[:3]),
        (K, E[:3].tolist()),
        (K, (np.eye(4)[:3], E[:3])),
        (K, torch.from_numpy(E).bfloat16()),
        (torch.from_numpy(K).half(), torch.from_numpy(E).float()),
    ],
)
def test_forms_of_the_cameras(K_given, E_given):
    (rig,) = GeometryGuidance(RIGHT, K_given, E_given).rigs
    np.testing.assert_allclose(rig.K_left, K, atol=1e-2)
    np.testing.assert_allclose(rig.E, E, atol=1e-3)


def test_a_list_for_a_list_of_images_is_one_entry_each():
    guidance = GeometryGuidance(
        [RIGHT, RIGHT], [K, np.diag([2.0, 2.0, 1.0]) @ K - [[0, 0, 31], [0, 0, 23], [0, 0, 0]]], [E, E]
    )
    assert [rig.K_left[0, 0] for rig in guidance.rigs] == [60.0, 120.0]


def test_pairs_as_lists():
    guidance = GeometryGuidance(RIGHT, K, E, depth_range=[0.5, 9.0], left_size=[64, 48])
    assert tuple(guidance.config.depth_range) == (0.5, 9.0)
    for size in ("64x48", (64,), (64, 0), 64, (6.5, 4)):
        with pytest.raises((ValueError, TypeError), match="left_size must be"):
            GeometryGuidance(RIGHT, K, E, left_size=size)


def test_a_crop_says_so():
    off = K.copy()
    off[0, 2] = -40.0
    lefts = torch.rand(1, 3, 48, 64)
    with pytest.raises(ValueError, match="outside"):
        GeometryGuidance(RIGHT, off, E)
    guidance = GeometryGuidance(RIGHT, off, E, cropped=True)
    assert guidance.prepare(lefts)
    with pytest.raises(ValueError, match="K must be for the left image"):
        GeometryGuidance.from_points(np.full((48, 64), 2.0), off).prepare(lefts)
    assert GeometryGuidance.from_points(np.full((48, 64), 2.0), off, cropped=True).prepare(lefts)
