"""Trajectory data sets: three images, and the frames of reference of their poses."""

import json

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import datasets
from tests.unit.formats.calibrated_pair import pose, quaternion, words
from tests.unit.formats.posed_images import KS, POSES, SIZES, assert_is_read, numbers, write_images

NAMES = ["10.png", "11.png", "12.png"]
T_BODY_CAMERA = pose((-74, 12, 95), (0.05, -0.04, 0.07))
START_NS = 1_403_636_579_763_555_584


def write_euroc(folder, ground_truth="state_groundtruth_estimate0", stamps=None):
    """Poses are of the body, with ``w`` first in quaternions."""
    stamps = stamps or [START_NS + n * 50_000_000 for n in range(3)]
    files = write_images(folder / "cam0" / "data", [f"{ns}.png" for ns in stamps])
    lens = [0.1, -0.2, 0.003, -0.004]
    sensor = {
        "T_BS": {"data": T_BODY_CAMERA.ravel().tolist()},
        "intrinsics": numbers(1),
        "resolution": SIZES[1],
    }
    sensor |= {"distortion_model": "radtan", "distortion_coefficients": lens}
    (folder / "cam0" / "sensor.yaml").write_text(json.dumps(sensor))
    rows = "".join(f"{ns},{file.name},x\n" for ns, file in zip(stamps, files, strict=True))
    (folder / "cam0" / "data.csv").write_text(f"#timestamp,filename\n{rows}")
    rows = ""
    for n, E in enumerate(POSES):
        body = E @ np.linalg.inv(T_BODY_CAMERA)
        x, y, z, w = quaternion(body)
        rows += f"{START_NS + n * 50_000_000},{words([*body[:3, 3], w, x, y, z, 9, 9], ',')}\n"
    (folder / ground_truth).mkdir(parents=True, exist_ok=True)
    (folder / ground_truth / "data.csv").write_text(f"#head\n{rows}")
    return files, {"Ks": [KS[1]] * 3, "sizes": [SIZES[1]] * 3, "lenses": [lens] * 3, "models": ["radtan"] * 3}


@pytest.mark.parametrize(
    ("below", "ground_truth"),
    [("mav0", "state_groundtruth_estimate0"), ("", "mocap0"), ("mav0", "gt0"), ("", "leica0")],
)
def test_euroc_image_poses_combine_body_pose_and_camera_mount(tmp_path, below, ground_truth):
    files, expected = write_euroc(tmp_path / below, ground_truth)
    assert_is_read(datasets.read_euroc(tmp_path), "EuRoC", "m", files, **expected)
    (tmp_path / below / "cam1").mkdir()
    assert_is_read(datasets.read_euroc(tmp_path), "EuRoC", "m", files, **expected, findings=["capture.part"])
    (tmp_path / below / ground_truth / "data.csv").unlink()
    with pytest.raises(
        InputError,
        match=r"\Aa sequence of EuRoC must be with ground truth \(state_groundtruth_esti"
        r"mate0/data\.csv or .*\); got .* without\. Pass .*cam0/data with --K to solve",
    ):
        datasets.read_euroc(tmp_path)
    (tmp_path / below / "cam0" / "sensor.yaml").unlink()
    assert datasets.read_euroc(tmp_path) is None


def test_euroc_images_far_from_every_pose_have_none(tmp_path):
    stamps = [START_NS - 49_000_000, START_NS + 50_000_000, START_NS + 151_000_000]
    files, expected = write_euroc(tmp_path, stamps=stamps)
    layout = datasets.read_euroc(tmp_path)
    assert_is_read(layout, "EuRoC", "m", files, **expected, poses=[*POSES[:2], None])


def test_tartanair_poses_use_ned_axes(tmp_path):
    """TartanAir cameras have x forward, y right and z down."""
    files = write_images(tmp_path / "image_left", ["9_left.png", "10_left.png", "11_left.png"])
    rows = []
    for E in POSES:
        right, down, forward = E[:3, :3].T
        rows.append(words([*E[:3, 3], *quaternion(np.column_stack([forward, right, down]))]))
    (tmp_path / "pose_left.txt").write_text("\n".join(rows))
    depths = [tmp_path / "depth_left" / f"{file.stem}_depth.npy" for file in files]
    K = np.array([[320.0, 0, 320], [0, 320, 240], [0, 0, 1]])
    layout = datasets.read_tartanair(tmp_path)
    assert_is_read(layout, "TartanAir", "m", files, Ks=[K] * 3, sizes=[(640, 480)] * 3, depths=depths)
    (tmp_path / "pose_left.txt").write_text("\n".join(rows[:2]))
    with pytest.raises(
        InputError, match=r"\Apose_left\.txt must be a file with 3 lines, one per image; got 2\.\Z"
    ):
        datasets.read_tartanair(tmp_path)
    (tmp_path / "pose_left.txt").unlink()
    assert datasets.read_tartanair(tmp_path) is None
    (tmp_path / "pose_left.txt").write_text("1")
    for file in files:
        file.unlink()
    assert datasets.read_tartanair(tmp_path) is None


