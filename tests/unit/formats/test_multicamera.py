"""Multi-camera calibrations in which the pair is neither first nor in order."""

import json

import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import multicamera
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.calibrated_pair import (
    BODY_LEFT,
    BODY_RIGHT,
    K_LEFT,
    K_RIGHT,
    LENS_LEFT,
    LENS_RIGHT,
    SIZE_LEFT,
    SIZE_RIGHT,
    E,
    assert_is_the_pair,
    numbers,
    pose,
    vector,
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
    rig = multicamera.read_anipose((anipose(THREE, (above, form)),), CHOSEN)
    assert_is_the_pair(rig)
    two = anipose([THREE[2], THREE[0]], (above, form))
    assert_is_the_pair(multicamera.read_anipose((two,), CameraChoice()))
    fisheye = anipose(THREE, (above, form), 4, True)
    assert_is_the_pair(multicamera.read_anipose((fisheye,), CHOSEN), lens=4, model="fisheye")
    with pytest.raises(
        InputError,
        match=r"\Acameras must be given, two of 0 \(cam_0\), 1 \(view 1\), 2 \(view 2\); "
        r"got none\. Give --cameras LEFT,RIGHT\.\Z",
    ):
        multicamera.read_anipose((anipose(THREE, (above, form)),), CameraChoice())
    with pytest.raises(
        InputError, match=r"cameras must be two different cameras of the file \(0, 1, 2\); got 2,3"
    ):
        multicamera.read_anipose((anipose(THREE, (above, form)),), CameraChoice((2, 3)))
    without_size = anipose(THREE).replace("size =", "sizes =")
    assert multicamera.read_anipose((without_size,), CHOSEN).size_left is None


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
    rig = multicamera.read_mc_calib((json.dumps(content),), CHOSEN)
    assert_is_the_pair(rig, lens=count, model=model)
    with pytest.raises(InputError, match=r"two of 0 \(camera_0\), 1 \(camera_1\), 2 \(camera_2\); got none"):
        multicamera.read_mc_calib((json.dumps(content),), CameraChoice())
    content["camera_2"]["distortion_type"] = 2
    with pytest.raises(InputError, match=r"\Adistortion_type must be one of 0, 1; got 2\.\Z"):
        multicamera.read_mc_calib((json.dumps(content),), CHOSEN)


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
        rig = multicamera.read_multical((multical(poses),), CHOSEN)
        assert_is_the_pair(rig)
    sentence = r"\Acamera_poses must be with a pose of left; got {}\. Calibrate again\.\Z"
    for poses, got in (
        ({"right": right}, "right"),
        ({}, "none"),
        ({"left_to_other": E, "right": right}, "left_to_other, right"),
        ({"left_to_other": E, "other_to_left": E}, "left_to_other, other_to_left"),
    ):
        with pytest.raises(InputError, match=sentence.format(got)):
            multicamera.read_multical((multical(poses),), CHOSEN)
    with pytest.raises(InputError, match=r"two of 0 \(right\), 1 \(other\), 2 \(left\); got none"):
        multicamera.read_multical((multical(worlds),), CameraChoice())


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
    assert_is_the_pair(multicamera.read_mrcal(tuple(texts), CameraChoice()), lens=count or None)


def test_mrcal_models_with_twelve_coefficients_are_read_and_others_refused():
    model = {"lensmodel": "LENSMODEL_OPENCV12", "intrinsics": [*numbers(K_LEFT), *LENS_LEFT, 1, 2, 3, 4]}
    model |= {"imagersize": [640, 480], "extrinsics": [0, 0, 0, 0.5, 0, 0]}
    other = model | {"extrinsics": [0, 0, 0, 0, 0, 0]}
    rig = multicamera.read_mrcal((repr(other), repr(model)), CameraChoice())
    assert rig.distortion[0].coefficients.tolist() == [*LENS_LEFT, 1, 2, 3, 4] and rig.E[0, 3] == -0.5
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
            multicamera.read_mrcal((repr(other), repr(model | change)), CameraChoice())
    for text in ("[1, 2]", "{'a': open('x')}", "{", "1" * 5000 + "+"):
        with pytest.raises(
            InputError, match=r"\Athe file must be a camera model of mrcal; got another text\. Is"
        ):
            multicamera.read_mrcal((text, text), CameraChoice())


def test_long_baselines_in_board_units_raise_a_warning():
    """Lengths are in board units, which the files do not name."""
    far = [(K, size, lens, world.copy()) for K, size, lens, world in (THREE[2], THREE[0])]
    for entry in far:
        entry[3][:3, 3] *= 30
    with pytest.warns(UserWarning, match="does not say its unit"):
        multicamera.read_anipose((anipose(far),), CameraChoice())
    multicamera.read_anipose((anipose(far),), CameraChoice(baseline_m=0.2))
