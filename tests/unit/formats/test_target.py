"""The target camera for reprojection, from a JSON file or the text of a RealSense."""

import json

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import read_calibration, target
from tests.unit.formats.calibrated_pair import K_LEFT, K_RIGHT, SIZE_LEFT, SIZE_RIGHT, E, T, numbers

CAMERA = {"K": K_RIGHT.tolist(), "E": E.tolist(), "width": SIZE_RIGHT[0], "height": SIZE_RIGHT[1]}


def test_target_camera_and_frame_are_read(tmp_path):
    file = tmp_path / "camera.json"
    file.write_text(json.dumps(CAMERA))
    camera = target.read_target_camera(file)
    np.testing.assert_array_equal(camera.K, K_RIGHT)
    np.testing.assert_allclose(camera.E, E, atol=1e-12)
    assert tuple(camera.size) == SIZE_RIGHT and target.frame_of_target(file) == "reprojected"
    file.write_text(json.dumps(CAMERA | {"frame_id": "rgb"}))
    assert target.frame_of_target(file) == "rgb"


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("{", r"camera\.json, which is not JSON \(JSONDecodeError\)"),
        ("[" * 100_000, r"camera\.json, which is not JSON \(RecursionError\)"),
        ("[1]", r"camera\.json without K, E, width, height"),
        ('{"K": 1, "width": 3}', r"camera\.json without E, height"),
    ],
)
def test_other_files_are_rejected_with_the_missing_keys(tmp_path, text, got):
    file = tmp_path / "camera.json"
    file.write_text(text)
    for read in (target.read_target_camera, target.frame_of_target):
        with pytest.raises(
            InputError, match=rf"\A--reproject must be a JSON file such as .*; got .*{got}\.\Z"
        ):
            read(file)
    with pytest.raises(InputError, match="--reproject"):
        target.read_target_camera(tmp_path / "none.json")


def intrinsic(name: str, K: np.ndarray, size, formats: str, lens=(0.0,) * 5) -> str:
    """A camera as ``rs-enumerate-devices -c`` prints it: labels of 14 characters, then a tab."""
    fx, fy, cx, cy = numbers(K)
    values = {"Width": size[0], "Height": size[1], "PPX": cx, "PPY": cy, "Fx": fx, "Fy": fy}
    values |= {"Distortion": "Inverse Brown Conrady", "Coeffs": "  \t".join(f"{each:.15g}" for each in lens)}
    lines = [f"{f'  {label}: ':<14}\t{value}" for label, value in values.items()]
    return "\n".join([f' Intrinsic of "{name}" / {size[0]}x{size[1]} / {{{formats}}}', *lines, "", ""])


def extrinsic(source: str, target: str, T: np.ndarray) -> str:
    """A transform as it is printed: rotations row by row, the translation in metres."""
    rows = "\n".join("".join(f"{value:>4.9g}         " for value in row) for row in T[:3, :3])
    shift = "".join(f"{value:.15g}  " for value in T[:3, 3])
    head = f'Extrinsic from "{source}"\t  To\t  "{target}" :\n Rotation Matrix:\n'
    return f"{head}{rows}\n\n Translation Vector: {shift}\n\n"


def printed(lens=(0.0,) * 5, sizes=(SIZE_RIGHT, (520, 350))) -> str:
    """An excerpt of the output; every transform is printed with its inverse."""
    text = "Intrinsic Parameters:\n\n" + intrinsic("Depth", K_LEFT, SIZE_LEFT, "Z16")
    for number, size in enumerate(sizes):
        K = np.diag([1, 1, 1.0 + number]) @ K_RIGHT / (1.0 + number)  # half of the size
        text += intrinsic("Color", K, size, "YUYV/RGB8/BGR8/RGBA8/BGRA8/Y16", lens)
    text += "".join(intrinsic(f"Infrared {n}", K_LEFT, SIZE_LEFT, "Y8") for n in (1, 2))
    to_second = np.eye(4)
    to_second[0, 3] = -0.05
    text += "\nExtrinsic Parameters:\n" + extrinsic("Color", "Infrared 1", E)
    for name, between in (("Color", T), ("Infrared 1", np.eye(4)), ("Infrared 2", to_second)):
        text += extrinsic("Infrared 1", name, between)
    return text + extrinsic("Infrared 2", "Color", T @ np.linalg.inv(to_second))


def test_the_colour_camera_of_a_realsense_is_posed_in_its_left_infrared_camera(tmp_path):
    """The pose is the printed transform from colour to infrared 1, which is not read."""
    file = tmp_path / "realsense.txt"
    file.write_text(printed())
    for size, scale in ((SIZE_RIGHT, 1.0), ((520, 350), 0.5)):
        camera = target.read_target_camera(file, size)
        np.testing.assert_allclose(camera.K[:2], scale * K_RIGHT[:2], rtol=1e-9)
        np.testing.assert_allclose(camera.E, E, atol=1e-8)
        assert camera.size == size
    assert target.frame_of_target(file) == "reprojected"
    rig = read_calibration(file, image_size=SIZE_LEFT)
    np.testing.assert_allclose(rig.E[:3, 3], [0.05, 0, 0], atol=1e-9)
    file.write_text(printed(sizes=(SIZE_RIGHT,)))
    assert target.read_target_camera(file).size == SIZE_RIGHT


@pytest.mark.parametrize(
    ("text", "size", "message"),
    [
        (printed(), None, r"--reproject-size must be a size of .* \(520x350, 1040x700\); got no size"),
        (printed(), (640, 480), r"--reproject-size must be .*; got 640x480"),
        (printed(sizes=()), None, r"--reproject-size must be a size of .* \(none\)"),
        (printed(lens=(-0.05, 0.06, 0, 0, 0.01)), SIZE_RIGHT, "must be without lens distortion.*Undistort"),
        (printed().replace('1"\t  To\t  "Color"', '1" To "Gyro"'), SIZE_RIGHT, "rotation of the extrinsics"),
        (printed().replace("Fx:", "F:"), SIZE_RIGHT, "no 'fx'"),
        (json.dumps(CAMERA), SIZE_RIGHT, "--reproject-size is for the output of rs-enumerate-devices -c"),
    ],
)
def test_a_realsense_without_one_suitable_colour_camera_is_rejected(tmp_path, text, size, message):
    file = tmp_path / "realsense.txt"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        target.read_target_camera(file, size)
