"""Depth and disparity maps: units, unknown pixels and signs, against OpenCV and formulas written out here."""

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from geodiff_plugin._internal import strips as _strips
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import depth as module
from geodiff_plugin.formats.depth import (
    depth_mm,
    depth_of_disparity,
    disparity_of_depth,
    read_confidence,
    read_depth_png,
    read_map,
    read_measured,
    write_depth_mm,
    write_depth_npy,
    write_pfm,
)
from geodiff_plugin.formats.maps import read_pfm
from geodiff_plugin.types import Rig
from tests.views import made_rig

RNG = np.random.default_rng(4)
WHOLE = np.array([[0, 1, 255, 256], [1234, 65534, 65535, 40000]], np.uint16)
FLOATS = np.array([[1.5, 0.0, -2.0, np.nan], [np.inf, 65535.0, -np.inf, 0.25]], np.float32)


def save(path, values: np.ndarray):
    """A map in the format of the suffix, written by other programs than ours."""
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez(path, depth=values, other=values[:1] + 1)
    elif path.suffix in (".png", ".tiff"):
        Image.fromarray(values).save(path)
    else:
        cv2.imwrite(str(path), values)
    return path


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy", ".npz"])
def test_whole_numbers_of_16_bits_are_millimetres_whose_ends_are_unknown(suffix, tmp_path):
    path = save(tmp_path / f"d{suffix}", WHOLE)
    known = (WHOLE > 0) & (WHOLE != 65535)
    for per_m, units in ((None, 1000), (4000.0, 4000), (256, 256)):
        depth_m, is_known = read_measured(path, per_m)
        np.testing.assert_array_equal(is_known, known)
        np.testing.assert_allclose(depth_m, np.where(known, WHOLE / units, 0), rtol=1e-6)
        assert depth_m.dtype == np.float32


@pytest.mark.parametrize("suffix", [".tiff", ".npy", ".npz", ".pfm"])
def test_floats_are_metres_whatever_their_size(suffix, tmp_path):
    path = save(tmp_path / f"d{suffix}", FLOATS)
    known = np.array([[1, 0, 0, 0], [0, 1, 0, 1]], bool)
    for per_m, units in ((None, 1), (10.0, 10)):
        depth_m, is_known = read_measured(path, per_m)
        np.testing.assert_array_equal(is_known, known)
        np.testing.assert_allclose(depth_m, np.where(known, FLOATS, 0) / units, rtol=1e-6)


def test_whole_numbers_of_32_bits_have_no_largest_value(tmp_path):
    values = np.array([[65535, 70000], [0, -5]], np.int32)
    depth_m, known = read_measured(save(tmp_path / "d.npy", values))
    np.testing.assert_allclose(depth_m, [[65.535, 70], [0, 0]])
    np.testing.assert_array_equal(known, [[True, True], [False, False]])


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".npy", ".pfm", ".npz"])
def test_the_map_of_a_model_is_unknown_where_an_image_is_0_and_where_floats_are_not_finite(suffix, tmp_path):
    values = WHOLE if suffix == ".png" else FLOATS
    expected = values.astype(float)
    if suffix in (".png", ".tiff"):
        expected = np.where(values > 0, expected, np.nan)
    expected = np.where(np.isfinite(values), expected, np.nan)
    np.testing.assert_array_equal(read_map(save(tmp_path / f"m{suffix}", values)), expected)
    if suffix == ".npy":  # a model's disparities, as whole numbers
        np.save(tmp_path / "w.npy", np.array([[-3, 0], [4, 70000]]))
        np.testing.assert_array_equal(read_map(tmp_path / "w.npy"), [[-3, 0], [4, 70000]])


def test_confidences_of_every_type_are_fractions(tmp_path):
    levels = RNG.random((5, 7)).astype(np.float32)
    np.save(tmp_path / "c.npy", levels[..., None])
    write_pfm(tmp_path / "c.pfm", levels)
    for name in ("c.npy", "c.pfm"):
        np.testing.assert_array_equal(read_confidence(tmp_path / name), levels)
    for bits, kind in ((8, np.uint8), (16, np.uint16)):
        whole = np.rint(levels * (2**bits - 1)).astype(kind)
        whole[0, :2] = 0, 2**bits - 1
        Image.fromarray(whole).save(tmp_path / "c.png")
        read = read_confidence(tmp_path / "c.png")
        np.testing.assert_allclose(read, whole / (2**bits - 1), rtol=1e-6)
        assert read.dtype == np.float32 and (read[0, 0], read[0, 1]) == (0, 1)
    Image.fromarray(np.zeros((5, 7, 3), np.uint8)).save(tmp_path / "c.png")
    with pytest.raises(InputError, match=r"a grey PNG of 8 or 16 bits; got .* of shape \(5, 7, 3\)"):
        read_confidence(tmp_path / "c.png")


