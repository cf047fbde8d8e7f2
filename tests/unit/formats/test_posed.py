"""Calibrations with a pose per camera; mostly the pair is neither first nor in order."""

import json

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import CALIBRATION_FORMATS as FORMATS
from geodiff_plugin.formats import posed
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.calibrated_pair import (
    BODIES,
    BODY_LEFT,
    BODY_RIGHT,
    K_LEFT,
    K_RIGHT,
    KS,
    LENS_LEFT,
    LENS_RIGHT,
    LENSES,
    SIZE_LEFT,
    SIZE_RIGHT,
    SIZES,
    UNCHOSEN,
    E,
    T,
    assert_is_the_pair,
    numbers,
    pose,
    quaternion,
    vector,
    words,
)

#: K, size, lens and world-to-camera pose of the right, another and the left camera.
OTHER = pose((50, 60, 70), (3, 2, 1))
THREE = [
    (K_RIGHT, SIZE_RIGHT, LENS_RIGHT, np.linalg.inv(BODY_RIGHT)),
    (np.diag([500.0, 600, 1]), (64, 48), LENS_LEFT, OTHER),
    (K_LEFT, SIZE_LEFT, LENS_LEFT, np.linalg.inv(BODY_LEFT)),
]
CHOSEN = CameraChoice((2, 0))


def anipose(entries, forms=("", "vector"), count=5, fisheye=False) -> str:
    above, form = forms
    text = "[metadata]\nerror = 0.5\n"
    for n, (K, size, lens, world) in enumerate(entries):
        turn = vector(world) if form == "vector" else world[:3, :3].tolist()
        text += (
            f"[{above}cam_{n}]\nsize = {list(size)}\nmatrix = {K.tolist()}\ndistortions = {lens[:count]}\n"
        )
        text += f"rotation = {turn}\ntranslation = {world[:3, 3].tolist()}\n"
        text += f'name = "view {n}"\n' if n else ""
        text += f"fisheye = {'true' if fisheye else 'false'}\n" if n != 1 else ""
    return text


@pytest.mark.parametrize("above", ["", "cameras."])
@pytest.mark.parametrize("form", ["vector", "matrix"])
def test_anipose_poses_are_world_to_camera(above, form):
    rig = FORMATS["anipose"].read((anipose(THREE, (above, form)),), CHOSEN)
    assert_is_the_pair(rig)
    two = anipose([THREE[2], THREE[0]], (above, form))
    assert_is_the_pair(FORMATS["anipose"].read((two,), CameraChoice()))
    fisheye = anipose(THREE, (above, form), 4, True)
    assert_is_the_pair(FORMATS["anipose"].read((fisheye,), CHOSEN), lens=4, model="fisheye")
    with pytest.raises(
        InputError,
        match=r"\Acameras must be specified, two of 0 \(cam_0\), 1 \(view 1\), 2 \(view 2\); "
        r"got none\. Pass --cameras LEFT,RIGHT\.\Z",
    ):
        FORMATS["anipose"].read((anipose(THREE, (above, form)),), CameraChoice())
    with pytest.raises(
        InputError, match=r"cameras must be two different cameras of the file \(0, 1, 2\); got 2,3"
    ):
        FORMATS["anipose"].read((anipose(THREE, (above, form)),), CameraChoice((2, 3)))
    without_size = anipose(THREE).replace("size =", "sizes =")
    assert FORMATS["anipose"].read((without_size,), CHOSEN).size_left is None


@pytest.mark.parametrize(
    ("kind", "model", "count"), [(0, "opencv", 5), (1, "fisheye", 4), (None, "opencv", 5)]
)
def test_mc_calib_poses_are_camera_to_reference(kind, model, count):
    content = {"nb_camera": 3}
    for n, (K, size, lens, world) in enumerate(THREE):
        entries = {"camera_matrix": {"data": K.ravel().tolist()}, "img_width": size[0], "img_height": size[1]}
        entries |= {"distortion_vector": {"data": lens[:count]}, "distortion_type": kind}
        entries["camera_pose_matrix"] = {"data": np.linalg.inv(world).ravel().tolist()}
        content[f"camera_{n}"] = {key: value for key, value in entries.items() if value is not None}
    rig = FORMATS["mc_calib"].read((json.dumps(content),), CHOSEN)
    assert_is_the_pair(rig, lens=count, model=model)
    with pytest.raises(InputError, match=r"two of 0 \(camera_0\), 1 \(camera_1\), 2 \(camera_2\); got none"):
        FORMATS["mc_calib"].read((json.dumps(content),), CameraChoice())
    content["camera_2"]["distortion_type"] = 2
    with pytest.raises(InputError, match=r"\Adistortion_type must be one of 0, 1; got 2\.\Z"):
        FORMATS["mc_calib"].read((json.dumps(content),), CHOSEN)