@pytest.mark.parametrize(
    ("camera", "place"),
    [(0, "poses.txt"), (1, "04.txt"), (2, "poses.txt"), (3, "../../poses/04.txt"), (2, "../../poses/04.txt")],
)
def test_kitti_odometry_poses_belong_to_camera_0(tmp_path, camera, place):
    folder = tmp_path / "sequences" / "04"
    files = write_images(folder / f"image_{camera}", NAMES)
    Ks = [KS[0] * [[1 + n], [1 + 0.5 * n], [1]] for n in range(4)]
    places = np.array([[0, 0, 0], [0.5, 0.01, 0.02], [0.06, -0.02, 0.03], [0.6, 0.03, -0.04]])
    lines = [
        f"P{n}: {words(K @ np.column_stack([np.eye(3), -at]))}"
        for n, (K, at) in enumerate(zip(Ks, places, strict=True))
    ]
    (folder / "calib.txt").write_text("\n".join(lines))
    at = folder / place
    at.parent.mkdir(exist_ok=True)
    shift = pose((0, 0, 0), places[camera])
    at.write_text("\n".join(words((E @ np.linalg.inv(shift))[:3]) for E in POSES))
    layout = datasets.read_kitti_odometry(folder)
    assert_is_read(layout, "KITTI odometry", "m", files, Ks=[Ks[camera]] * 3, sizes=None)
    if camera == 2 and place == "poses.txt":
        write_images(folder / "image_0", NAMES)
        assert datasets.read_kitti_odometry(folder).candidates[0].frame.image == files[0]
        at.unlink()
        assert datasets.read_kitti_odometry(folder) is None
        at.write_text("1")
        (folder / "calib.txt").unlink()
        assert datasets.read_kitti_odometry(folder) is None
        assert datasets.read_kitti_odometry(tmp_path) is None


@pytest.mark.parametrize("folder", ["images", "blended_images"])
def test_mvsnet_folder_poses_are_world_to_camera(tmp_path, folder):
    files = write_images(tmp_path / folder, NAMES)
    (tmp_path / "cams").mkdir()
    for n, name in enumerate(("10", "11", "12")):
        T = np.linalg.inv(POSES[n])
        text = f"extrinsic\n{words(T)}\n\nintrinsic\n{words(KS[n])}\n\n425.0 2.5 192 935.0\n"
        (tmp_path / "cams" / f"{name}_cam.txt").write_text(text)
    assert_is_read(datasets.MVSNET_FOLDER(tmp_path), "MVSNet", None, files, sizes=None)
    (tmp_path / "cams" / "11_cam.txt").unlink()
    candidates = datasets.MVSNET_FOLDER(tmp_path).candidates
    assert "the camera of 11" in candidates[1].problem and not candidates[2].problem
    for file in (tmp_path / "cams").iterdir():
        file.unlink()
    assert datasets.MVSNET_FOLDER(tmp_path) is None
    (tmp_path / "cams" / "11_cam.txt").write_text("x")
    for file in files:
        file.unlink()
    assert datasets.MVSNET_FOLDER(tmp_path) is None


def log_text(numbers_=(0, 1, 2), registered=(5, 0, 6)) -> str:
    blocks = zip(numbers_, registered, POSES, strict=True)
    return "\n".join(f"{n} {other} 7\n" + "\n".join(words(row) for row in E) for n, other, E in blocks)


@pytest.mark.parametrize("folder", ["", "images", "scene"])
def test_tanks_and_temples_poses_are_indexed_by_image_number(tmp_path, folder):
    files = write_images(tmp_path / folder, ["9.png", "10.png", "11.png"])
    (tmp_path / "a.log").write_text("some words of a program\n" * 5)
    (tmp_path / "scene.log").write_text(log_text((2, 0, 1)))
    expected = [files[2], files[0], files[1]]
    for path in (tmp_path, tmp_path / "scene.log"):
        assert_is_read(datasets.read_log(path), "Tanks and Temples", None, expected, Ks=None)
    (tmp_path / "scene.log").write_text(log_text(registered=(0, -1, 1)))
    lost = [POSES[0], None, POSES[2]]
    assert_is_read(datasets.read_log(tmp_path), "Tanks and Temples", None, files, Ks=None, poses=lost)
    for number in (3, -1):
        (tmp_path / "scene.log").write_text(log_text((0, 1, number)))
        with pytest.raises(
            InputError,
            match=rf"\Ascene\.log must be a log of the 3 images next to it; got a frame {number}\.",
        ):
            datasets.read_log(tmp_path)
    for file in files:
        file.unlink()
    with pytest.raises(
        InputError, match=r"\APATH must be a \.log with its images next to it or in images/; got .*scene"
    ):
        datasets.read_log(tmp_path)


@pytest.mark.parametrize("change", ["a longer heading", "a shorter body", "a longer row"])
def test_other_log_files_are_ignored(tmp_path, change):
    write_images(tmp_path, NAMES)
    lines = log_text().splitlines()
    if change == "a longer heading":
        lines[5] += " 8"
    elif change == "a longer row":
        lines[8] += " 8"
    else:
        lines = lines[:-1]
    (tmp_path / "a.log").write_text("\n".join(lines))
    assert datasets.read_log(tmp_path) is None
    assert datasets.read_log(tmp_path / "10.png") is None


@pytest.mark.parametrize("text", ["", "# a comment\n", "took 1,5 s of 2,5 s\n"])
def test_the_log_of_another_program_does_not_hide_a_log_with_poses(tmp_path, text):
    files = write_images(tmp_path, NAMES)
    (tmp_path / "a.log").write_text(text)
    assert datasets.read_log(tmp_path) is None
    (tmp_path / "b.log").write_text(log_text())
    assert_is_read(datasets.read_log(tmp_path), "Tanks and Temples", None, files, Ks=None)


def test_a_log_that_the_user_names_is_not_skipped(tmp_path):
    (tmp_path / "scene.log").write_text("0 1,5 2\n")
    with pytest.raises(InputError, match="must be numbers with a decimal point"):
        datasets.read_log(tmp_path / "scene.log")