def test_millimetres_are_rounded_and_end_at_the_largest_of_16_bits(tmp_path, monkeypatch):
    monkeypatch.setattr(_strips, "STRIP_PIXELS", 4)
    depth_m = np.array([[0.0004, 0.0006, 1.2344, 1.2346], [65.5354, 65.5356, 65.5349, -0.001]])
    depth_m = np.vstack([depth_m, [[np.nan, np.inf, -np.inf, 3.0]]])
    expected = np.array([[0, 1, 1234, 1235], [65535, 0, 65535, 0], [0, 0, 0, 3000]])
    np.testing.assert_array_equal(depth_mm(depth_m), expected)
    assert write_depth_mm(tmp_path / "d.png", depth_m) == 6
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED), expected)
    read, known = read_depth_png(tmp_path / "d.png", 500.0)
    np.testing.assert_allclose(read, expected / 500)
    np.testing.assert_array_equal(known, expected > 0)
    np.testing.assert_allclose(read_depth_png(tmp_path / "d.png")[0], expected / 1000)
    Image.fromarray(np.zeros((3, 4), np.uint8)).save(tmp_path / "grey.png")
    with pytest.raises(InputError, match="depth must be a 16-bit grey PNG file; got .* of mode L"):
        read_depth_png(tmp_path / "grey.png")
    with pytest.raises(InputError, match=r"of shape \(H, W\); got shape \(1, 3, 4\)"):
        write_depth_npy(tmp_path / "d.npy", depth_m[None])


def rig(baseline: float = 0.31, unit: str | None = "m") -> Rig:
    K_left = np.array([[420.0, 0, 33.5], [0, 415.0, 21.0], [0, 0, 1]])
    K_right = K_left + np.array([[0, 0, 4.25], [0, 0, 0], [0, 0, 0]])
    E = np.eye(4)
    E[0, 3] = baseline
    return made_rig(K_left, K_right, E, ((60, 40), (60, 40)), unit=unit, source="made.txt")