def multical(poses) -> str:
    cameras = {
        name: {"K": K.tolist(), "image_size": size, "dist": [lens[:5]]}
        for name, (K, size, lens, _) in zip(("right", "other", "left"), THREE, strict=True)
    }
    entries = {name: {"R": T[:3, :3].tolist(), "T": T[:3, 3:].tolist()} for name, T in poses.items()}
    return json.dumps({"cameras": cameras, "camera_poses": entries})


def test_multical_poses_are_absolute_or_relative():
    right, other, left = (entry[3] for entry in THREE)
    worlds = {"right": right, "other": other, "left": left}
    # A_to_B maps points from B's frame to A's frame.
    beside = {"left_to_other": left @ np.linalg.inv(other), "other": other}
    chain = beside | {"right_to_left": right @ np.linalg.inv(left)}
    for poses in (worlds, chain, {"right": right, "left_to_right": E}):
        rig = FORMATS["multical"].read((multical(poses),), CHOSEN)
        assert_is_the_pair(rig)
    sentence = r"\Acamera_poses must be with a pose of left; got {}\. Calibrate again\.\Z"
    for poses, got in (
        ({"right": right}, "right"),
        ({}, "none"),
        ({"left_to_other": E, "right": right}, "left_to_other, right"),
        ({"left_to_other": E, "other_to_left": E}, "left_to_other, other_to_left"),
    ):
        with pytest.raises(InputError, match=sentence.format(got)):
            FORMATS["multical"].read((multical(poses),), CHOSEN)
    with pytest.raises(InputError, match=r"two of 0 \(right\), 1 \(other\), 2 \(left\); got none"):
        FORMATS["multical"].read((multical(worlds),), CameraChoice())


@pytest.mark.parametrize("key", ["rt_cam_ref", "extrinsics"])
@pytest.mark.parametrize("count", [0, 4, 5, 8])
def test_mrcal_poses_are_world_to_camera(key, count):
    kind = f"LENSMODEL_OPENCV{count}" if count else "LENSMODEL_PINHOLE"
    texts = []
    for K, size, lens, world in (THREE[2], THREE[0]):
        model = {"lensmodel": kind, "intrinsics": [*numbers(K), *lens[:count]], "imagersize": list(size)}
        model[key] = [*vector(world), *world[:3, 3].tolist()]
        model |= {"extrinsics": [0.0] * 6} if key == "rt_cam_ref" else {}
        texts.append(f"# made by mrcal\n{model!r}\n\n")
    assert_is_the_pair(FORMATS["mrcal"].read(tuple(texts), CameraChoice()), lens=count or None)


def test_mrcal_models_with_twelve_coefficients_are_read_and_others_rejected():
    model = {"lensmodel": "LENSMODEL_OPENCV12", "intrinsics": [*numbers(K_LEFT), *LENS_LEFT, 1, 2, 3, 4]}
    model |= {"imagersize": [640, 480], "extrinsics": [0, 0, 0, 0.5, 0, 0]}
    other = model | {"extrinsics": [0, 0, 0, 0, 0, 0]}
    rig = FORMATS["mrcal"].read((repr(other), repr(model)), CameraChoice())
    assert rig.left.lens.coefficients.tolist() == [*LENS_LEFT, 1, 2, 3, 4] and rig.E[0, 3] == -0.5
    for change, sentence in (
        (
            {"lensmodel": "LENSMODEL_CAHVOR"},
            r"\Alensmodel must be one of LENSMODEL_PINHOLE, .*; got LENSMODEL_CAHVOR\. Run: "
            r"mrcal-convert-lens.*\Z",
        ),
        (
            {"intrinsics": [1, 2, 3, 4]},
            r"\Athe coefficients in intrinsics must be 12 finite numbers; got 0\. ",
        ),
        ({"extrinsics": [1, 2]}, r"\Aextrinsics must be 6 finite numbers; got 2\."),
    ):
        with pytest.raises(InputError, match=sentence):
            FORMATS["mrcal"].read((repr(other), repr(model | change)), CameraChoice())
    for text in ("[1, 2]", "{'a': open('x')}", "{", "1" * 5000 + "+"):
        with pytest.raises(
            InputError, match=r"\Athe file must be a camera model of mrcal; got a different text\. The"
        ):
            FORMATS["mrcal"].read((text, text), CameraChoice())


