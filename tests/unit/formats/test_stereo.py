"""Stereo data set calibrations: row, camera and unit."""

import json

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError, captured_warnings
from geodiff_plugin.formats import stereo
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.calibrated_pair import (
    BODY_LEFT,
    K_LEFT,
    K_RIGHT,
    SIZE_LEFT,
    UNCHOSEN,
    E,
    assert_is_parallel,
    numbers,
    pose,
    words,
)

BASELINE = 0.173
SHIFT = pose((0, 0, 0), (BASELINE, 0, 0))
BOTH = (SIZE_LEFT, SIZE_LEFT)


def refused(words_: str):
    return pytest.raises(InputError, match=rf"(?s)\A{words_}\Z")


def rows(K, end: str = "; ") -> str:
    return end.join(words(row) for row in K)


def middlebury(doffs=None, cam1=True, baseline="173.0", size=True, choice=UNCHOSEN):
    text = f"cam0=[{rows(K_LEFT)}]\n"
    text += f"cam1=[{rows(K_RIGHT)}]\n" if cam1 else ""
    text += f"doffs={float(doffs)!r}\n" if doffs is not None else ""
    text += f"baseline={baseline}\n" + ("width=820\nheight=616\n" if size else "")
    return stereo.read_middlebury((text,), choice)


@pytest.mark.parametrize("off", [0.0, 0.04, -0.04, 0.06, -0.06, 12.0])
def test_doffs_overrides_the_right_matrix_beyond_rounding(off):
    doffs = K_RIGHT[0, 2] - K_LEFT[0, 2] + off
    with captured_warnings() as reported, pytest.warns() if abs(off) > 0.05 else captured_warnings():
        rig = middlebury(doffs)
    expected = K_RIGHT.copy()
    if abs(off) > 0.05:
        expected[0, 2] += off
        assert [each.code for each in reported] == ["calibration.doffs"]
        cx = f"{expected[0, 2]:g}"
        assert reported[0] == f"cam1 has cx = 511.5; using cx0 + doffs = {cx} px for the right image."
    assert bool(reported) == (abs(off) > 0.05)
    assert_is_parallel(rig, K_LEFT, expected, sizes=BOTH)


def test_doffs_or_the_right_matrix_may_be_omitted():
    assert_is_parallel(middlebury(size=False), K_LEFT, K_RIGHT)
    with pytest.warns(UserWarning, match=r"\Acam1 is missing; using cx0 \+ doffs = 423\.5 px for the right"):
        rig = middlebury(21.25, cam1=False)
    assert_is_parallel(rig, K_LEFT, K_LEFT + [[0, 0, 21.25], [0, 0, 0], [0, 0, 0]], sizes=BOTH)
    with pytest.raises(KeyError):
        middlebury(cam1=False)


@pytest.mark.parametrize(("baseline", "is_refused"), [("0.999", True), ("1.0", False), ("1.001", False)])
def test_middlebury_baselines_below_one_millimetre_are_rejected(baseline, is_refused):
    if not is_refused:
        assert middlebury(baseline=baseline).E[0, 3] == float(baseline) / 1000
        return
    with refused(
        r"baseline must be at least 1 mm.*; got 0\.999\. If it is in millimetres, confirm it with "
        r"--baseline 0\.000999; if it is in metres, pass --baseline "
        r"0\.999 \(baseline_m, in metres\)\."
    ):
        middlebury(baseline=baseline)
    assert middlebury(baseline=baseline, choice=CameraChoice(baseline_m=0.3)).E[0, 3] == pytest.approx(
        9.99e-4
    )


def test_foundation_stereo_files_end_with_the_baseline():
    for between in (" ", ", ", "\n"):
        rig = stereo.read_foundation_stereo((f"{words(K_LEFT, between)}\n{BASELINE}\n",), CameraChoice())
        assert_is_parallel(rig, rectified=False)
    for count, got in ((8, "fx fy cx cy k1 k2 p1 p2 of one camera"), (9, "9 numbers"), (11, "11 numbers")):
        with pytest.raises(
            InputError, match=rf"\Athe file must be 9 numbers of K and the baseline.*; got {got}\. "
        ):
            stereo.read_foundation_stereo((words(range(count)),), CameraChoice())


