"""``--pose`` and ``--perturb`` of ``geodiff eval pairs``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from geodiff_plugin.cli.eval.app import eval_app
from geodiff_plugin.evaluation import experiment
from geodiff_plugin.evaluation.baselines import find_method, with_poses
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.datasets.changed import (
    drift_of,
    drifted_ref,
    perturbation,
    perturbed_pose,
    perturbed_ref,
)
from geodiff_plugin.evaluation.options import DirOptions, PosesOptions, command_line
from geodiff_plugin.evaluation.poses import run_poses


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
    given = {"data": Path("synthetic-posed:2"), "methods": ("guided",), "perturb": "1.5,0.1"}
    options = DirOptions(**given, pose=("refine", "given"), limit=3, out=Path("x"), quiet=True)
    assert options.perturbed == (1.5, 0.1)
    line = command_line("pairs", options)
    assert line.startswith("geodiff eval pairs") and "quiet" not in line and "--out" not in line
    for words in (
        "--pose refine,given",
        "--perturb 1.5,0.1",
        "--limit 3",
        "--methods guided",
        " synthetic-posed:2 ",
    ):
        assert words in f"{line} "
    with pytest.raises(ValueError, match="--pose"):
        DirOptions(**given, pose=("guess",))


def test_a_drifted_rig_keeps_its_calibration_and_moves_its_right_image() -> None:
    (ref,) = find_pairs("synthetic:1@96x72")
    sample, same = load(ref), load(drifted_ref(ref, (0.0, 0.0)))
    moved, turned = load(drifted_ref(ref, (0.0, 2.0))), load(drifted_ref(ref, (0.3, 1.5)))
    assert sample.rectified and np.array_equal(same.right, sample.right)
    for other in (moved, turned):
        assert np.array_equal(other.left, sample.left) and np.array_equal(other.E, sample.E)
        assert np.array_equal(other.K_right, sample.K_right)
    down, up = (np.array_equal(moved.right[10:60], sample.right[10 - px : 60 - px]) for px in (2, -2))
    assert down or up, "by whole pixels nothing is interpolated"
    assert np.abs(turned.right.astype(int) - sample.right).mean() > 1
    assert turned.name == "seed0000-drift0.3-1.5px"


@pytest.mark.parametrize("text", ["0.3", "a,b", "9,1", "0.3,99"])
def test_a_drift_that_is_none(text: str) -> None:
    with pytest.raises(ValueError, match="--drift"):
        drift_of(text)


def test_the_page_of_poses(tmp_path, monkeypatch) -> None:
    """Two rendered pairs: estimated, one has no pose and the other is off by half without a word."""
    errors, sizes = {"given": 0.1, "refine": 0.06}, set()

    def measure(ref, read, method, *_):
        sizes.add(ref.files["size"])
        pose = method.name.partition("=")[2]
        error = errors.get(pose, None if ref.files["seed"] > 1 else 0.5)
        error = 0.05 if "perturbed" not in ref.files and pose == "given" else error
        warnings = [] if pose == "estimated" else ["said"]
        notes = {"method": {"warnings": warnings, "residual_px_given": [1.25], "residual_px": [0.5]}}
        status = {"rectified": False, "status": "not applicable" if error is None else "ok"}
        return status | {"all_pixels": {"raw": {"abs_rel": error}, "aligned": None}, "notes": notes}

    monkeypatch.setattr(experiment, "_measure", measure)
    page = tmp_path / "docs" / "results-pose.md"
    options = PosesOptions(rendered=2, out=tmp_path / "out", results=page, quiet=True)
    run_poses("poses", options)
    text = page.read_text()
    assert text == (tmp_path / "out" / "poses.md").read_text()
    assert "geodiff eval poses --rendered 2\n" in text
    assert "| pair | true, given | perturbed, given | perturbed, refined | estimated |" in text
    assert "| mean of 2 pairs | 0.050 | 0.100 | 0.060 | 0.500 of 1 |" in text
    assert "| without a result | 0 | 0 | 0 | 1 |" in text
    assert "| off by more than 0.25, no warning | 0 | 0 | 0 | 1 |" in text
    run_poses("poses", replace(options, rendered_size="256x192", steps=2, out=tmp_path / "small"))
    assert "geodiff eval poses --steps 2 --rendered 2 --rendered-size 256x192\n" in page.read_text()
    assert sizes == {(384, 512), (192, 256)}
    with pytest.raises(ValueError, match="--data"):
        run_poses("poses", replace(options, rendered=0))


@pytest.mark.parametrize("text", ["256", "256x", "0x0", "256x32", "-256x192"])
def test_a_bad_size_of_rendered_pairs_is_an_error(text: str) -> None:
    with pytest.raises(ValueError, match="--rendered-size"):
        CliRunner().invoke(eval_app, ["poses", "--rendered-size", text], catch_exceptions=False)
