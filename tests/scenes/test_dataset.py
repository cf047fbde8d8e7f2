"""Rendered pairs as a data set, and rendered sequences."""

from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin.evaluation.datasets import SampleRef, find_pairs, load
from tests.contracts.test_datasets import photometric_error
from tests.scenes import render_sequence
from tests.scenes.dataset import is_reflective

pytestmark = pytest.mark.end_to_end


def test_synthetic_pairs_are_seeded_and_alternate(tmp_path):
    with pytest.raises(ValueError, match="sides of at least 1 pixel"):
        find_pairs("synthetic:1@0x96")
    refs = find_pairs(Path("synthetic:3+4"))
    assert [ref.files["seed"] for ref in refs] == [4, 5, 6]
    assert refs[0].files["size"] == (384, 512)
    assert find_pairs(Path("synthetic:1+4@64x48"))[0].files == refs[0].files | {"size": (48, 64)}
    assert find_pairs(tmp_path, ["synthetic"]) == []
    small = [SampleRef(ref.dataset, ref.name, ref.files | {"size": (48, 64)}) for ref in refs[:2]]
    rectified, posed = (load(ref) for ref in small)
    assert rectified.rectified and not posed.rectified
    for sample in (rectified, posed):
        assert sample.left.dtype == np.uint8 and sample.left.shape == (48, 64, 3)
        assert sample.valid.any() and (sample.depth_m[sample.valid] > 0).all()
        assert sample.occluded.shape == sample.material.shape == (48, 64)
    np.testing.assert_array_equal(load(small[0]).left, rectified.left)


def test_reflective_pairs_show_mirrors_or_glass():
    refs = find_pairs(Path("synthetic-reflective:3+10@64x48"))
    assert [ref.files["seed"] for ref in refs] == sorted(ref.files["seed"] for ref in refs)
    for ref in refs:
        material = load(ref).material
        assert np.isin(material, (2, 3)).mean() > 0.005
    skipped = set(range(10, refs[-1].files["seed"])) - {ref.files["seed"] for ref in refs}
    assert skipped and not any(is_reflective(seed) for seed in skipped)


@pytest.mark.parametrize("seed", [0, 1], ids=["rectified", "posed"])
def test_rendered_ground_truth_warps_right_to_left(seed):
    (ref,) = find_pairs(Path(f"synthetic:1+{seed}"))
    sample = load(SampleRef(ref.dataset, ref.name, ref.files | {"size": (96, 128)}))
    true, nearer, farther = (photometric_error(sample, factor) for factor in (1.0, 0.8, 1.2))
    assert true < nearer and true < farther


def test_frames_show_one_scene_from_a_moving_rig():
    """A point of the first frame, carried by the poses, has the second frame's own depth and colour there."""
    sequence = render_sequence(3, 3, size=(48, 64))
    K, E = sequence.K.numpy(), sequence.E.numpy()
    assert len(sequence.lefts) == len(sequence.rights) == 3 and E[0, 3] > 0
    first, second = (np.linalg.inv(T.numpy()) for T in sequence.T_world_from_left[:2])
    step = np.linalg.norm(np.linalg.inv(first)[:3, 3] - np.linalg.inv(second)[:3, 3])
    assert step == pytest.approx(0.5 * E[0, 3], rel=1e-5)
    move = second @ np.linalg.inv(first)
    agree = []
    for row, column in np.ndindex(48, 64):
        z = float(sequence.lefts[0].depth_m[0, row, column])
        if not np.isfinite(z):
            continue
        point = move[:3, :3] @ (np.linalg.inv(K) @ [column, row, 1.0] * z) + move[:3, 3]
        u, v = (K @ point)[:2] / point[2]
        if 0 <= round(u) < 64 and 0 <= round(v) < 48 and point[2] > 0:
            there = float(sequence.lefts[1].depth_m[0, round(v), round(u)])
            agree.append(abs(there / point[2] - 1) < 0.03)
    assert len(agree) > 1000 and np.mean(agree) > 0.75  # the rest is hidden there, or next to an edge