@pytest.mark.parametrize("name", ["baseline_meters", "baseline_m", "baseline", "bl"])
@pytest.mark.parametrize("form", ["json", "{}: {}", " {}={}  # px"])
def test_stereodemo_values_are_read_by_name(name, form):
    fx, fy, cx, cy = numbers(K_LEFT)
    values = {"fx": fx, "fy": fy, "cx0": cx, "cx1": cx + 21.25, "cy": cy, "width": 820, "height": 616}
    K_right = K_LEFT + [[0, 0, 21.25], [0, 0, 0], [0, 0, 0]]

    def read(values, choice=UNCHOSEN):
        lines = "\n".join(form.format(*item) for item in values.items())
        return stereo.read_stereodemo((json.dumps(values) if form == "json" else lines,), choice)

    both = (SIZE_LEFT, SIZE_LEFT)
    assert_is_parallel(read(values | {name: BASELINE}), K_LEFT, K_right, sizes=both, rectified=False)
    one = values | {"cx": cx + 1.5, name: BASELINE}
    K = K_LEFT + [[0, 0, 1.5], [0, 0, 0], [0, 0, 0]]
    assert_is_parallel(read(one), K, sizes=both, rectified=False)
    assert_is_parallel(read(one, CameraChoice(baseline_m=0.9)), K, sizes=both, rectified=False)
    given = read(values, CameraChoice(baseline_m=BASELINE))
    assert_is_parallel(given, K_LEFT, K_right, sizes=both, rectified=False)
    with refused(
        r"the file must be one with baseline_meters or baseline_m or baseline or bl; got none\. For .*"
    ):
        read(values)


def test_cityscapes_has_one_camera_and_a_baseline():
    intrinsic = dict(zip(("fx", "fy", "u0", "v0"), numbers(K_LEFT), strict=True))
    data = {"intrinsic": intrinsic, "extrinsic": {"baseline": BASELINE, "x": 1.7}}
    assert_is_parallel(stereo.read_cityscapes((json.dumps(data),), CameraChoice()))


SPRING = "".join(f"{1000 + n} {1100 + n} {900 + n} {500 + n}\n" for n in range(4))


def spring(text: str, name: str | None, baseline_m=None):
    names = None if name is None else (name, "right.png")
    return stereo.read_spring((text,), CameraChoice(image_names=names, baseline_m=baseline_m))


@pytest.mark.parametrize(
    ("name", "row"),
    [("x/frame_left/frame_left_0001.png", 0), ("frame_left_0003.png", 2), ("0002/frame_left_0004.png", 3)],
)
def test_spring_line_is_selected_by_image_number(name, row):
    K = np.array([[1000.0 + row, 0, 900 + row], [0, 1100 + row, 500 + row], [0, 0, 1]])
    assert_is_parallel(spring(SPRING, name), K, baseline=0.065)


def test_images_from_other_sets_than_spring_need_a_baseline():
    with refused(
        r"the left image must be named with a number from 1 to 4; got \('frame_left_0005\.png', 'right\.png"
        r"'\)\. Spring's images are named frame_left_0001\.png etc\."
    ):
        spring(SPRING, "frame_left_0005.png")
    with pytest.raises(InputError, match=r"\Athe left image must be named"):
        spring(SPRING, "frame_left_0000.png")
    same = SPRING.splitlines()[1] + "\n"
    K = np.array([[1001.0, 0, 901], [0, 1101, 501], [0, 0, 1]])
    for text, name in ((2 * same, "frame_left_0009.png"), (same, None), (same, "frame_left.png")):
        assert_is_parallel(spring(text, name, 0.3), K, baseline=0.065)
    sentence = r"the file must be a file of Spring, with images named frame_left_0001\.png etc\.; got fx "
    sentence += r"fy cx cy of one camera and {}\. For parallel cameras, pass --fx 1001 --fy 1101 --cx 901 "
    sentence += r"--cy 501 --baseline METRES\."
    for name, reported in (("0001.png", r"0001\.png"), (None, "no image")):
        with refused(sentence.format(reported)):
            spring(same, name)


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_a_pose_matrix_is_not_mistaken_for_a_spring_file(count):
    turned = np.vstack([E, E[3:]])[:count]
    if count in (2, 5):
        with pytest.raises(InputError, match="of Spring"):
            spring(words(turned), "a.png")
        return
    with refused(
        r"the file must be a calibration; got a pose\. If .* left camera's frame, pass it with --E, "
        r"and K with --K\."
    ):
        spring(words(turned), "a.png", 0.1)
    off = turned.copy()
    off[0, 0] += 0.01
    with pytest.raises(InputError, match="positive focal lengths"):  # read as intrinsics, which they are not
        spring(words(off), None, 0.1)


def argoverse(extra=(), without=()):
    keys = ("focal_length_x_px_", "focal_length_y_px_", "focal_center_x_px_", "focal_center_y_px_")
    entries = []
    places = BODY_LEFT[:3, 3], (BODY_LEFT @ SHIFT)[:3, 3]
    for side, K, place in zip(("left", "right"), (K_LEFT, K_RIGHT), places, strict=True):
        name, values = f"image_raw_stereo_front_{side}", dict(zip(keys, numbers(K), strict=True))
        entries.append((name, {"vehicle_SE3_camera_": {"translation": place.tolist()}}))
        entries.append((f"{name}_rect", values | {"vehicle_SE3_camera_": {"translation": [0, 0, 0]}}))
    cameras = [{"key": key, "value": value} for key, value in entries if key not in without]
    return stereo.read_argoverse((json.dumps({"camera_data_": cameras + list(extra)}),), CameraChoice())


