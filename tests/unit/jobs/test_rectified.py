"""Images as taken or rectified, where a calibration describes both."""

import json

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import captured_warnings
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import read_pair
from geodiff_plugin.jobs.rectified import off_lines_px, select_rig
from tests.contracts.calibrations import read_texts
from tests.views import lenses_of

pytestmark = pytest.mark.end_to_end

SIZE = (640, 480)
K_TAKEN = (
    np.array([[520.0, 0, 322.5], [0, 521, 236.25], [0, 0, 1]]),
    np.array([[515.0, 0, 316.5], [0, 514, 243.75], [0, 0, 1]]),
)
LENSES = ([-0.18, 0.05, 0.001, -0.0008, 0.0], [-0.16, 0.04, -0.0005, 0.001, 0.0])
#: From the frame of a camera as it stands to its rectified frame.
TURNS = (
    Rotation.from_rotvec([0.02, 0.01, -0.015]).as_matrix(),
    Rotation.from_rotvec([-0.01, -0.02, 0.01]).as_matrix(),
)
K_RECTIFIED = np.array([[470.0, 0, 310.5], [0, 470, 245.5], [0, 0, 1]])
BASELINE_M, WALL_M = 0.081, 1.7


def camera_to_camera() -> tuple[np.ndarray, np.ndarray]:
    """R and T of stereoCalibrate: x_right = R x_left + T."""
    return TURNS[1].T @ TURNS[0], TURNS[1].T @ [-BASELINE_M, 0, 0]


def projections() -> tuple[np.ndarray, np.ndarray]:
    return tuple(K_RECTIFIED @ np.column_stack([np.eye(3), [-x, 0, 0]]) for x in (0.0, BASELINE_M))


def wall(rays: np.ndarray, side: int, texture: np.ndarray) -> np.ndarray:
    """What a camera sees of a wall before the rectified rig, along rays ``(H, W, 3)`` in its frame."""
    places = rays / rays[..., 2:] * WALL_M + [BASELINE_M * side, 0, 0]
    at = (places[..., :2] * 400 + 700).astype(np.float32)
    return cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


@pytest.fixture(scope="module")
def images() -> dict[str, list[np.ndarray]]:
    """The wall by both cameras, as taken and rectified, ``(H, W, 3)`` in [0, 1]."""
    noise = np.random.default_rng(3).uniform(0, 1, (1400, 1400)).astype(np.float32)
    grey = cv2.GaussianBlur(noise, (0, 0), 2.5)
    texture = np.repeat(((grey - grey.min()) / np.ptp(grey))[..., None], 3, axis=2)
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    pixels = np.stack([columns, rows], -1).reshape(-1, 1, 2).astype(np.float64)
    found: dict[str, list[np.ndarray]] = {"taken": [], "rectified": []}
    for side in (0, 1):
        straight = cv2.undistortPoints(pixels, K_TAKEN[side], np.array(LENSES[side]))[:, 0]
        rays = np.column_stack([straight, np.ones(len(straight))]) @ TURNS[side].T
        found["taken"].append(wall(rays.reshape(SIZE[1], SIZE[0], 3), side, texture))
        homogeneous = np.column_stack([pixels[:, 0], np.ones(len(pixels))]) @ np.linalg.inv(K_RECTIFIED).T
        found["rectified"].append(wall(homogeneous.reshape(SIZE[1], SIZE[0], 3), side, texture))
    return found


def opencv(unit: float = 1.0, by_turns: bool = False) -> str:
    """Everything that tutorials save, lengths in a unit of which a metre has ``unit``."""
    R, T = camera_to_camera()
    P1, P2 = projections()
    P2[:, 3] *= unit
    entries = {f"K{n + 1}": K_TAKEN[n] for n in (0, 1)} | {f"D{n + 1}": np.array(LENSES[n]) for n in (0, 1)}
    entries |= {"R1": TURNS[0], "R2": TURNS[1], "P1": P1, "P2": P2, "image_size": np.array(SIZE)}
    entries |= {} if by_turns else {"R": R, "T": unit * T}
    named = {name: matrix.tolist() for name, matrix in entries.items()}
    return json.dumps(named | ({"baseline_mm": 1000 * BASELINE_M} if unit != 1.0 else {}))


