"""Settings of SLAM programs: images as taken, or rectified ones."""

import json

import cv2
import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import slam
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.calibrated_pair import (
    K_LEFT,
    K_RIGHT,
    KS,
    LENS_LEFT,
    LENS_RIGHT,
    LENSES,
    SIZE_LEFT,
    SIZE_RIGHT,
    UNCHOSEN,
    E,
    T,
    assert_is_parallel,
    assert_is_the_pair,
    numbers,
    words,
)
from tests.views import lenses_of


def read(reader, content, choice=UNCHOSEN):
    return reader((json.dumps(content),), choice)


STELLA = dict(zip(("fx", "fy", "cx", "cy"), numbers(K_LEFT), strict=True))
STELLA |= {"setup": "stereo", "model": "perspective", "cols": 820, "rows": 616}
STELLA["focal_x_baseline"] = 0.173 * 811.5


def test_stella_rectified_settings_keep_the_original_cameras():
    rig = read(slam.read_stella, {"Camera": STELLA})
    assert_is_parallel(rig, sizes=(SIZE_LEFT, SIZE_LEFT))
    assert rig.as_taken is None
    R1, R2, *_ = cv2.stereoRectify(
        K_LEFT, np.zeros(5), K_RIGHT, np.zeros(5), SIZE_LEFT, T[:3, :3], T[:3, 3:], flags=0
    )
    length = float(np.linalg.norm(T[:3, 3]))
    camera = STELLA | {"focal_x_baseline": length * 811.5}
    made = {"R_left": R1.ravel().tolist(), "R_right": R2.ravel().tolist()}
    for n, side in enumerate(("left", "right")):
        made |= {f"K_{side}": KS[n].ravel().tolist(), f"D_{side}": LENSES[n][:5]}
    taken = read(slam.read_stella, {"Camera": camera, "StereoRectifier": made}).as_taken
    assert taken.size_left == taken.size_right == SIZE_LEFT
    np.testing.assert_allclose(taken.E, E, atol=1e-9)
    for got, expected in ((taken.K_left, K_LEFT), (taken.K_right, K_RIGHT)):
        np.testing.assert_array_equal(got, expected)
    assert [each.coefficients.tolist() for each in lenses_of(taken)] == [LENS_LEFT[:5], LENS_RIGHT[:5]]
    fisheye = made | {"model": "fisheye", "D_left": LENS_LEFT[:4], "D_right": LENS_RIGHT[:4]}
    taken = read(slam.read_stella, {"Camera": camera, "StereoRectifier": fisheye}).as_taken
    assert [each.model for each in lenses_of(taken)] == ["fisheye", "fisheye"]


@pytest.mark.parametrize(
    ("changes", "got"),
    [
        ({"model": "equirectangular"}, "setup stereo and model equirectangular"),
        ({"focal_x_baseline": None, "setup": "monocular"}, "setup monocular and model perspective"),
    ],
)
def test_stella_settings_without_a_stereo_pair_are_rejected(changes, got):
    camera = {key: value for key, value in (STELLA | changes).items() if value is not None}
    sentence = (
        r"\Athe settings must be settings of a stereo camera \(setup stereo, model perspective, "
        r"focal_x_baseline\); "
    )
    with pytest.raises(
        InputError, match=rf"{sentence}got {got}\. Pass stella_vslam's settings for stereo\.\Z"
    ):
        read(slam.read_stella, {"Camera": camera})


def test_stvo_settings_have_two_cameras_or_one_rectified():
    size = {"cam_width": 820, "cam_height": 616}
    both = {"Kl": numbers(K_LEFT), "Kr": numbers(K_RIGHT), "Dl": LENS_LEFT[:5], "Dr": LENS_RIGHT[:5]}
    both |= {"R": T[:3, :3].ravel().tolist(), "t": T[:3, 3].tolist(), "cam_bl": 9.0} | size
    rig = read(slam.read_stvo, {"cam0": both})
    assert rig.size_left == rig.size_right == SIZE_LEFT
    assert_is_the_pair(rig.sized(SIZE_LEFT, SIZE_RIGHT))
    one = {f"cam_{key}": STELLA[key] for key in ("fx", "fy", "cx", "cy")} | size | {"cam_bl": 0.173}
    assert_is_parallel(read(slam.read_stvo, {"cam0": one}), sizes=(SIZE_LEFT, SIZE_LEFT))
    bent = read(
        slam.read_stvo, {"cam0": one | {"cam_d0": 0.3, "cam_d1": -0.1, "cam_d2": 0.02, "cam_d3": 0.01}}
    )
    assert [each.coefficients.tolist() for each in lenses_of(bent)] == [[0.3, -0.1, 0.02, 0.01]] * 2
    assert not bent.rectified


def orb(text: str):
    return slam.read_orb_slam((text,), CameraChoice())