def test_argoverse_baseline_comes_from_the_unrectified_cameras():
    assert_is_parallel(argoverse(), K_LEFT, K_RIGHT)
    for side in ("left", "right"):
        with refused(
            r"the file must be a file of the rectified stereo pair; got image_raw.*\. Pass vehicle_cal.*"
        ):
            argoverse(without=(f"image_raw_stereo_front_{side}_rect",))


def sceneflow(name: str | None, lines="\n"):
    blender = np.diag([1.0, -1, -1, 1])
    text = ""
    for n in (5, 12, 7):
        left = pose((10 * n, -20, 30), (n, 2, 3))
        text += f"Frame {n}{lines}L {words(left @ blender)}{lines}R {words(left @ E @ blender)}{lines}{lines}"
    names = None if name is None else (name, "right.png")
    return stereo.read_sceneflow((text,), CameraChoice(image_names=names))


@pytest.mark.parametrize(("folder", "focal"), [("15mm_focallength/x", 450.0), ("35mm_focallength/y", 1050.0)])
@pytest.mark.parametrize("between", ["/", "\\"])
def test_sceneflow_poses_use_blender_axes(folder, focal, between):
    rig = sceneflow(f"{folder}/0099/0012.png".replace("/", between))
    np.testing.assert_allclose(rig.E, E, atol=1e-9)
    K = [[focal, 0, 479.5], [0, focal, 269.5], [0, 0, 1]]
    np.testing.assert_array_equal(rig.K_left, K)
    np.testing.assert_array_equal(rig.K_right, K)
    assert rig.size_left == rig.size_right == (960, 540) and not rig.rectified
    for name, got in ((f"{folder}/0013.png", f"{folder}/0013.png"), (None, "no name"), ("a.png", "a.png")):
        with refused(
            rf"the left image must be named with a frame number from 5 to 12, such as 0006\.png; got {got}\."
        ):
            sceneflow(name)


def test_sceneflow_assumes_the_longer_lens_with_a_warning():
    with captured_warnings() as reported, pytest.warns(UserWarning, match="35 mm lens"):
        assert sceneflow("left/0007.png").K_left[0, 0] == 1050
    assert [each.code for each in reported] == ["calibration.assumed-lens"]


def projection(K, place) -> np.ndarray:
    return K @ np.column_stack([np.eye(3), -np.array(place)])


#: Four KITTI cameras with different intrinsics and centres.
KITTI = {
    n: (K_LEFT * [[1 + 0.01 * n], [1 + 0.02 * n], [1]], (0.1 * n * n, 0.002 * n, -0.003 * n))
    for n in range(4)
}


def kitti(numbers_=(0, 1, 2, 3), key="P{}", sizes=False, **choice):
    text = "calib_time: 09-Jan-2012\n"
    for n in numbers_:
        text += f"{key.format(n)}: {words(projection(*KITTI[n]))}\n"
        text += f"S_rect_{n:02d}: {1000 + n}.0 {500 + n}.0\n" if sizes else ""
    with captured_warnings() as reported:
        rig = stereo.read_kitti((text,), CameraChoice(**choice))
    return rig, reported, text


@pytest.mark.parametrize(
    ("available", "choice", "pair", "warns"),
    [
        ((0, 1, 2, 3), {"cameras": (0, 1)}, (0, 1), False),
        ((0, 1, 2, 3), {"cameras": (3, 1)}, (3, 1), False),
        ((0, 1, 2, 3), {"image_folder_hint": "a/image_0"}, (0, 1), False),
        ((0, 1, 2, 3), {"image_folder_hint": "a/image_01/data"}, (0, 1), False),
        ((0, 1, 2, 3), {"image_folder_hint": "a/image_2/x"}, (2, 3), False),
        ((0, 1, 2, 3), {"image_folder_hint": "image_3"}, (2, 3), False),
        ((0, 1, 2, 3), {"image_folder_hint": "colored_0"}, (2, 3), False),
        ((0, 1, 2, 3), {"image_folder_hint": "image_2/image_0/data"}, (0, 1), False),
        ((0, 1, 2, 3), {"image_folder_hint": "image_20"}, (2, 3), True),
        ((0, 1, 2, 3), {}, (2, 3), True),
        ((0, 1), {"image_folder_hint": "image_2"}, (0, 1), False),
        ((2, 3), {}, (2, 3), False),
        ((3, 1, 0), {}, (0, 1), False),
        ((1, 2), {}, (1, 2), False),
        ((0, 1, 2, 3), {"cameras": (1, 0), "image_folder_hint": "image_2"}, (1, 0), False),
    ],
)
@pytest.mark.parametrize("key", ["P{}", "P_rect_{:02d}"])
def test_kitti_cameras_follow_the_choice_then_the_folder_name(available, choice, pair, warns, key):
    if warns:
        with pytest.warns(UserWarning, match="2,3 is used"):
            rig, reported, _ = kitti(available, key, **choice)
        assert [each.code for each in reported] == ["calibration.kitti-cameras"]
    else:
        rig, reported, _ = kitti(available, key, **choice)
        assert not reported
    (K_l, place_l), (K_r, place_r) = (KITTI[n] for n in pair)
    np.testing.assert_allclose(rig.K_left, K_l, rtol=1e-12)
    np.testing.assert_allclose(rig.K_right, K_r, rtol=1e-12)
    np.testing.assert_allclose(rig.E[:3, 3], np.subtract(place_r, place_l), atol=1e-9)
    assert rig.rectified and rig.size_left is None