def ros() -> tuple[str, str]:
    """left.yaml and right.yaml of camera_calibration."""
    texts = []
    for n, P in enumerate(projections()):
        matrices = {"camera_matrix": K_TAKEN[n], "rectification_matrix": TURNS[n], "projection_matrix": P}
        entries = {name: {"data": matrix.ravel().tolist()} for name, matrix in matrices.items()}
        entries["distortion_coefficients"] = {"data": LENSES[n]}
        entries |= {"image_width": SIZE[0], "image_height": SIZE[1], "distortion_model": "plumb_bob"}
        texts.append(yaml.safe_dump(entries))
    return texts[0], texts[1]


WRITERS = {
    "opencv": lambda: (opencv(),),
    "opencv in mm": lambda: (opencv(1000.0),),
    "opencv by turns": lambda: (opencv(by_turns=True),),
    "ros": ros,
}


@pytest.mark.parametrize("writer", WRITERS)
def test_a_file_of_both_has_the_raw_cameras_and_the_rectified_ones(writer, tmp_path):
    rig = read_texts(tmp_path, *WRITERS[writer](), distorted=True)
    R, T = camera_to_camera()
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.T, -R.T @ T
    assert rig.rectified and lenses_of(rig) == (None, None)
    np.testing.assert_allclose(rig.E[:3, 3], [BASELINE_M, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rig.as_taken.E, pose, atol=1e-9)
    np.testing.assert_allclose(rig.as_taken.K_left, K_TAKEN[0])
    np.testing.assert_allclose(rig.as_taken.K_right, K_TAKEN[1])
    for lens, expected in zip(lenses_of(rig.as_taken), LENSES, strict=True):
        np.testing.assert_array_equal(lens.coefficients, expected)
    assert rig.as_taken.size_left == SIZE and not rig.as_taken.rectified


@pytest.mark.parametrize("writer", WRITERS)
def test_images_select_the_cameras_that_fit(writer, images, tmp_path):
    rig = read_texts(tmp_path, *WRITERS[writer](), distorted=True)
    assert select_rig(rig, images["rectified"]) is rig
    with (
        captured_warnings() as said,
        pytest.warns(UserWarning, match="These images are raw: matches lie 0.. px off"),
    ):
        chosen = select_rig(rig, images["taken"])
    np.testing.assert_array_equal(chosen.K_left, K_TAKEN[0])
    assert chosen.source == rig.source and [message.code for message in said] == ["calibration.unrectified"]
    assert not said[0].is_reason


def test_images_without_matches_are_assumed_rectified(images, tmp_path):
    rig = read_texts(tmp_path, opencv(), distorted=True)
    plain = [np.full_like(image, 0.5) for image in images["taken"]]
    assert select_rig(rig, plain) is rig and select_rig(rig, images["taken"][:1]) is rig


def test_a_baseline_that_is_given_holds_for_both_descriptions(tmp_path):
    rig = read_texts(tmp_path, opencv(), distorted=True, baseline_m=0.5)
    for each in (rig, rig.as_taken):
        assert np.linalg.norm(each.E[:3, 3]) == pytest.approx(0.5)


def test_the_distance_off_a_line_is_in_pixels(tmp_path):
    rig = read_texts(tmp_path, opencv(), distorted=True)
    left = np.array([[100.0, 200], [300, 50], [500, 400]])
    assert off_lines_px(rig, left, left - [17, 0]) == pytest.approx(0, abs=1e-9)
    assert off_lines_px(rig, left, left - [17, 3]) == pytest.approx(3, rel=1e-6)


def test_a_file_with_unreadable_cameras_remains_one_of_rectified_images(tmp_path):
    entries = json.loads(opencv()) | {"D1": [0.1, 0.2, 0.3]}
    assert read_texts(tmp_path, json.dumps(entries)).as_taken is None


def test_a_doubted_unit_of_a_file_forbids_trust_in_the_command_too(images, tmp_path):
    """As a translation that counts the squares of a board, read for ``geodiff depth``."""
    entries = json.loads(opencv())
    cameras = {name: entries[name] for name in ("K1", "K2", "D1", "D2", "R")}
    unit = 40.0  # 3.2 "metres"
    text = json.dumps(cameras | {"T": [unit * x for x in entries["T"]]})
    (tmp_path / "calib.json").write_text(text)
    for side, image in zip(("left", "right"), images["taken"], strict=True):
        cv2.imwrite(str(tmp_path / f"{side}.png"), (image * 255).astype(np.uint8))
    options = DepthOptions(
        left=tmp_path / "left.png", right=tmp_path / "right.png", calib=(tmp_path / "calib.json",)
    )
    with pytest.warns(UserWarning, match="states no unit"):
        inputs = read_pair(options)
    assert "calibration.assumed-metres" in [finding.code for finding in inputs.guidance.findings]
