"""``--pose`` and ``--perturb`` of ``geodiff eval pairs``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin.cli.eval.options import pairs_options
from geodiff_plugin.evaluation.baselines import find_method, with_poses
from geodiff_plugin.evaluation.commands import command_line
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.perturbed import perturbation, perturbed_pose, perturbed_ref


def test_perturbed_poses_stay_within_what_was_asked() -> None:
    E = np.eye(4)
    E[:3, 3] = (0.3, 0.1, 0.0)
    for seed in range(20):
        wrong = perturbed_pose(E, 1.5, 0.1, 4.0, np.random.default_rng(seed))
        turn = np.degrees(np.linalg.norm(Rotation.from_matrix(wrong[:3, :3]).as_rotvec()))
        assert 0.3 * 1.5 <= turn <= 1.5
        assert np.linalg.norm(wrong[:3, 3]) == pytest.approx(np.linalg.norm(E[:3, 3]))
        assert 0 < np.linalg.norm(wrong[:3, 3] - E[:3, 3]) < 0.12 * np.linalg.norm(E[:3, 3])


def test_a_perturbed_sample_differs_in_its_pose_only() -> None:
    (ref,) = find_pairs("synthetic-posed:1+10@64x48")
    assert ref.files["posed"] and ref.files["seed"] == 11
    wrong, again = (load(perturbed_ref(ref, (1.5, 0.1))) for _ in range(2))
    sample = load(ref)
    assert np.array_equal(wrong.left, sample.left) and np.array_equal(wrong.depth_m, sample.depth_m)
    assert np.array_equal(wrong.E, again.E) and not np.allclose(wrong.E, sample.E)
    assert wrong.name == "seed0011-turn1.5-shift0.1"


@pytest.mark.parametrize("text", ["1.5", "a,b", "1,2,3", "1..2,0.1", "99,0.1"])
def test_a_perturbation_that_is_none(text: str) -> None:
    with pytest.raises(ValueError, match="--perturb"):
        perturbation(text)


def test_poses_make_rows_of_guided() -> None:
    assert with_poses(("sgbm", "guided"), ("given", "estimated")) == (
        "sgbm",
        "guided:pose=given",
        "guided:pose=estimated",
    )
    assert find_method("guided:pose=estimated").title == "guided, poses estimated"
    assert with_poses(("guided",), ()) == ("guided",)


def test_options_come_back_as_a_command_line() -> None:
    typed = {
        "data": Path("synthetic-posed:2"),
        "methods": "guided",
        "pose": "refine,given",
        "perturb": "1.5,0.1",
    }
    typed |= {"limit": None, "out": Path("x"), "device": "cpu", "datasets": None, "scenes": None}
    options = pairs_options(typed)
    assert options.pose == ("refine", "given") and options.perturb == (1.5, 0.1)
    assert "--pose refine,given --perturb 1.5,0.1" in command_line(options, ("eval", "pairs", "d"))
    with pytest.raises(ValueError, match="pose"):
        pairs_options(typed | {"pose": "guess"})
