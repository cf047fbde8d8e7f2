"""Options of ``geodiff depth --estimate-pose`` that need no photograph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.cli.inputs import _read_known, lenses_of, read_inputs
from geodiff_plugin.cli.options import DepthOptions
from geodiff_plugin.formats.distortion import distortion_from_text
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.types import Rig


def told(*, own=(None, None), rectified=False, **given) -> list[float | None]:
    """First coefficient of every lens."""
    rig = Rig(np.eye(3), np.eye(3), np.eye(4), source="calib.txt", distortion=own, rectified=rectified)
    lenses = lenses_of(DepthOptions(left=Path("l.png"), right=Path("r.png"), **given), rig)
    return [None if lens is None else float(lens.coefficients[0]) for lens in lenses]


def test_every_photograph_has_its_lens() -> None:
    view, two = (Path("v.png"),), (Path("v.png"), Path("w.png"))
    one, other, straight = "0.1,0,0,0", "0.2,0,0,0", "0,0,0,0"
    assert told() == [None, None]
    assert told(distortion=(one,), view=view) == [0.1, 0.1, 0.1], "as K, the left one's"
    assert told(distortion=(one, other), view=two) == [0.1, 0.2, 0.1, 0.1]
    assert told(view=two, view_distortion=(straight, other)) == [None, None, None, 0.2]
    assert told(distortion=(one,), view=view, view_distortion=(straight,)) == [0.1, 0.1, None]
    own = (distortion_from_text(one), distortion_from_text(straight))
    assert told(own=own, view=view) == [0.1, None, 0.1], "of a calibration file"
    assert told(own=own, view=view, view_k=view, view_distortion=(other,)) == [0.1, None, 0.2]
    with pytest.raises(InputError, match="--view-distortion must be given for each"):
        told(own=own, view=view, view_k=view)
    assert told(view=view, view_k=view) == [None, None, None]
    with pytest.raises(InputError, match="--view-distortion must be k1"):
        told(view=view, view_distortion=("round",))


def test_rectified_images_have_no_lens() -> None:
    said = r"--distortion must be left out where .* rectified images \(calib.txt\); got 0.1,0,0,0. Drop it"
    with pytest.raises(InputError, match=said):
        told(distortion=("0.1,0,0,0",), rectified=True)
    assert told(distortion=("0,0,0,0",), rectified=True) == [None, None], "it says the same as the file"
    assert told(distortion=("0.1,0,0,0",)) == [0.1, 0.1], "cameras as they took the images"


FILE = Path("K.txt")
FOUR = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"k": FILE, "fov": 60.0}, "K must be given in one way: .*; got matrices and --fov"),
        ({"k": FILE, **FOUR}, "got matrices and parameters"),
        ({"fov": 60.0, **FOUR}, "got parameters and --fov"),
        ({"k_right": FILE, "fov": 60.0}, "got matrices and --fov"),
        ({"k_right": FILE}, "--K must be given with --K-right"),
        ({"fx": 60.0}, "--fx --fy --cx --cy must be given all together"),
        ({"cameras": "2,3"}, "--cameras must be left out with --estimate-pose"),
        ({"calib": (FILE,)}, "--calib must be left out with --estimate-pose"),
        ({"e": FILE}, "--E must be left out with --estimate-pose"),
        ({"cropped": True}, "--cropped must be given with --K, .*; got K by EXIF"),
        ({"cropped": True, "fov": 60.0}, "got K by --fov"),
    ],
)
def test_there_is_one_way_to_give_intrinsics(given, said) -> None:
    with pytest.raises(InputError, match=said):
        DepthOptions(left=Path("l.png"), right=Path("r.png"), estimate_pose=True, **given).cameras_way()


@pytest.mark.parametrize(
    ("given", "way"),
    [
        ({}, "EXIF"),
        ({"fov": 60.0, "baseline": 0.1}, "--fov"),
        ({"fov": 60.0, "view_k": (FILE,), "cropped": True}, "--fov"),
        ({**FOUR, "cropped": True}, "parameters"),
        ({"k": FILE, "k_right": FILE, "cropped": True}, "matrices"),
    ],
)
def test_ways_to_give_intrinsics(given, way) -> None:
    assert (
        DepthOptions(left=Path("l.png"), right=Path("r.png"), estimate_pose=True, **given).cameras_way()
        == way
    )


LENS = "0.2,0,0,0"


def straight(x: float, y: float) -> tuple[float, float]:
    """Where a pixel behind that lens lies without it: r (1 + 0.2 r^2) = R, solved by bisection."""
    ray = np.array([x - 31.5, y - 23.5]) / 60
    far, low, high = float(np.linalg.norm(ray)), 0.0, 2.0
    for _ in range(60):
        r = (low + high) / 2
        low, high = (r, high) if r * (1 + 0.2 * r * r) < far else (low, r)
    u, v = ray / far * r * 60 + (31.5, 23.5)
    return float(u), float(v)


@pytest.fixture
def millimetres(pair_files) -> Path:
    """A map of two depths, 2 m at (10, 12) and 3 m at (50, 40)."""
    depth = np.zeros((48, 64))
    depth[12, 10], depth[40, 50] = 2000.0, 3000.0
    np.save(pair_files.folder / "mm.npy", depth)
    return pair_files.folder / "mm.npy"


def expected_points() -> np.ndarray:
    at = np.array([straight(10, 12), straight(50, 40)])
    return np.c_[(at - (31.5, 23.5)) / 60, np.ones(2)] * [[2.0], [3.0]]


def told_to_estimate(pair_files, monkeypatch, **given) -> dict:
    """What the estimation of poses is called with."""
    told = {}

    def stop(_images, **options):
        told.update(options)
        raise InterruptedError

    monkeypatch.setattr(GeometryGuidance, "from_photographs", stop)
    options = DepthOptions(
        left=pair_files.left, right=pair_files.right, device="cpu", estimate_pose=True, **FOUR | given
    )
    with pytest.raises(InterruptedError):
        read_inputs(options, options.config())
    return told


def test_estimated_poses_take_points_in_their_unit(pair_files, monkeypatch, millimetres) -> None:
    told = told_to_estimate(pair_files, monkeypatch, points=millimetres, points_scale=1000.0)
    assert told["points"].shape == (48, 64) and told["points"][12, 10] == 2.0
    told = told_to_estimate(
        pair_files, monkeypatch, points=millimetres, points_scale=1000.0, distortion=(LENS,)
    )
    np.testing.assert_allclose(told["points"], expected_points(), atol=1e-4)


def test_a_known_length_goes_through_the_lens(pair_files, monkeypatch) -> None:
    given = {"known_length": "10,12,50,40,1.5"}
    assert told_to_estimate(pair_files, monkeypatch, **given)["known_length"] == (10, 12, 50, 40, 1.5)
    told = told_to_estimate(pair_files, monkeypatch, **given, distortion=(LENS,))
    ends = (*straight(10, 12), *straight(50, 40), 1.5)
    assert told["known_length"] == pytest.approx(ends, abs=0.01)
    with pytest.raises(InputError, match="--known-length must be between two pixels that the lens shows"):
        told_to_estimate(pair_files, monkeypatch, known_length="0,0,60,40,1", distortion=("-1,0,0,0",))


def test_cropped_photographs_are_told_of(pair_files, monkeypatch) -> None:
    assert told_to_estimate(pair_files, monkeypatch, cropped=True)["cropped"] is True


def test_a_map_of_known_depths_goes_through_the_lens(pair_files, millimetres) -> None:
    known = {"points": millimetres, "points_scale": 1000.0, "device": "cpu"}
    cameras = FOUR | {"baseline": 0.12, "distortion": (LENS,)}
    options = DepthOptions(left=pair_files.left, right=pair_files.right, **known, **cameras)
    inputs = read_inputs(options, options.config())
    found = inputs.guidance.inputs[0].points.numpy()
    np.testing.assert_allclose(found, expected_points(), atol=1e-4)
    lens, K = distortion_from_text(LENS), inputs.rig.K_left
    with pytest.raises(InputError, match="--points must be a map of .* 32x24 pixels; got 64x48"):
        _read_known(options, K, lens, (32, 24))
    points = pair_files.folder / "points.txt"
    points.write_text("0.1 0.2 2\n")
    listed = DepthOptions(left=pair_files.left, points=points)
    np.testing.assert_allclose(_read_known(listed, K, lens, (64, 48)), [[0.1, 0.2, 2.0]], atol=1e-6)