def test_kitti_sizes_belong_to_their_own_camera():
    rig, *_ = kitti(key="P_rect_{:02d}", sizes=True, cameras=(1, 2))
    assert (rig.size_left, rig.size_right) == ((1001, 501), (1002, 502))
    for key in ("P{}", "P_rect_{:02d}"):
        text = kitti(key=key, cameras=(0, 1))[2]
        P = stereo.left_projection_of_kitti(text, CameraChoice((3, 1)))
        np.testing.assert_allclose(P, projection(*KITTI[3]), rtol=1e-12)
    with refused(r"calibration must be KITTI's \(P_rect_02, or P0 to P3\); got a different format\."):
        stereo.left_projection_of_kitti("fx: 1\nPx: 3\n", CameraChoice())


def vkitti(name: str | None, place=SHIFT, frames=(2, 11, 7), swap=False, turn=None):
    K, T = "frame cameraID K\n", "frame cameraID T\n"
    for frame in frames:
        left = pose((frame, -20, 30), (frame, 2, 3)) if turn is None else turn
        for n, (body, matrix) in enumerate(((left, K_LEFT), (left @ place, K_RIGHT))):
            K += f"{frame} {n} {words(np.array(numbers(matrix)) + frame)}\n"
            T += f"{frame} {n} {words(np.linalg.inv(body))}\n"
    texts = (T + "\n", K) if swap else (K, T + "\n")
    names = None if name is None else (name, "right.jpg")
    return stereo.read_vkitti(texts, CameraChoice(image_names=names))


@pytest.mark.parametrize("swap", [False, True])
def test_virtual_kitti_poses_are_world_to_camera(swap):
    rig = vkitti("Camera_0\\rgb_00011.jpg", swap=swap)
    more = np.array([[11.0, 0, 11], [0, 11, 11], [0, 0, 0]])
    assert_is_parallel(rig, K_LEFT + more, K_RIGHT + more)
    for name, got in (("rgb_00003.jpg", r"rgb_00003\.jpg"), (None, "no name"), ("2/rgb.jpg", r"2/rgb\.jpg")):
        with refused(
            rf"the left image must be named with a frame number from 2 to 11, such as "
            rf"rgb_00006\.jpg; got {got}\."
        ):
            vkitti(name, swap=swap)


@pytest.mark.parametrize(
    ("place", "fits"),
    [
        (pose((0, 0, 0.03), (0.3, 0, 0)), True),
        (pose((0, 0, 0.1), (0.3, 0, 0)), False),
        (pose((0, 0, 0), (-0.3, 0, 0)), False),
        (pose((0, 0, 0), (0.3, 0.1, 0.05)), True),
        (pose((0, 0, 0), (0.3, 0.1, 0.12)), False),
    ],
)
def test_virtual_kitti_poses_must_describe_a_rectified_pair(place, fits):
    if fits:
        np.testing.assert_allclose(vkitti("rgb_2.jpg", place).E, place, atol=1e-9)
        return
    with pytest.raises(
        InputError, match=r"\Aextrinsic\.txt must be world-to-camera poses of a rectified pair; got"
    ):
        vkitti("rgb_2.jpg", place)


def test_booster_lengths_are_millimetres():
    def matrix(name, P):
        return f"<{name}><rows>3</rows><cols>4</cols><data>{words(P)}</data></{name}>"

    P_left, P_right = projection(K_LEFT, (9, 9, 9)), projection(K_RIGHT, (1, 2, 3))
    text = f"<opencv_storage>{matrix('proj_matL', P_left)}{matrix('proj_matR', P_right)}"
    text += "<baselineLR>173.0</baselineLR></opencv_storage>"
    assert_is_parallel(stereo.read_booster((text,), CameraChoice()), K_LEFT, K_RIGHT)
