"""Frames averaged with their neighbours, on rendered sequences."""

import numpy as np
import pytest

from geodiff_plugin.capture.agreement import scene_poses, steadied
from geodiff_plugin.types import DepthFrame
from tests.lab.sequence import flicker, true_frames
from tests.scenes import render_sequence


@pytest.fixture(scope="module")
def sequence():
    return render_sequence(1, 4, size=(144, 192))


def of_depth(sequence, depths):
    """The frames of a sequence with these depths, their pose not known, and their pictures."""
    pictures = [view.image_01.permute(1, 2, 0).numpy() for view in sequence.lefts]
    K, sure = sequence.K.numpy().astype(np.float64), np.full(depths[0].shape, 0.5)
    return [DepthFrame("", depth, sure, K, np.eye(4)) for depth in depths], pictures


def test_the_motion_of_the_camera_is_found_and_a_cut_begins_a_scene(sequence):
    truth = true_frames(sequence)
    known, pictures = of_depth(sequence, [np.nan_to_num(frame.depth, nan=50.0) for frame in truth])
    (poses,) = scene_poses(zip(known, pictures, strict=True))
    for frame, E in zip(truth, poses, strict=True):
        assert np.allclose(E, np.linalg.inv(truth[0].E) @ frame.E, atol=0.01)
    pictures[2:] = [picture[:, ::-1].copy() for picture in pictures[2:]]
    assert [len(scene) for scene in scene_poses(zip(known, pictures, strict=True))] == [2, 2]
    pictures[1] = np.zeros_like(pictures[1])  # nothing to be seen
    assert [len(scene) for scene in scene_poses(zip(known, pictures, strict=True))] == [1, 1, 2]


def test_frames_that_agree_are_averaged_within_their_scene(sequence):
    truth = true_frames(sequence)
    off = [0.02 * (-1) ** k for k in range(4)]
    known, _ = of_depth(sequence, [frame.depth * np.exp(o) for frame, o in zip(truth, off, strict=True)])
    of_camera = [np.linalg.inv(truth[0].E) @ frame.E for frame in truth]
    steady = list(steadied([of_camera], known.__getitem__))
    errors = [np.log(frame.depth / true.depth) for frame, true in zip(steady, truth, strict=True)]
    assert flicker(errors, truth)[0] < 0.4 * 0.04
    assert max(np.nanmean(np.abs(error)) for error in errors) < 0.7 * 0.02
    known[1].depth[40:80, 60:100] *= 0.5  # something that moves: no other frame has it there
    known[1].confidence[40:80, 60:100] = 0.9
    there = list(steadied([of_camera], known.__getitem__))[1]
    np.testing.assert_allclose(there.depth[45:75, 65:95], known[1].depth[45:75, 65:95], rtol=1e-6)
    assert not there.confirmed[45:75, 65:95].any()
    apart = list(steadied([[E] for E in of_camera], known.__getitem__))  # every frame a scene of its own
    assert all(np.allclose(a.depth, k.depth, equal_nan=True) for a, k in zip(apart, known, strict=True))
