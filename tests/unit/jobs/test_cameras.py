"""Cameras and lenses of a pair, by whichever options give them: each view has its own."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs.cameras import OriginalImages, lenses_of, read_cameras, read_rig
from geodiff_plugin.jobs.reading import read_pair
from tests.unit.jobs.pair_files import BARE, ES, KS, SIZES, lens, options
from tests.views import made_rig


def test_a_calibration_is_for_images_of_its_size(files, tmp_path):
    (width, height), camera = SIZES[0], "[50 0 28; 0 50 19; 0 0 1]"
    text = f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline=110\nwidth={{}}\nheight={height}\nndisp=9\n"
    same = files / "left.png"
    other = tmp_path / "other.png"
    Image.open(same).transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(other)
    calib = tmp_path / "calib.txt"
    calib.write_text(text.format(width))
    base = options(files, **BARE, right=other, calib=(calib,))
    pair = read_pair(base)
    assert pair.rig.E[0, 3] == pytest.approx(0.11) and pair.rig.rectified
    assert read_pair(replace(base, baseline=0.3)).rig.E[0, 3] == pytest.approx(0.3)
    with pytest.raises(InputError, match=r"the right image \S*right.png must be 54x40 pixels"):
        read_pair(replace(base, right=files / "right.png"))
    calib.write_text(text.format(width + 1))
    with pytest.raises(InputError, match=r"the left image \S*left.png must be 55x40 pixels"):
        read_pair(base)


def test_every_view_has_the_k_that_is_given_else_that_of_the_left_one(files, tmp_path):
    """``--K``, ``--K-right`` and, in order, ``--view-K``, with and without poses."""
    focals, (width, height) = (100, 110, 120, 130), SIZES[0]
    paths = [tmp_path / f"{focal}.txt" for focal in focals]
    for focal, path in zip(focals, paths, strict=True):
        np.savetxt(path, [[focal, 0, 31.5], [0, focal, 23.5], [0, 0, 1]])
    taken = OriginalImages([np.zeros((height, width, 3), np.float32)] * 4, from_files=False)
    given = options(files, "third", "fourth", k=paths[0], k_right=None, view_k=())
    for more, expected in (
        ({}, [100, 100, 100, 100]),
        ({"k_right": paths[1]}, [100, 110, 100, 100]),
        ({"k_right": paths[1], "view_k": tuple(paths[2:])}, [100, 110, 120, 130]),
        ({"view_k": tuple(paths[2:])}, [100, 100, 120, 130]),
    ):
        posed = read_cameras(replace(given, **more), taken)
        unposed = read_cameras(replace(given, estimate_pose=True, e=None, view_e=(), **more), taken)
        for cameras in (posed, unposed):
            assert [camera.K[0, 0] for camera in cameras.views] == expected, more
            assert [camera.size for camera in cameras.views] == [SIZES[0]] * 4 and not cameras.distorted
        assert len(posed.poses) == 4 and unposed.poses == () and unposed.rig is None


def test_matrices_are_checked_and_named_by_their_options(files, tmp_path):
    np.savetxt(tmp_path / "bad.txt", np.zeros((3, 3)))
    np.save(tmp_path / "bad-pose.npy", 2 * np.eye(4))
    for given, said in (
        ({"k": tmp_path / "bad.txt"}, "--K"),
        ({"k_right": tmp_path / "bad.txt"}, "--K-right"),
        ({"e": tmp_path / "bad-pose.npy"}, "--E"),
        ({"view_k": (tmp_path / "bad.txt",)}, f"--view-K {tmp_path / 'bad.txt'}"),
        ({"view_e": (tmp_path / "bad-pose.npy",)}, f"--view-E {tmp_path / 'bad-pose.npy'}"),
    ):
        with pytest.raises(InputError) as caught:
            read_pair(options(files, "third", **given))
        assert said in str(caught.value)


def test_a_measured_baseline_is_the_length_of_e_and_keeps_its_direction(files, tmp_path):
    E = np.eye(4)
    E[:3, :3], E[:3, 3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], (0.3, 0.0, -0.4)
    np.savetxt(tmp_path / "E.txt", E)
    given = options(files, e=tmp_path / "E.txt")
    estimated, measured = (read_rig(replace(given, baseline=length), SIZES[0]) for length in (None, 0.1))
    np.testing.assert_allclose(estimated.E, E)
    E[:3, 3] = (0.06, 0.0, -0.08)
    np.testing.assert_allclose(measured.E, E)
    assert not estimated.measured and measured.measured
    further = np.eye(4)
    further[:3, 3] = 0.0, 1.0, 0.0
    np.savetxt(tmp_path / "F.txt", further)
    more = options(files, "third", e=tmp_path / "E.txt", view_e=(tmp_path / "F.txt",), baseline=0.1)
    images = [np.zeros((*SIZES[0][::-1], 3), np.float32)] * 3
    poses = read_cameras(more, OriginalImages(images, from_files=False)).poses
    np.testing.assert_allclose(poses[2][:3, 3], [0, 0.2, 0])
    E[:3, 3] = 0
    np.savetxt(tmp_path / "E.txt", E)
    with pytest.raises(InputError, match="Both its cameras have the same position"):
        read_rig(replace(given, baseline=0.1), SIZES[0])


@pytest.mark.filterwarnings("ignore:.*has no unit")
def test_a_rig_is_read_for_images_that_have_other_names_in_its_calibration(files, tmp_path):
    """Of a model with three images: the pair is the one that is named."""
    lines = ["# Camera list", f"1 PINHOLE {SIZES[0][0]} {SIZES[0][1]} 50 50 27 20"]
    (tmp_path / "cameras.txt").write_text("\n".join(lines) + "\n")
    images = [f"{n} 1 0 0 0 {-0.1 * n} 0 0 1 {name}.png\n" for n, name in enumerate("abc", 1)]
    (tmp_path / "images.txt").write_text("# Image list\n" + "\n".join(images) + "\n")
    given = options(files, **BARE, calib=(tmp_path,))
    rig = read_rig(given, SIZES[0], names=("a.png", "c.png"))
    assert rig.E[0, 3] == pytest.approx(0.2) and rig.unit is None
    assert read_rig(given, SIZES[0], names=("c.png", "b.png")).E[0, 3] == pytest.approx(-0.1)
    renamed = replace(given, left=Path("x/b.png"), right=Path("x/a.png"))
    assert read_rig(renamed, SIZES[0]).E[0, 3] == pytest.approx(-0.1)
    assert rig.size_left == SIZES[0] and rig.size_right is None


def numbers_of(lenses) -> list[str | None]:
    return [None if each is None else ",".join(f"{x:g}" for x in each.coefficients) for each in lenses]


FLAT = "0,0,0,0"
A, B, C = "-0.2,0.05,0.001,0", "-0.1,0.02,0,0.002", "0.3,0,0,0"


@pytest.mark.parametrize(
    ("typed", "further", "of_rig", "views", "expected"),
    [
        ((), (), (None, None), 0, [None, None]),
        ((A,), (), (None, None), 0, [A, A]),
        ((A, B), (), (None, None), 2, [A, B, A, A]),
        ((A, FLAT), (C, FLAT), (None, None), 2, [A, None, C, None]),
        ((), (), (A, B), 1, [A, B, A]),
        ((C,), (), (A, B), 1, [C, C, C]),
        ((FLAT,), (B,), (A, A), 1, [None, None, B]),
    ],
)
def test_every_view_has_the_lens_that_is_typed_else_that_of_the_rig(
    files, typed, further, of_rig, views, expected
):
    names = ("third", "fourth")[:views]
    rig = made_rig(KS[0], KS[1], ES[1], lenses=tuple(map(lens, of_rig)))
    given = options(files, *names, distortion=typed, view_distortion=further)
    given = replace(given, view_k=given.view_k if further else ())
    assert numbers_of(lenses_of(given, rig)) == expected
    if of_rig == (None, None):
        assert numbers_of(lenses_of(given)) == expected


def test_lenses_that_contradict_something_are_rejected(files):
    rectified = made_rig(KS[0], KS[1], ES[1], rectified=True, source="calib.txt")
    path = files / "left.png"
    for given, rig, said in (
        ({"distortion": (A, B, C)}, None, "--distortion was passed 3 times"),
        ({"distortion": (FLAT, A)}, rectified, "calib.txt is for rectified images"),
        ({"distortion": (A,), "points_confidence": path}, None, "--points-confidence cannot be used"),
        ({"distortion": (A,), "disparity": path}, None, "--disparity cannot be used"),
        ({"distortion": (A,), "prior_map": path}, None, "--prior-map cannot be used"),
    ):
        with pytest.raises(InputError, match=said):
            lenses_of(options(files, **given), rig)
    with pytest.raises(InputError, match="--view-K is set, and LEFT has lens distortion"):
        lenses_of(options(files, "third", distortion=(FLAT, A)))
    with pytest.raises(InputError, match="--view-distortion must be"):
        lenses_of(options(files, "third", view_distortion=("1",)))
    lenses_of(options(files, distortion=(FLAT,)), rectified)
    lenses_of(options(files, distortion=(FLAT, A), prior_map=path))  # the left lens does not distort
    lenses_of(options(files, "third", distortion=(FLAT, FLAT)))
