"""What is special in each calibration format, and the door's errors."""

from __future__ import annotations

import numpy as np
import pytest

from geodiff_plugin.formats import read_calibration, rig_from_parameters

K_TEXT = "[700 0 300; 0 700 200; 0 0 1]"


def put(tmp_path, text, name="calib.txt"):
    path = tmp_path / name
    path.write_text(text)
    return path


def rotation(axis, degrees):
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    W, a = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.deg2rad(degrees)
    return np.eye(3) + np.sin(a) * W + (1 - np.cos(a)) * W @ W


def check_rig_maps_like(rig, P_left, P_right, points_world):
    """Pixels of the rig's two cameras against two 3x4 projections of world points, without shared code."""
    homogeneous = np.vstack([points_world, np.ones(points_world.shape[1])])
    uv = [P @ homogeneous for P in (P_left, P_right)]
    uv_left, uv_right = (p[:2] / p[2] for p in uv)
    z = uv[0][2]
    p_left = np.linalg.inv(rig.K_left) @ np.vstack([uv_left, np.ones_like(z)]) * z
    p_right = rig.K_right @ (np.linalg.inv(rig.E) @ np.vstack([p_left, np.ones_like(z)]))[:3]
    np.testing.assert_allclose(p_right[:2] / p_right[2], uv_right, atol=1e-6)


# ---- Middlebury


def test_convention_depth_from_disparity_and_doffs(tmp_path):
    """Z = baseline * f / (d + doffs), the data set's own formula, is what K, K_right and E give."""
    rig = read_calibration(
        put(tmp_path, f"cam0={K_TEXT}\ncam1={K_TEXT.replace('300', '340')}\ndoffs=40\nbaseline=80\n")
    )
    disparity, u = 16.0, 310.0
    z = 0.08 * 700 / (disparity + 40)
    x_right = (u - 300) / 700 * z - rig.E[0, 3]
    assert u - (rig.K_right[0, 0] * x_right / z + rig.K_right[0, 2]) == pytest.approx(disparity)


@pytest.mark.parametrize("cam1", [f"cam1={K_TEXT}\n", ""])
def test_doffs_wins_over_cam1_with_a_warning(tmp_path, cam1):
    path = put(tmp_path, f"cam0={K_TEXT}\n{cam1}doffs=31\nbaseline=80\n")
    with pytest.warns(UserWarning, match=r"calib\.txt: cam1 .* 331 px"):
        rig = read_calibration(path)
    assert rig.K_right[0, 2] == 331 and rig.K_left[0, 2] == 300


# ---- KITTI


def kitti_four():
    rows = []
    for camera, offset in ((0, 0.0), (1, -380.0), (2, 45.0), (3, -340.0)):
        y, z = (0.0, 0.0) if camera < 2 else (0.2 * camera, 0.0027 + 1e-5 * camera)
        rows.append((camera, f"721.5 0 609.6 {offset} 0 721.5 172.9 {y} 0 0 1 {z}"))
    return rows


@pytest.mark.parametrize("key", ["P{}", "P_rect_{:02d}"])
@pytest.mark.parametrize(
    ("cameras", "hint", "expected"),
    [
        ((0, 1), None, (0, 1)),
        ((2, 3), "image_0", (2, 3)),
        (None, "data/training/image_0/000000_10.png", (0, 1)),
        (None, "image_1", (0, 1)),
        (None, "image_02/data", (2, 3)),
        (None, "image_3", (2, 3)),
        (None, "colored_0", (2, 3)),
        ((3, 2), None, (3, 2)),
    ],
)
def test_kitti_cameras(tmp_path, key, cameras, hint, expected):
    rows = dict(kitti_four())
    path = put(tmp_path, "\n".join(f"{key.format(camera)}: {row}" for camera, row in rows.items()))
    rig = read_calibration(path, cameras=cameras, image_folder_hint=hint)
    P_left, P_right = (np.array(rows[camera].split(), dtype=float).reshape(3, 4) for camera in expected)
    points = np.array([[1.0, -2.0, 0.3], [0.5, 1.0, -1.0], [8.0, 20.0, 5.0]])
    # The file's frame is camera 0's; the rig's is the left camera's: the pixels must not know.
    homogeneous = np.vstack([points, np.ones(3)])
    shift = np.linalg.inv(P_left[:, :3]) @ P_left[:, 3]
    p_left = points + shift[:, None]
    uv_left = P_left @ homogeneous
    np.testing.assert_allclose(rig.K_left @ p_left, uv_left, atol=1e-9)
    p_right = np.linalg.inv(rig.E) @ np.vstack([p_left, np.ones(3)])
    np.testing.assert_allclose(rig.K_right @ p_right[:3], P_right @ homogeneous, atol=1e-8)