def point_disparity(rig: Rig, u: np.ndarray, v: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Left column minus right column of the points, by projecting them into both images."""
    points = np.linalg.inv(rig.K_left) @ np.stack([u, v, np.ones_like(u)]) * z
    seen = rig.K_right @ (rig.E[:3, :3].T @ (points - rig.E[:3, 3:]))
    return u - seen[0] / seen[2]


def test_disparities_are_those_of_projected_points():
    depth_m = RNG.uniform(1.0, 60.0, (40, 60))
    v, u = np.mgrid[:40, :60].astype(float)
    expected = point_disparity(rig(), u.ravel(), v.ravel(), depth_m.ravel()).reshape(40, 60)
    assert expected.min() < 0 < expected.max(), "the offset between the centres shows"
    depth_m[3, 4], depth_m[5, 6], depth_m[7, 8] = np.nan, 0, -1
    expected[3, 4] = expected[5, 6] = expected[7, 8] = np.inf
    cameras = rig()
    got = disparity_of_depth(depth_m, cameras.K_left, cameras.K_right, cameras.E)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)
    turned = cameras.E.copy()
    turned[:2, :2] = [[0.99, -0.14], [0.14, 0.99]]
    for bad in (turned, np.linalg.inv(cameras.E), cameras.E + 0.01 * np.eye(4, k=2)):
        with pytest.raises(
            InputError, match="a submission must be of a rectified pair; got a pair with a different"
        ):
            disparity_of_depth(depth_m, cameras.K_left, cameras.K_right, bad)


@pytest.mark.parametrize(("rows", "columns"), [(40, 60), (20, 30), (80, 120), (16, 24)])
@pytest.mark.parametrize("suffix", [".pfm", ".png", ".npy"])
def test_depth_of_a_disparity_map_in_the_size_of_the_image_or_scaled(rows, columns, suffix, tmp_path):
    cameras, scale = rig(), columns / 60
    # A column's depth is that of the pixel of the map whose area it lies in.
    depth_m = RNG.uniform(2.0, 9.0, (rows, columns))
    v, u = np.mgrid[:40, :60].astype(float)
    row, column = (np.floor((at + 0.5) * scale).astype(int) for at in (v, u))
    disparity = 420 * 0.31 / depth_m - 4.25
    assert disparity.min() > 5
    stored = disparity * scale
    stored[2, 3], depth_m[2, 3] = 0, 0
    units = {".pfm": 1, ".png": 256, ".npy": 16}[suffix]
    if suffix == ".pfm":
        write_pfm(tmp_path / "d.pfm", stored)
    elif suffix == ".png":
        Image.fromarray(np.rint(stored * 256).astype(np.uint16)).save(tmp_path / "d.png")
    else:
        np.save(tmp_path / "d.npy", np.rint(stored * 16).astype(np.int16))
    per_px = 16 if suffix == ".npy" else None
    got = depth_of_disparity(tmp_path / f"d{suffix}", cameras, (60, 40), per_px=per_px)
    off = 420 * 0.31 / (420 * 0.31 / np.where(depth_m > 0, depth_m, 1)) ** 2 * 0.5 / (units * scale)
    tolerance = (1e-4 + off * (units > 1) * depth_m)[row, column] * 2
    assert (np.abs(got - depth_m[row, column]) <= tolerance + 1e-3).all()
    assert (got[(row == 2) & (column == 3)] == 0).all() and got.dtype == np.float32


def test_a_disparity_states_what_is_missing(tmp_path):
    write_pfm(tmp_path / "d.pfm", np.full((40, 60), 7.0))
    for change, said in (
        ({"rig": rig(unit=None)}, "disparity must be used with a rig in metres; got the rig of made.txt"),
        ({"rig": rig(baseline=-0.3)}, "disparity must be of a rectified pair; got the rig of made.txt"),
        ({"size": (60, 42)}, "a map with the aspect ratio of the left image, 60x42 pixels; got .* of 60x40"),
        ({"per_px": 0.0}, "disparity: units per pixel"),
    ):
        given = {"rig": rig(), "size": (60, 40), "per_px": None} | change
        with pytest.raises(InputError, match=said):
            depth_of_disparity(tmp_path / "d.pfm", given["rig"], given["size"], per_px=given["per_px"])
    with pytest.raises(TypeError):
        depth_of_disparity(
            tmp_path / "d.pfm", rig(), (60, 40), "disparity", 1.0
        )  # settings are given by name
    assert depth_of_disparity(tmp_path / "d.pfm", rig(), (121, 80)).shape == (80, 121), "sides may be rounded"
    np.save(tmp_path / "w.npy", np.full((40, 60), 160))
    with pytest.raises(InputError, match=r"in pixels as floats; got .* of int64. .* pass --points-scale 16"):
        depth_of_disparity(tmp_path / "w.npy", rig(), (60, 40))


@pytest.mark.parametrize(
    ("negative", "refused"), [(0, False), (9, False), (10, False), (11, True), (20, True)]
)
def test_disparities_of_which_most_are_negative_are_rejected(negative, refused, tmp_path):
    values = np.zeros((5, 8))
    values.flat[:20] = 6.0
    values.flat[:negative] = -6.0
    values[4] = np.nan
    np.save(tmp_path / "d.npy", values)
    cameras = rig()
    if refused:
        with pytest.raises(InputError, match="positive .column in the left image minus column in the right"):
            depth_of_disparity(tmp_path / "d.npy", cameras, (8, 5))
        return
    depth_m = depth_of_disparity(tmp_path / "d.npy", cameras, (8, 5))
    known = values > 0
    np.testing.assert_allclose(depth_m, np.where(known, 420 * 0.31 / (6 + 4.25), 0), rtol=1e-6)


def test_a_far_point_of_negative_disparity_has_a_depth_where_the_centres_differ(tmp_path):
    values = np.full((5, 8), 6.0)
    values[0, :3] = -4.0, -4.25, -5.0
    np.save(tmp_path / "d.npy", values)
    depth_m = depth_of_disparity(tmp_path / "d.npy", rig(), (8, 5))
    np.testing.assert_allclose(depth_m[0, :4], [420 * 0.31 / 0.25, 0, 0, 420 * 0.31 / 10.25], rtol=1e-5)


def test_a_rig_may_be_off_by_a_thousandth_of_its_baseline_or_of_a_metre():
    for baseline, off, fits in (
        (0.5, 0.0009, True),
        (0.5, 0.0011, False),
        (4.0, 0.0039, True),
        (4.0, 0.0041, False),
    ):
        for sign in (1, -1):
            E = rig(baseline).E
            E[1, 3] = sign * off
            if fits:
                assert module._baseline(E, "x", "y") == baseline
            else:
                with pytest.raises(InputError, match="x must be of a rectified pair; got y"):
                    module._baseline(E, "x", "y")


@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    values=arrays(
        np.float32,
        st.tuples(st.integers(1, 9), st.integers(1, 9)),
        elements=st.floats(width=32, allow_nan=False),
    )
)
def test_pfm_comes_back_as_opencv_has_it(tmp_path, values):
    path = tmp_path / "a.pfm"
    write_pfm(path, values)
    np.testing.assert_array_equal(read_pfm(path), values)
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), values)
    cv2.imwrite(str(path), values)
    np.testing.assert_array_equal(read_pfm(path), values)
    head = f"Pf\n{values.shape[1]} {values.shape[0]}\n1.0\n".encode()
    path.write_bytes(head + values[::-1].astype(">f4").tobytes())
    np.testing.assert_array_equal(read_pfm(path), values)


def test_depth_in_metres_and_millimetres_comes_back(tmp_path):
    depth = np.array([[0.0004, 1.2344, 65.535], [65.536, np.nan, -np.inf], [np.inf, -1.0, 0.001]])
    write_depth_npy(tmp_path / "d.npy", depth)
    np.testing.assert_array_equal(np.load(tmp_path / "d.npy", allow_pickle=False), depth.astype(np.float32))
    zeros = write_depth_mm(tmp_path / "d.png", depth)
    read, known = read_depth_png(tmp_path / "d.png")
    np.testing.assert_allclose(read, [[0, 1.234, 65.535], [0, 0, 0], [0, 0, 0.001]], atol=1e-6)
    np.testing.assert_array_equal(known, read > 0)
    assert zeros == 6 == int((~known).sum())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.npy", "d.png"]
    np.testing.assert_array_equal(read_depth_png(tmp_path / "d.png", 500.0)[0], 2 * read)