def test_long_baselines_in_board_units_raise_a_warning():
    """Lengths are in board units, which the files do not name."""
    far = [(K, size, lens, world.copy()) for K, size, lens, world in (THREE[2], THREE[0])]
    for entry in far:
        entry[3][:3, 3] *= 30
    with pytest.warns(UserWarning, match="states no unit"):
        FORMATS["anipose"].read((anipose(far),), CameraChoice())
    FORMATS["anipose"].read((anipose(far),), CameraChoice(baseline_m=0.2))


def read(reader, content, choice=UNCHOSEN):
    return reader((json.dumps(content),), choice)


@pytest.mark.parametrize(("lens", "model"), [("radialtangential", "opencv"), ("equidistant", "fisheye")])
def test_okvis_poses_are_in_the_imu_frame(lens, model):
    cameras = []
    for n, body in enumerate(BODIES):
        fx, fy, cx, cy = numbers(KS[n])
        cameras.append(
            {
                "T_SC": body.ravel().tolist(),
                "image_dimension": SIZES[n],
                "distortion_type": lens,
                "distortion_coefficients": LENSES[n][:4],
                "focal_length": [fx, fy],
                "principal_point": [cx, cy],
            }
        )
    assert_is_the_pair(read(FORMATS["okvis"].read, {"cameras": cameras}), lens=4, model=model)
    several = {"cameras": [cameras[1], cameras[1], cameras[0]]}
    assert_is_the_pair(read(FORMATS["okvis"].read, several, CameraChoice((2, 0))), lens=4, model=model)
    with pytest.raises(InputError, match=r"file \(0, 1, 2\); got 0,3"):
        read(FORMATS["okvis"].read, several, CameraChoice((0, 3)))


def matrix(values):
    return {"rows": 1, "cols": 1, "data": np.ravel(values).tolist()}


@pytest.mark.parametrize(
    ("key", "lens", "model"),
    [("T_B_C", "radial-tangential", "opencv"), ("T_C_B", "equidistant", "fisheye")],
)
def test_svo_poses_are_in_the_body_frame_or_inverted(key, lens, model):
    cameras = []
    for n, body in enumerate(BODIES):
        camera = {"type": "pinhole", "image_width": SIZES[n][0], "image_height": SIZES[n][1]}
        camera |= {"intrinsics": matrix(numbers(KS[n])), "distortion": {"type": lens}}
        camera["distortion"]["parameters"] = matrix(LENSES[n][:4])
        cameras.append({"camera": camera, key: matrix(body if key == "T_B_C" else np.linalg.inv(body))})
    rig = {"cameras": cameras}
    assert_is_the_pair(read(FORMATS["svo"].read, rig), lens=4, model=model)
    assert_is_the_pair(read(FORMATS["svo"].read, {"sensors": [{"id": 1}, rig]}), lens=4, model=model)
    several = {"cameras": [cameras[1], cameras[0], cameras[1]]}
    assert_is_the_pair(read(FORMATS["svo"].read, several, CameraChoice((1, 2))), lens=4, model=model)
    cameras[0]["camera"]["type"] = "omni"
    with pytest.raises(InputError, match="lens model of the left camera must be .*; got omni"):
        read(FORMATS["svo"].read, rig)


@pytest.mark.parametrize(
    ("kind", "model", "count"), [(0, "opencv", None), (1, "opencv", 5), (2, "fisheye", 4)]
)
@pytest.mark.parametrize("inverse", [(0, 0), (1, 1), (0, 1)])
def test_airslam_poses_may_be_inverted_per_camera(kind, model, count, inverse):
    content = {"image_width": 820, "image_height": 616, "distortion_type": kind}
    for n, body in enumerate(BODIES):
        pose = np.linalg.inv(body) if inverse[n] else body
        content[f"cam{n}"] = {
            "intrinsics": numbers(KS[n]),
            "distortion_coeffs": LENSES[n][:5],
            "T_type": inverse[n],
            "T": pose.tolist(),
        }
    rig = read(FORMATS["airslam"].read, content)
    assert rig.size_left == rig.size_right == SIZE_LEFT
    assert_is_the_pair(rig.sized(SIZE_LEFT, SIZE_RIGHT), lens=count, model=model)
    with pytest.raises(InputError, match=r"\Adistortion_type must be one of 0, 1, 2; got 3\.\Z"):
        read(FORMATS["airslam"].read, content | {"distortion_type": 3})