def test_kitti_with_both_pairs_and_no_hint_takes_colour_with_a_warning(tmp_path):
    path = put(tmp_path, "\n".join(f"P{camera}: {row}" for camera, row in kitti_four()))
    with pytest.warns(UserWarning, match="taking 2,3"):
        rig = read_calibration(path, image_folder_hint="my/photos")
    assert rig.E[0, 3] == pytest.approx(385.0 / 721.5, rel=1e-3)


def test_kitti_hint_for_a_pair_that_is_not_there_falls_back_to_the_file(tmp_path):
    path = put(tmp_path, "\n".join(f"P{camera}: {row}" for camera, row in kitti_four()[:2]))
    assert read_calibration(path, image_folder_hint="image_2").E[0, 3] == pytest.approx(380.0 / 721.5)


def test_kitti_cameras_with_three_digits_as_drivingstereo_writes_them(tmp_path):
    rows = {
        101: "1003.5 0 455.7 0 0 1003.5 197.7 0 0 0 1 0",
        103: "1003.5 0 455.7 -1093.1 0 1003.5 197.7 0 0 0 1 0",
    }
    text = "".join(f"S_rect_{c}: 8.81e+2 4.0e+2\nP_rect_{c}: {row}\n" for c, row in rows.items())
    rig = read_calibration(put(tmp_path, text))
    assert rig.E[0, 3] == pytest.approx(1093.1 / 1003.5) and rig.size_right == (881, 400)


# ---- K.txt, stereodemo


def test_stereodemo_two_principal_points_and_size(tmp_path):
    text = """{"width": 881, "height": 400, "fx": 1003, "fy": 1002,
        "cx0": 455, "cx1": 470, "cy": 197, "baseline_meters": 0.5}"""
    rig = read_calibration(put(tmp_path, text, "x.json"))
    assert (rig.K_left[0, 2], rig.K_right[0, 2], rig.K_left[1, 1]) == (455, 470, 1002)
    assert rig.size_left == rig.size_right == (881, 400)
    old = text.replace('"cx0": 455, "cx1": 470', '"cx": 455')
    assert read_calibration(put(tmp_path, old, "x.json")).K_right[0, 2] == 455


# ---- OpenCV and Booster


def storage(cv2, path, **entries):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        file.write(name, value)
    file.release()
    return path


@pytest.mark.parametrize("suffix", ["yml", "xml"])
def test_opencv_reads_what_opencv_rectified(tmp_path, suffix):
    cv2 = pytest.importorskip("cv2")
    K1 = np.array([[700.0, 0, 320], [0, 702, 240], [0, 0, 1]])
    K2 = np.array([[710.0, 0, 330], [0, 709, 236], [0, 0, 1]])
    D = np.array([[-0.2, 0.1, 0.001, 0.0, 0.0]])
    R, T = rotation((0.2, 1, 0.1), 2.0), np.array([[-0.12], [0.002], [0.004]])
    _, _, P1, P2, Q, *_ = cv2.stereoRectify(K1, D, K2, D, (640, 480), R, T, flags=0, alpha=0)
    path = storage(
        cv2,
        tmp_path / f"stereo.{suffix}",
        M1=K1,
        D1=D,
        M2=K2,
        D2=D,
        R=R,
        T=T,
        P1=P1,
        P2=P2,
        Q=Q,
        image_width=640,
        image_height=480,
        note="rectified",
        nothing=np.array([[np.nan, np.inf]]),
    )
    rig = read_calibration(path)
    np.testing.assert_allclose(rig.K_left, P1[:, :3])
    assert rig.E[0, 3] == pytest.approx(np.linalg.norm(T), rel=1e-6)
    assert rig.size_left == (640, 480)
    points = np.array([[0.1, -0.4, 0.3], [0.2, 0.1, -0.3], [2.0, 5.0, 1.0]])
    check_rig_maps_like(rig, P1, P2, points)


