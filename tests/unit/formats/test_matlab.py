"""Calibrations from MATLAB and Bouguet's toolbox, with skew."""

import json

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import matlab
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.calibrated_pair import (
    K_LEFT,
    KS,
    LENS_RIGHT,
    LENSES,
    SIZES,
    T,
    assert_is_the_pair,
    numbers,
    vector,
    words,
)
from tests.views import lenses_of

SKEWS = (3.25, -1.75)


def matlab_text(
    new: bool, unit: str | None = "mm", factor: float = 1000.0, radial: int = 3, skew=(0, 0), **changes
):
    entries = {}
    for n in range(2):
        K = KS[n] + [[0, skew[n], 1], [0, 0, 1], [0, 0, 0]]  # MATLAB counts pixels from 1
        k1, k2, p1, p2, k3, *_ = LENSES[n]
        camera = {"RadialDistortion": [k1, k2, k3][:radial], "TangentialDistortion": [p1, p2]}
        camera |= {"ImageSize": [SIZES[n][1], SIZES[n][0]], "WorldUnits": unit if n == 0 else "furlong"}
        camera |= {"K": K.tolist()} if new else {"IntrinsicMatrix": K.T.tolist()}
        entries[f"CameraParameters{n + 1}"] = {k: v for k, v in (camera | changes).items() if v != "none"}
    shift = (factor * T[:3, 3]).tolist()
    if new:
        entries["PoseCamera2"] = {"R": T[:3, :3].tolist(), "Translation": shift}
    entries |= {
        "RotationOfCamera2": T[:3, :3].T.tolist(),
        "TranslationOfCamera2": shift if not new else [9, 9, 9],
    }
    return json.dumps(entries)


def read(text: str):
    return matlab.read_matlab((text,), CameraChoice())


@pytest.mark.parametrize("new", [True, False])
@pytest.mark.parametrize(
    ("unit", "factor"), [("mm", 1e3), ("millimeters", 1e3), ("CM", 1e2), ("m", 1.0), (None, 1e3), ("", 1e3)]
)
def test_matlab_lengths_use_the_world_unit(new, unit, factor):
    assert_is_the_pair(read(matlab_text(new, unit, factor)))
    with pytest.raises(InputError, match=r"\AWorldUnits must be one of mm, .*, m, .*; got furlong\.\Z"):
        read(matlab_text(new, "furlong"))


@pytest.mark.parametrize("new", [True, False])
def test_matlab_skew_is_kept_and_two_radial_coefficients_suffice(new):
    rig = read(matlab_text(new, skew=SKEWS, radial=2))
    assert (rig.K_left[0, 1], rig.K_right[0, 1]) == SKEWS
    np.testing.assert_allclose(rig.K_left[:, 2], K_LEFT[:, 2])
    for lens, expected in zip(lenses_of(rig), LENSES, strict=True):
        np.testing.assert_array_equal(lens.coefficients, [*expected[:4], 0.0])
    bare = read(matlab_text(new, TangentialDistortion="none", ImageSize=None))
    assert bare.size_left is None
    np.testing.assert_array_equal(bare.right.lens.coefficients, [*LENS_RIGHT[:2], 0, 0, LENS_RIGHT[4]])


def bouguet_text(as_script: bool, turn: str, skew=SKEWS, count: int = 5) -> str:
    lines = ["% comment: fc_left = [ 1 2 ]", "cc_left_error = [ 1 ; 1 ];"]
    between = " ; " if as_script else "   "
    for n, side in enumerate(("left", "right")):
        fx, fy, cx, cy = numbers(KS[n])
        values = {"fc": [fx, fy], "cc": [cx, cy], "alpha_c": [skew[n] / fx], "kc": LENSES[n][:count]}
        if skew == (0, 0):
            del values["alpha_c"]
        for name, number in values.items():
            label = "" if as_script else "Some Label:   "
            lines.append(
                f"{label}{name}_{side} = [ {words(number, between)} ]{';' if as_script else ' ± [ 1 ]'}"
            )
    lines.append(
        f"R = [ {words(T[:3, :3], ', ')} ];" if turn == "R" else f"om = [ {words(vector(T), between)} ];"
    )
    lines.append(f"T = [ {words(1000 * T[:3, 3], between)} ];")
    return "\n".join(lines)


@pytest.mark.parametrize("as_script", [True, False])
@pytest.mark.parametrize("turn", ["R", "om"])
def test_bouguet_pose_maps_left_points_to_the_right_camera(as_script, turn):
    read = matlab.read_bouguet((bouguet_text(as_script, turn, (0, 0)),), CameraChoice())
    assert_is_the_pair(read, sizes=False)
    skewed = matlab.read_bouguet((bouguet_text(as_script, turn),), CameraChoice())
    np.testing.assert_allclose((skewed.K_left[0, 1], skewed.K_right[0, 1]), SKEWS, rtol=1e-12)
    with pytest.raises(InputError, match="kc_left must be 5 finite numbers; got 4"):
        matlab.read_bouguet((bouguet_text(as_script, turn, count=4),), CameraChoice())
