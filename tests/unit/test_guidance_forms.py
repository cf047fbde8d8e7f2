"""What people have in their hands goes in: lists, 3x4 poses, bfloat16, crops."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance, InputError

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


def test_beside_one_right_image_a_list_is_one_entry_for_each_list_of_points():
    other, points = np.array(E), np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0], [0.0, 0.1, 4.0]])
    other[0, 3] = 0.2
    guidance = GeometryGuidance(RIGHT, [K, K], [E, other], points=[points, points])
    assert [rig.E[0, 3] for rig in guidance.rigs] == [E[0, 3], 0.2]


def test_rows_of_numpy_numbers_are_a_matrix():
    rows = [list(row) for row in K.astype(np.float32)]
    (rig,) = GeometryGuidance(RIGHT, rows, E).rigs
    np.testing.assert_allclose(rig.K_left, K)


def test_a_ragged_pose_is_told_so():
    with pytest.raises(InputError, match="E must be a 4x4 matrix of numbers; got list"):
        GeometryGuidance(RIGHT, K, [[1, 0, 0, 0.1], [0, 1, 0], [0, 0, 1, 0]])


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
    views = [(RIGHT, off, np.eye(4)), (RIGHT, off, E)]
    with pytest.raises(ValueError, match="the left view's image"):
        GeometryGuidance.from_views(views)
    assert GeometryGuidance.from_views(views, cropped=True).prepare(lefts)
    with pytest.raises(ValueError, match="K must be for the left image"):
        GeometryGuidance.from_points(np.full((48, 64), 2.0), off).prepare(lefts)
    assert GeometryGuidance.from_points(np.full((48, 64), 2.0), off, cropped=True).prepare(lefts)


@pytest.mark.parametrize("dtype", [np.int64, np.uint16])
def test_integer_points_are_refused_as_an_integer_map_is(dtype):
    for points, cure in (
        (np.array([[0, 0, 2], [1, 0, 3]], dtype), "keep them floats"),
        (np.array([[0, 0, 2, 9], [1, 0, 3, 9]], dtype), "keep them floats"),
        (np.full((48, 64), 2, dtype), "1000 for millimetres"),
    ):
        for value in (points, torch.from_numpy(points)):
            with pytest.raises(InputError, match=f"points must be metres as floats; got dtype .*{cure}"):
                GeometryGuidance.from_points(value, K)
    with pytest.raises(InputError, match=r"points\[1\] must be metres as floats"):
        GeometryGuidance.from_points([np.ones((2, 3)), np.ones((2, 3), dtype)], K)


def test_whole_metres_typed_by_hand_are_points():
    (own,) = GeometryGuidance.from_points([[0, 0, 2], [1, 0, 3]], K).inputs
    np.testing.assert_array_equal(own.points.numpy(), [[0.0, 0.0, 2.0], [1.0, 0.0, 3.0]])


@pytest.mark.parametrize(
    ("rights", "cameras", "names"),
    [
        (RIGHT, lambda K: K, ["K"]),
        (RIGHT, lambda K: (K, K), ["K[right]"]),
        ((RIGHT, RIGHT), lambda K: K, ["K", "K"]),
        ((RIGHT, RIGHT), lambda K: (K, K, K), ["K[right view 1]", "K[right view 2]"]),
        ([RIGHT, RIGHT], lambda K: K, ["K[0]", "K[1]"]),
    ],
)
def test_warnings_name_the_camera_matrix_that_was_given(rights, cameras, names):
    poses = (np.eye(4), E, E) if isinstance(rights, tuple) else E
    border = K - [[0, 0, 25], [0, 0, 19], [0, 0, 0]]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        GeometryGuidance(rights, cameras(border), poses)
    assert [str(w.message).split(" has its principal point")[0] for w in said] == names
    with pytest.raises(InputError) as refused:
        GeometryGuidance(rights, cameras(K + [[0, 0, 90], [0, 0, 0], [0, 0, 0]]), poses)
    assert str(refused.value).startswith(f"{names[0]} must be for the right image")


def test_the_size_of_an_image_is_read_without_a_second_warning():
    dark = RIGHT.astype(np.uint16) * 4
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        GeometryGuidance.from_views([(dark, K, np.eye(4)), (dark, K, E)])
    (sentence,) = (str(w.message) for w in said)
    assert sentence.startswith("right is a 16-bit image that is nearly black")