@pytest.mark.parametrize("suffix", ["yml", "xml"])
def test_opencv_without_projections_takes_intrinsics_and_pose(tmp_path, suffix):
    cv2 = pytest.importorskip("cv2")
    K1 = np.array([[700.0, 0, 320], [0, 702, 240], [0, 0, 1]])
    K2 = np.array([[710.0, 0, 330], [0, 709, 236], [0, 0, 1]])
    R, T = rotation((0.2, 1, 0.1), 12.0), np.array([[-0.12], [0.02], [0.04]])
    zero = np.zeros((1, 5))
    intrinsics = storage(cv2, tmp_path / f"intrinsics.{suffix}", M1=K1, D1=zero, M2=K2, D2=zero)
    extrinsics = storage(cv2, tmp_path / f"extrinsics.{suffix}", R=R, T=T)
    points = np.array([[0.1, -0.4, 0.3], [0.2, 0.1, -0.3], [2.0, 5.0, 1.0]])
    for pair in ((intrinsics, extrinsics), (extrinsics, intrinsics)):
        rig = read_calibration(pair)
        check_rig_maps_like(rig, K1 @ np.eye(3, 4), K2 @ np.hstack([R, T]), points)
    with pytest.raises(ValueError, match="no R, T.*give both"):
        read_calibration(intrinsics)


def test_opencv_vertical_rig(tmp_path):
    cv2 = pytest.importorskip("cv2")
    K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    P1, P2 = K @ np.eye(3, 4), K @ np.hstack([np.eye(3), [[0], [-0.2], [0]]])
    rig = read_calibration(storage(cv2, tmp_path / "s.yml", P1=P1, P2=P2))
    np.testing.assert_allclose(rig.E[:3, 3], (0, 0.2, 0), atol=1e-12)


STEREO = "K1 D1 K2 D2 R T"
ALIASES = (
    "cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2 R T",
    "M1 D1 M2 D2 R T",
    "K_left dist_left K_right dist_right R T",
    "K_l D_l K_r D_r R t",
    "Ml dl Mr dr R T",
    "mtxL distL mtxR distR Rot Trans",
    "cameraMatrixL distCoeffsL cameraMatrixR distCoeffsR RotationMatrix TranslationVector",
    "camera_matrix_left dist_coeffs_left camera_matrix_right dist_coeffs_right rotation_matrix translation",
    "left_camera_matrix left_distortion_coefficients right_camera_matrix right_distortion_coefficients R T",
    "Camera_Matrix_1 Distortion_Coeffs_1 Camera_Matrix_2 Distortion_Coeffs_2 rotation Translation_Vector",
)


def stereo(cv2, path, names):
    K1 = np.array([[700.0, 0, 320], [0, 702, 240], [0, 0, 1]])
    K2 = np.array([[710.0, 0, 330], [0, 709, 236], [0, 0, 1]])
    D1, D2 = np.array([[-0.2, 0.1, 0.001, 0.0, 0.0]]), np.array([[-0.1, 0.2, 0.0, 0.0, 0.0]])
    R, T = rotation((0.2, 1, 0.1), 12.0), np.array([[-0.12], [0.02], [0.04]])
    return storage(cv2, path, **dict(zip(names, (K1, D1, K2, D2, R, T), strict=True)), image_width=640)