def kalibr_camera(n: int, count: int = 4, model: str = "radtan") -> dict:
    return {
        "intrinsics": numbers(KS[n]),
        "resolution": list(SIZES[n]),
        "distortion_coeffs": LENSES[n][:count],
        "distortion_model": model,
    }


def kalibr(cameras, choice=UNCHOSEN, **outer):
    return FORMATS["kalibr"].read(
        (json.dumps({f"cam{n}": c for n, c in enumerate(cameras)} | outer),), choice
    )


def test_kalibr_chain_poses_are_relative_to_the_previous_camera():
    left, right = kalibr_camera(0), kalibr_camera(1) | {"T_cn_cnm1": T.tolist()}
    assert_is_the_pair(kalibr([left, right]), lens=4)
    with_imu = [each | {"T_cam_imu": np.eye(4).tolist()} for each in (left, right)]
    assert_is_the_pair(kalibr(with_imu), lens=4)  # T_cn_cnm1 takes precedence
    below = {"rig": {"cam0": left, "cam1": right}, "before": {"a": 1}, "rate": 20}
    assert_is_the_pair(FORMATS["kalibr"].read((json.dumps(below),), CameraChoice()), lens=4)
    with pytest.raises(KeyError):
        kalibr([left, kalibr_camera(1)])


def test_kalibr_cameras_are_chosen_by_number_along_the_chain():
    """cam2 is the left camera and cam0 the right one; cam1 between them has another pose."""
    between = pose((40, 5, -8), (1, 2, 3))  # cam0 to cam1
    chain = [kalibr_camera(1), kalibr_camera(1) | {"T_cn_cnm1": between.tolist()}]
    cam2_from_cam1 = E @ np.linalg.inv(between)
    chain.append(kalibr_camera(0) | {"T_cn_cnm1": cam2_from_cam1[:3].tolist()})
    chain.append(kalibr_camera(0) | {"T_cn_cnm1": "nonsense"})
    assert_is_the_pair(kalibr(chain, CameraChoice((2, 0))), lens=4)
    np.testing.assert_allclose(kalibr(chain).E, np.linalg.inv(between), atol=1e-9)
    with pytest.raises(InputError, match=r"cameras must be two different cameras of the file \(0, 1, 2, 3\)"):
        kalibr(chain, CameraChoice((2, 4)))


@pytest.mark.parametrize("key", ["T_imu_cam", "T_cam_imu"])
def test_openvins_poses_are_relative_to_the_imu(key):
    cameras = [
        kalibr_camera(n) | {key: (body if key == "T_imu_cam" else np.linalg.inv(body)).tolist()}
        for n, body in enumerate(BODIES)
    ]
    assert_is_the_pair(kalibr(cameras), lens=4)
    assert_is_the_pair(kalibr([cameras[0], {"other": 1}, cameras[1]][::2]), lens=4)
    with pytest.raises(KeyError):
        kalibr([{k: v for k, v in cameras[0].items() if k != key}, cameras[1]])


def test_kalibr_cameras_may_have_extra_intrinsics_and_no_model():
    """Double sphere and others put their parameters before fx; the model itself is rejected."""
    cameras = [kalibr_camera(0), kalibr_camera(1) | {"T_cn_cnm1": T.tolist()}]
    for camera in cameras:
        camera["intrinsics"] = [0.5, *camera["intrinsics"]]
    assert_is_the_pair(kalibr(cameras), lens=4)
    cameras[1]["camera_model"] = "omni"
    with pytest.raises(InputError, match="the lens model of the right camera must be .*; got omni"):
        kalibr(cameras)
    fisheye = [{**each, "camera_model": "pinhole", "distortion_model": "equidistant"} for each in cameras]
    assert_is_the_pair(kalibr(fisheye), lens=4, model="fisheye")