@pytest.mark.parametrize(
    ("kind", "keys", "model"),
    [("PinHole", "k1 k2 p1 p2 k3", "opencv"), ("KannalaBrandt8", "k1 k2 k3 k4", "fisheye")],
)
@pytest.mark.parametrize("version", [1, 0])
def test_orb_slam_settings_contain_both_cameras_and_their_pose(kind, keys, model, version):
    left, name = ("Camera1", "Stereo.T_c1_c2") if version else ("Camera", "Tlr")
    lines = [f'Camera.type: "{kind}"', f"Camera.width: {SIZE_LEFT[0]}", f"Camera.height: {SIZE_LEFT[1]}"]
    for n, camera in enumerate((left, "Camera2")):
        of_camera = [*numbers(KS[n]), *LENSES[n][: len(keys.split())]]
        pairs = zip(("fx fy cx cy " + keys).split(), of_camera, strict=True)
        lines += [f"{camera}.{key}: {value!r}" for key, value in pairs]
    lines.append(f"{name}: {{rows: 4, cols: 4, data: [{words(E, ', ')}]}}")
    rig = orb("\n".join(lines))
    assert rig.size_left == rig.size_right == SIZE_LEFT
    without_sizes = orb("\n".join(line for line in lines if "width" not in line and "height" not in line))
    assert_is_the_pair(without_sizes, lens=len(keys.split()), model=model, sizes=False)
    bare = [line for line in lines if ".k2" not in line and ".p1" not in line]
    if kind == "PinHole":
        expected = [LENS_RIGHT[0], 0, 0, *LENS_RIGHT[3:5]]
        assert orb("\n".join(bare)).right.lens.coefficients.tolist() == expected
    else:
        with pytest.raises(InputError, match=f"{left}.k2 must be a finite number"):
            orb("\n".join(bare))
    with pytest.raises(InputError, match=f"{left}.fy must be a finite number; got None"):
        orb("\n".join(line for line in lines if f"{left}.fy" not in line))


def rectified_orb(camera: str, kind: str | None, baseline: str, **more) -> str:
    values = dict(zip(("fx", "fy", "cx", "cy"), numbers(K_LEFT), strict=True)) | more
    lines = [f"{camera}.{key}: {value!r}" for key, value in values.items()]
    lines += [f'Camera.type: "{kind}"'] if kind else []
    return "\n".join([*lines, baseline, "Camera.width: 820", "Camera.height: 616"])


RECTIFIED_ORB = [
    ("Camera1", "Rectified", "Stereo.b: 0.173"),
    ("Camera", "PinHole", f"Camera.bf: {0.173 * 811.5}"),
    ("Camera", "Rectified", f"Camera.bf: {0.173 * 811.5}"),
    ("Camera", None, f"Camera.bf: {0.173 * 811.5}"),
]


@pytest.mark.parametrize(("camera", "kind", "baseline"), RECTIFIED_ORB)
def test_rectified_orb_slam_settings_have_one_camera_and_a_baseline(camera, kind, baseline):
    assert_is_parallel(orb(rectified_orb(camera, kind, baseline)), sizes=(SIZE_LEFT, SIZE_LEFT))
    with pytest.raises(
        InputError,
        match=rf"\ALens distortion of {camera} must be zero for rectified images \(no "
        r"Stereo\.T_c1_c2\); got other values\. The file may be of a single camera\.\Z",
    ):
        orb(rectified_orb(camera, kind, baseline, k3=0.1))


@pytest.mark.parametrize(
    ("text", "got"),
    [
        (rectified_orb("Camera1", "PinHole", "Stereo.b: 0.173"), "PinHole without them"),
        (rectified_orb("Camera1", "Rectified", "Camera.bf: 84.0"), "Rectified without them"),
        (rectified_orb("Camera", "KannalaBrandt8", "Camera.bf: 84.0"), "KannalaBrandt8 without them"),
        (rectified_orb("Camera", None, "a: 1"), "PinHole without them"),
        (
            rectified_orb("Camera1", "Rectified", "Stereo.b: 0.173\nRGBD.DepthMapFactor: 5000.0"),
            "Rectified with a depth sensor",
        ),
        (
            rectified_orb("Camera", "PinHole", "Camera.bf: 40.0\nDepthMapFactor: 5000.0"),
            "PinHole with a depth sensor",
        ),
    ],
)
def test_orb_slam_settings_without_a_stereo_pair_are_rejected(text, got):
    baseline = "Stereo.b" if "Camera1" in text else "Camera.bf"
    sentence = rf"\Athe settings must be settings of a stereo camera, with Stereo\.T_c1_c2, or {baseline} of "
    sentence += rf"rectified images; got a camera of type {got}\. Pass ORB-SLAM's settings for stereo\.\Z"
    with pytest.raises(InputError, match=sentence):
        orb(text)