@pytest.mark.parametrize("names", ALIASES)
@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv_by_the_names_of_tutorials(tmp_path, names, suffix):
    cv2 = pytest.importorskip("cv2")
    expected = read_calibration(stereo(cv2, tmp_path / "a.yml", STEREO.split()), distorted=True)
    assert expected.distortion[0].coefficients[0] == -0.2 and expected.distortion[1].coefficients[0] == -0.1
    rig = read_calibration(stereo(cv2, tmp_path / f"b.{suffix}", names.split()), distorted=True)
    for name in ("K_left", "K_right", "E"):
        np.testing.assert_allclose(getattr(rig, name), getattr(expected, name), atol=1e-12)
    for lens, other in zip(rig.distortion, expected.distortion, strict=True):
        np.testing.assert_array_equal(lens.coefficients, other.coefficients)


def test_projections_by_other_names_and_with_points_as_in_orb_slam(tmp_path):
    cv2 = pytest.importorskip("cv2")
    K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    P = K @ np.eye(3, 4), K @ np.hstack([np.eye(3), [[-0.2], [0], [0]]])
    sides = {"image_width": np.array([[640]]), "image_height": np.array([[480]])}
    plain = storage(cv2, tmp_path / "plain.yml", LEFT_P=P[0], RIGHT_P=P[1])
    settings = plain.read_text().replace("LEFT_P", "LEFT.P").replace("RIGHT_P", "RIGHT.P")
    settings += "Camera.k1: 0.1\nLEFT.width: 640\nLEFT.height: 480\n"
    paths = [
        storage(cv2, tmp_path / "a.yml", projMatrixL=P[0], projMatrixR=P[1], **sides),
        storage(cv2, tmp_path / "b.yml", PL=P[0], PR=P[1], k1=0.1, k2=0.2, p1=0.0, p2=0.3),
        put(tmp_path, settings, "euroc.yaml"),
    ]
    for path in paths:
        rig = read_calibration(path)
        assert rig.rectified and rig.E[0, 3] == pytest.approx(0.2) and rig.K_left[0, 0] == 700
        assert rig.size_left == (None if path.name == "b.yml" else (640, 480))


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv_arrays_of_one_axis_and_of_several_channels(tmp_path, suffix):
    """OpenCV 5 writes an array of shape (5,) as another kind of matrix; lists of points have two channels."""
    cv2 = pytest.importorskip("cv2")
    K, T = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]]), np.array([-0.12, 0.02, 0.04])
    D1, D2 = np.array([-0.25, 0.125, 0.001, 0.0, 0.0]), np.array([-0.1, 0.2, 0.0, 0.0])
    points = np.arange(8.0).reshape(4, 1, 2)
    path = tmp_path / f"s.{suffix}"
    storage(cv2, path, points=points, M1=K, D1=D1, M2=K, D2=D2, R=np.eye(3), T=T)
    rig = read_calibration(path, distorted=True)
    np.testing.assert_allclose(rig.E[:3, 3], -T, atol=1e-12)
    for lens, coefficients in zip(rig.distortion, (D1, D2), strict=True):
        np.testing.assert_array_equal(lens.coefficients, coefficients)
    path.write_text(path.read_text().replace("-0.25,", "").replace("-0.25 ", ""))
    with pytest.raises(ValueError, match=r"d1 must be .* numbers; got 4 numbers\. Is the file cut off"):
        read_calibration(path, distorted=True)


def test_booster_baseline_in_millimetres_and_own_cx(tmp_path):
    cv2 = pytest.importorskip("cv2")
    P1 = np.array([[7000.0, 0, 2000, 0], [0, 7000, 1500, 0], [0, 0, 1, 0]])
    P2 = P1 + np.array([[0, 0, 25.0, -560000], [0] * 4, [0] * 4])
    good = {"proj_matL": P1, "proj_matR": P2, "baselineLR": 80.0, "distL": np.array([[0.3, 0.1, 0, 0, 0]])}
    rig = read_calibration(storage(cv2, tmp_path / "calib_00-02.xml", **good))
    assert rig.E[0, 3] == pytest.approx(0.08) and rig.K_right[0, 2] == 2025
    del good["baselineLR"]
    with pytest.raises(ValueError, match="no 'baselinelr'"):
        read_calibration(storage(cv2, tmp_path / "calib_00-02.xml", **good))