@pytest.mark.parametrize(
    ("kind", "names", "model", "count"),
    [
        ("pinhole-radtan8", "k1 k2 p1 p2 k3 k4 k5 k6", "opencv", 8),
        ("kb4", "k1 k2 k3 k4", "fisheye", 4),
        ("pinhole", "", "opencv", None),
    ],
)
def test_basalt_poses_are_quaternions_in_the_imu_frame(kind, names, model, count):
    poses, cameras = [], []
    for n, body in enumerate(BODIES):
        place = dict(zip(("px", "py", "pz"), body[:3, 3].tolist(), strict=True))
        poses.append(place | dict(zip(("qx", "qy", "qz", "qw"), quaternion(body), strict=True)))
        values = dict(zip(("fx", "fy", "cx", "cy"), numbers(KS[n]), strict=True))
        values |= dict(zip(names.split(), LENSES[n], strict=False))
        cameras.append({"camera_type": kind, "intrinsics": values})
    data = {"T_imu_cam": poses, "intrinsics": cameras, "resolution": SIZES}
    for content in (data, {"value0": data}):
        rig = FORMATS["basalt"].read((json.dumps(content),), CameraChoice())
        assert_is_the_pair(rig, lens=count, model=model)
    turned = {key: [values[1], values[0], values[0]] for key, values in data.items()}
    rig = FORMATS["basalt"].read((json.dumps(turned),), CameraChoice((2, 0)))
    assert_is_the_pair(rig, lens=count, model=model)
    cameras[0]["camera_type"] = "ds"
    with pytest.raises(
        InputError,
        match=r"\Acamera_type must be one of pinhole, pinhole-radtan8, kb4; got ds\. "
        r"Calibrate with basalt_calibrate .*\Z",
    ):
        FORMATS["basalt"].read((json.dumps(data),), CameraChoice())


@pytest.mark.parametrize(
    ("kind", "of_K", "of_lens", "model"),
    [
        ("PINHOLE", "fx fy cx cy", "k1 k2 p1 p2", "opencv"),
        ("kannala_brandt", "mu mv u0 v0", "k2 k3 k4 k5", "fisheye"),
    ],
)
def test_vins_fusion_poses_are_in_the_body_frame(kind, of_K, of_lens, model):
    config = {f"body_T_cam{n}": {"data": body.ravel().tolist()} for n, body in enumerate(BODIES)}
    config |= {"cam0_calib": "l.yaml", "cam1_calib": "sub/r.yaml"}
    assert posed.vins_files(json.dumps(config)) == ["l.yaml", "sub/r.yaml"]
    texts = [json.dumps(config)]
    for n in range(2):
        K = dict(zip(of_K.split(), numbers(KS[n]), strict=True))
        lens = dict(zip(of_lens.split(), LENSES[n], strict=False))
        parts = {"projection_parameters": K, "distortion_parameters": lens}
        if model == "fisheye":
            parts = {"projection_parameters": lens | K, "distortion_parameters": None}
        head = {"model_type": kind, "image_width": SIZES[n][0], "image_height": SIZES[n][1]}
        texts.append(json.dumps(head | parts))
    assert_is_the_pair(FORMATS["vins"].read(tuple(texts), CameraChoice()), lens=4, model=model)
    texts[2] = texts[2].replace(kind, "mei")
    with pytest.raises(
        InputError, match=r"\Amodel_type must be one of PINHOLE, KANNALA_BRANDT; got MEI\. Calib"
    ):
        FORMATS["vins"].read(tuple(texts), CameraChoice())


@pytest.mark.parametrize("as_list", [False, True])
def test_euroc_sensor_poses_are_in_the_body_frame(as_list):
    texts = []
    for n, body in enumerate(BODIES):
        numbers_ = body.ravel().tolist()
        sensor = kalibr_camera(n) | {"T_BS": numbers_ if as_list else {"rows": 4, "data": numbers_}}
        sensor["distortion_coefficients"] = sensor.pop("distortion_coeffs")
        texts.append(json.dumps(sensor))
    assert_is_the_pair(FORMATS["euroc"].read(tuple(texts), CameraChoice()), lens=4)


def test_robotcar_poses_include_the_image_axes():
    texts = [
        "\n".join([words(numbers(K)), *(words(row) for row in body)])
        for K, body in ((K_LEFT, BODY_LEFT), (K_RIGHT, BODY_RIGHT))
    ]
    rig = FORMATS["robotcar"].read(tuple(texts), CameraChoice())
    assert rig.rectified
    np.testing.assert_allclose(rig.E, E, atol=1e-9)
    np.testing.assert_array_equal(rig.K_left, K_LEFT)
    np.testing.assert_array_equal(rig.K_right, K_RIGHT)
    with pytest.raises(InputError, match="the model must be 20 finite numbers; got 4"):
        FORMATS["robotcar"].read((texts[0], words([1, 2, 3, 4])), CameraChoice())


def test_mvsnet_pair_poses_are_world_to_camera():
    texts = [
        f"extrinsic\n{words(np.linalg.inv(body))}\n\nintrinsic\n{words(K)}\n\n0.5 0.01 3\n"
        for K, body in ((K_LEFT, BODY_LEFT), (K_RIGHT, BODY_RIGHT))
    ]
    assert_is_the_pair(FORMATS["mvsnet"].read(tuple(texts), CameraChoice()), lens=None, sizes=False)
