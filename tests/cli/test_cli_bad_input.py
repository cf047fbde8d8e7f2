"""Bad input ends with one line that names it and exit code 2; no weights load, nothing is written."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image


@pytest.fixture(autouse=True)
def no_weights(monkeypatch):
    """Loading a prior here is a failure of the test."""

    def load(*_args, **_kwargs):
        raise AssertionError("weights were loaded before the input was checked")

    monkeypatch.setattr("geodiff_plugin.cli.depth.load_guided_prior", load)


@pytest.fixture
def refused(geodiff, pair_files):
    """Run, and see that it is refused in one line that has all these words."""

    def run(arguments, *words):
        files = sorted(pair_files.folder.rglob("*"))
        answer = geodiff(*arguments)
        assert answer.code == 2, answer
        assert answer.out == ""
        assert answer.err.startswith("geodiff: ")
        assert len(answer.err.strip().splitlines()) == 1, answer.err
        for word in words:
            assert word in answer.err, (word, answer.err)
        assert sorted(pair_files.folder.rglob("*")) == files
        return answer.err

    return run


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--steps", 0], ["--steps", "between 1", "0"]),
        (["--steps", -3], ["--steps", "-3"]),
        (["--ensemble", 0], ["--ensemble"]),
        (["--resolution", 100], ["--resolution", "multiple of 8", "Try 96"]),
        (["--resolution", 8], ["--resolution", "32"]),
        (["--near", 5, "--far", 2], ["--near", "--far", "5", "2"]),
        (["--near", 2, "--far", 2], ["--near"]),
        (["--near", 2], ["--far", "--near"]),
        (["--near", 0, "--far", 2], ["--near"]),
        (["--near", "nan", "--far", 2], ["--near", "nan"]),
        (["--far", "inf", "--near", 1], ["--far", "inf"]),
        (["--seed", -1], ["--seed"]),
        (["--device", "tpu"], ["--device", "tpu"]),
        (["--device", "meta"], ["--device", "meta"]),
        (["--dtype", "float64"], ["--dtype", "float16", "float64"]),
        (["--knob", "speed=9"], ["--knob", "speed=9", "inner_steps"]),
        (["--knob", "inner_steps"], ["--knob", "KNOB=VALUE"]),
        (["--knob", "weights.smooth=1"], ["weights", "smooth"]),
        (["--knob", "inner_steps=-1"], ["inner_steps", "-1"]),
        (["--knob", "depth_range=[1,2]"], ["--near", "--far"]),
        (["--preset", "best"], ["--preset", "paper", "best"]),
        (["--cameras", "2"], ["--cameras", "2,3"]),
        (["--cameras", "2,2"], ["--cameras"]),
        (["--cameras", "0,1"], ["cameras"]),
    ],
)
def test_options(refused, pair_files, options, words):
    refused([*pair_files.command, *options], *words)


def test_device_that_is_not_here(refused, pair_files, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    refused([*pair_files.command, "--device", "cuda"], "--device", "cuda", "PyTorch")


def test_no_calibration(refused, pair_files):
    refused(pair_files.images, "calibration", "--calib", "--fx", "--E")


def test_two_ways_of_calibration(refused, pair_files):
    refused([*pair_files.command, "--fx", 60], "calibration", "one way")


def test_missing_parameters(refused, pair_files):
    refused([*pair_files.images, "--fx", 60, "--baseline", 0.12], "--fy", "--cx", "--cy", "31.5", "23.5")


def parameters(**changes):
    values = {"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5, "baseline": 0.12} | changes
    return [part for name, value in values.items() for part in (f"--{name}", value)]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": 0}, ["fx"]),
        ({"fy": -60}, ["fy"]),
        ({"fx": "nan"}, ["fx"]),
        ({"cy": "inf"}, ["cy"]),
        ({"cx": 131.5}, ["64x48", "131.5", "resolution"]),
        ({"baseline": 0}, ["baseline"]),
        ({"baseline": "nan"}, ["baseline"]),
    ],
)
def test_parameters(refused, pair_files, changes, words):
    refused([*pair_files.images, *parameters(**changes)], *words)


def test_missing_file(refused, pair_files):
    calib = ["--calib", pair_files.calib]
    refused(
        ["depth", "nothing.png", pair_files.right, "--calib", pair_files.calib],
        "LEFT",
        "nothing.png",
        "exist",
    )
    refused(["depth", pair_files.left, "nothing.png", *calib], "RIGHT", "nothing.png")
    refused([*pair_files.images, "--calib", "nothing.txt"], "calibration", "nothing.txt")


def test_folder_for_a_file(refused, pair_files):
    refused(["depth", pair_files.folder, pair_files.right, "--calib", pair_files.calib], "LEFT", "folder")


def test_not_an_image(refused, pair_files):
    refused(["depth", pair_files.calib, pair_files.right, "--calib", pair_files.calib], "LEFT", "image")


def test_truncated_image(refused, pair_files):
    whole = pair_files.left.read_bytes()
    pair_files.left.write_bytes(whole[: len(whole) // 2])
    refused(pair_files.command, "LEFT", "cut off")


def test_empty_file(refused, pair_files):
    pair_files.right.write_bytes(b"")
    refused(pair_files.command, "RIGHT", "empty")


def test_small_image(refused, pair_files):
    Image.new("RGB", (64, 31)).save(pair_files.left)
    refused(pair_files.command, "LEFT", "32", "64x31")


def test_same_image_twice(refused, pair_files):
    refused(["depth", pair_files.left, pair_files.left, "--calib", pair_files.calib], "RIGHT")


def test_further_views(refused, pair_files):
    folder = pair_files.folder
    third, pose, still, K = folder / "third.png", folder / "E.txt", folder / "still.txt", folder / "K.txt"
    Image.new("RGB", (64, 48)).save(third)
    np.savetxt(still, np.eye(4))
    np.savetxt(pose, np.eye(4) + 0.1 * np.eye(4, k=3))
    np.savetxt(K, 4.0 * np.diag([60.0, 60.0, 0.25]) + 128.0 * np.eye(3, k=2))
    command = [*pair_files.command, "--view"]
    refused([*command, third], "--view-E", "once for each of 1 --view", "0 times")
    refused([*pair_files.command, "--view-E", pose], "--view-E", "0 --view", "1 times")
    refused([*command, third, "--view-E", still], "--view-E", "baseline")
    refused([*command, third, "--view-E", pose, "--view-K", K], "third.png", "outside")
    refused([*command, pair_files.right, "--view-E", pose], "--view 1", "another photograph than RIGHT")
    refused([*command, folder / "none.png", "--view-E", pose], "none.png")
    refused([*command, third, "--view-E", pose, "--preset", "paper"], "--view", "two views")


def test_known_points_in_integers(refused, pair_files):
    np.save(pair_files.folder / "mm.npy", np.full((48, 64), 2500, np.uint16))
    refused([*pair_files.command, "--points", pair_files.folder / "mm.npy"], "--points", "millimetres")


def test_unknown_calibration_format(refused, pair_files):
    pair_files.calib.write_text("my camera is a good one\n")
    refused(pair_files.command, "calibration", "calib.txt")


def test_image_for_a_calibration(refused, pair_files):
    refused([*pair_files.images, "--calib", pair_files.left], "calibration", "left.png")


def test_calibration_of_another_size(refused, pair_files, textured_plane):
    pair_files.write_calibration(textured_plane.K, 0.12, (128, 96))
    refused(pair_files.command, "left.png", "128x96", "64x48", "calib.txt")


def test_principal_point_outside(refused, pair_files, textured_plane):
    K = textured_plane.K.copy()
    K[:2] *= 4
    pair_files.write_calibration(K, 0.12, (64, 48))
    refused(pair_files.command, "64x48", "outside")


def test_zero_baseline_in_a_file(refused, pair_files, textured_plane):
    pair_files.write_calibration(textured_plane.K, 0.0, (64, 48))
    refused(pair_files.command, "baseline")


@pytest.mark.parametrize("typed", ["0.1", "fisheye:1,2,3", "a,b,c,d", "lens:1,2,3,4"])
def test_distortion_that_is_none(refused, pair_files, typed):
    refused([*pair_files.command, "--distortion", typed], "--distortion", "k1,k2,p1,p2")


@pytest.fixture
def matrices(pair_files, textured_plane):
    """Options of --K and --E files, after a change."""

    def options(K=textured_plane.K, E=textured_plane.E, K_right=None):
        np.savetxt(pair_files.folder / "K.txt", K)
        np.save(pair_files.folder / "E.npy", E)
        if K_right is None:
            return [*pair_files.images, "--K", "K.txt", "--E", "E.npy"]
        np.savetxt(pair_files.folder / "Kr.txt", K_right)
        return [*pair_files.images, "--K", "K.txt", "--E", "E.npy", "--K-right", "Kr.txt"]

    return options


def changed(matrix, index, value):
    matrix = np.array(matrix, dtype=float)
    matrix[index] = value
    return matrix


def test_matrices(refused, matrices, pair_files, textured_plane):
    K, E = textured_plane.K, textured_plane.E
    refused(matrices(K=np.eye(4)), "--K", "3x3")
    refused(matrices(K=changed(K, (0, 0), 0)), "--K", "focal")
    refused(matrices(K=changed(K, (1, 1), np.nan)), "--K", "NaN")
    refused(matrices(K_right=changed(K, (0, 2), 500)), "K of the right", "64x48", "outside")
    refused(matrices(K_right=np.eye(2)), "--K-right")
    refused(matrices(E=changed(E, (0, 3), np.inf)), "--E")
    refused(matrices(E=np.diag([1.0, 1, 1.1, 1])), "--E", "rigid", "determinant")
    refused(matrices(E=np.diag([1.0, 1, -1, 1])), "--E", "rigid")
    refused(matrices(E=changed(E, (3, 0), 0.5)), "--E", "last row")
    refused(matrices(E=np.eye(4)), "E", "baseline")
    refused(matrices(E=np.eye(3)), "--E", "4x4")
    matrices()
    refused([*pair_files.images, "--K", "K.txt"], "--E")
    refused([*pair_files.images, "--E", "E.npy"], "--K")
    refused([*pair_files.images, "--K", "K.txt", "--E", "none.npy"], "--E", "none.npy")
    refused([*pair_files.images, "--K", "K.txt", "--E", pair_files.left], "--E")


def test_output_folder(refused, pair_files):
    refused([*pair_files.command, "--out", pair_files.folder], "--out", "--overwrite")
    refused([*pair_files.command, "--out", pair_files.left], "--out", "left.png")


def test_unknown_option_and_missing_argument(geodiff, pair_files):
    """What the option parser itself refuses has exit code 2 as well."""
    assert geodiff("depth", pair_files.left).code == 2
    assert geodiff(*pair_files.command, "--stepps", 3).code == 2
    assert geodiff(*pair_files.command, "--steps", "many").code == 2
    assert geodiff("dept").code == 2