# ---- MVSNet


def cam_text(T, K):
    rows = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in T)
    return (
        f"extrinsic\n{rows}\n\nintrinsic\n"
        + "\n".join(" ".join(f"{v:.9g}" for v in row) for row in K)
        + "\n\n1 0.1\n"
    )


def world_to_camera(axis, degrees, t):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation(axis, degrees), t
    return T


def test_mvsnet_pair_of_any_pose(tmp_path):
    K1 = np.array([[700.0, 0, 320], [0, 702, 240], [0, 0, 1]])
    K2 = np.array([[500.0, 0, 330], [0, 509, 236], [0, 0, 1]])
    T1, T2 = world_to_camera((1, 2, 3), 40, (0.3, -0.2, 1)), world_to_camera((1, 2, 2), 55, (0.1, -0.1, 1.2))
    pair = (put(tmp_path, cam_text(T1, K1), "a.txt"), put(tmp_path, cam_text(T2, K2), "b.txt"))
    rig = read_calibration(pair)
    points = np.array([[0.1, -0.4, 0.3], [0.2, 0.1, -0.3], [3.0, 5.0, 2.0]])
    check_rig_maps_like(rig, K1 @ T1[:3], K2 @ T2[:3], points)
    back = read_calibration(pair[::-1])
    np.testing.assert_allclose(back.E @ rig.E, np.eye(4), atol=1e-8)


def test_mvsnet_rotations_rigid_to_print_precision_become_rotations(tmp_path):
    K = np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]])
    T = world_to_camera((1, 2, 3), 40, (0.3, -0.2, 1))
    sheared = T.copy()
    sheared[:3, :3] += 4e-4 * np.array([[1, -1, 1], [0, 1, -1], [1, 0, -1]])
    rig = read_calibration(
        (put(tmp_path, cam_text(np.eye(4), K), "a.txt"), put(tmp_path, cam_text(sheared, K), "b.txt"))
    )
    R = rig.E[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(rig.E, np.linalg.inv(T), atol=2e-3)


# ---- the door


# ---- parameters and matrix files


def test_rig_from_parameters():
    rig = rig_from_parameters(700, 701, 320, 240, 0.12, size=(640, 480))
    np.testing.assert_array_equal(rig.K_left, [[700, 0, 320], [0, 701, 240], [0, 0, 1]])
    np.testing.assert_array_equal(rig.K_right, rig.K_left)
    assert rig.E[0, 3] == 0.12 and rig.size_right == (640, 480)
    assert rig_from_parameters(700, 701, 320, 240, 0.12, cx_right=350).K_right[0, 2] == 350


def test_opencv_json_is_read_as_its_yaml(tmp_path):
    """What its FileStorage writes by the suffix; older versions write 1. where JSON wants 1.0."""
    cv2 = pytest.importorskip("cv2")
    P = {name: np.diag([500.5, 500.5, 1.0]) @ np.eye(3, 4) for name in ("P1", "P2")}
    P["P2"][0, 3] = -60.06
    for suffix in ("json", "yml"):
        storage(cv2, tmp_path / f"x.{suffix}", **P, image_width=640, image_height=480)
    old = tmp_path / "old.json"
    old.write_text((tmp_path / "x.json").read_text().replace("0.0,", "0.,"))
    rigs = [read_calibration(path) for path in (tmp_path / "x.json", tmp_path / "x.yml", old)]
    for rig in rigs:
        assert rig.size_left == (640, 480) and rig.E[0, 3] == pytest.approx(0.12)
        np.testing.assert_array_equal(rig.K_left, rigs[0].K_left)
    for broken in ('{"a": {"type_id": "opencv-matrix"}}', '{"opencv-matrix": ', '["opencv-matrix"]'):
        old.write_text(broken)
        with pytest.raises(ValueError, match="must be"):
            read_calibration(old)
