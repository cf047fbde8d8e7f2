"""Phone scanning apps: three images from three cameras."""

import json

import cv2
import numpy as np
import pytest

from geodiff_plugin.formats import phones
from tests.unit.formats.calibrated_pair import quaternion, vector, words
from tests.unit.formats.posed_images import (
    CORNER,
    KS,
    POSES,
    SIZES,
    assert_is_read,
    numbers,
    write_images,
)

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
NAMES = ["10.png", "11.png", "12.png"]


def write_polycam(folder, shift=0.0):
    folder.mkdir(parents=True)
    for n, name in enumerate(NAMES):
        E = POSES[n] @ FLIP
        entries = {f"t_{row}{column}": float(E[row, column]) for row in range(3) for column in range(4)}
        entries |= dict(zip(("fx", "fy", "cx", "cy"), numbers(n, 0.5), strict=True))
        entries |= {"width": SIZES[n][0], "height": SIZES[n][1], "t_03": float(E[0, 3]) + shift}
        (folder / name).with_suffix(".json").write_text(json.dumps(entries))


@pytest.mark.parametrize("below", ["", "keyframes"])
@pytest.mark.parametrize("corrected", [True, False])
def test_polycam_prefers_corrected_cameras(tmp_path, below, corrected):
    folder = tmp_path / below
    files = write_images(folder / "images", NAMES)
    write_polycam(folder / "cameras", 5.0 * corrected)
    if corrected:
        files = write_images(folder / "corrected_images", NAMES)
        write_polycam(folder / "corrected_cameras")
    depths = [folder / "depth" / name for name in NAMES]
    assert_is_read(phones.POLYCAM(tmp_path), "Polycam", "m", files, depths=depths)
    (files[1].parent.parent / ("corrected_cameras" if corrected else "cameras") / "11.json").write_text("{}")
    candidates = phones.POLYCAM(tmp_path).candidates
    assert (
        candidates[1].problem == "its entries cannot be read (KeyError: 't_00')" and not candidates[2].problem
    )
    assert phones.POLYCAM(tmp_path / "nowhere") is None


@pytest.mark.parametrize("below", ["", "EXR_RGBD"])
@pytest.mark.parametrize("each", [0, 2, 3])
def test_record3d_poses_are_indexed_by_image_number(tmp_path, below, each):
    """``each`` images have their own intrinsics; K is column-major."""
    folder = tmp_path / below
    files = write_images(folder / "rgb", ["2.png", "4.png", "10.png"], SIZES)
    poses = [[0, 0, 0, 1, 0, 0, 0]] * 11
    own = [[1, 2, 3, 4, 9.0]] * 11
    for number, n in ((2, 0), (4, 1), (10, 2)):
        E = POSES[n] @ FLIP
        poses[number] = [*quaternion(E), *E[:3, 3].tolist()]
        own[number] = [*numbers(n, 0.5), 9.0]
    entries = {"K": (KS[0] + CORNER).T.ravel().tolist(), "poses": poses, "w": 82, "h": 61}
    entries |= {"perFrameIntrinsicCoeffs": own[: (0, 0, 5, 11)[each]]} if each else {}
    (folder / "metadata.json").write_text(json.dumps(entries))
    depths = [folder / "depth" / f"{file.stem}.exr" for file in files]
    Ks = {0: [KS[0]] * 3, 2: [KS[0], KS[1], KS[0]], 3: KS}[each]
    layout = phones.read_record3d(tmp_path)
    assert_is_read(layout, "Record3D", "m", files, Ks=Ks, sizes=[SIZES[0]] * 3, depths=depths)
    for missing in ("poses", "K"):
        (folder / "metadata.json").write_text(json.dumps({k: v for k, v in entries.items() if k != missing}))
        assert phones.read_record3d(tmp_path) is None
    (folder / "metadata.json").unlink()
    assert phones.read_record3d(tmp_path) is None


def write_video(file, count: int, size=(64, 48)) -> None:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 30, size)
    for n in range(count):
        writer.write(np.full((*size[::-1], 3), 40 * n, np.uint8))
    writer.release()


def test_stray_scanner_rows_are_video_frames(tmp_path):
    write_video(tmp_path / "rgb.mp4", 4)
    (tmp_path / "camera_matrix.csv").write_text("\n".join(words(row, ", ") for row in KS[1]))
    text = "timestamp, frame, X, y, z, qx, qy, qz, qw\n"
    for n, number in enumerate((0, 3, 1)):
        text += f"1.5, {number:06d}, {words([*POSES[n][:3, 3], *quaternion(POSES[n])], ', ')}\n"
    text += "1.5, 000004, 0, 0, 0, 0, 0, 0, 1\n"
    (tmp_path / "odometry.csv").write_text(text)
    (tmp_path / "depth").mkdir()
    for name in ("000000.png", "000003.npy", "000001.png", "000001.npy"):
        (tmp_path / "depth" / name).write_text("x")
    layout = phones.read_stray(tmp_path)
    depths = [tmp_path / "depth" / name for name in ("000000.png", "000003.npy", "000001.png")]
    assert_is_read(
        layout,
        "Stray Scanner",
        "m",
        [tmp_path / "rgb.mp4"] * 3,
        Ks=[KS[1]] * 3,
        sizes=[(64, 48)] * 3,
        depths=depths,
        names=["000000", "000003", "000001"],
    )
    assert [each.frame.index for each in layout.candidates] == [0, 3, 1]
    assert [each.camera.size for each in layout.candidates] == [(64, 48)] * 3
    (tmp_path / "depth" / "000003.npy").unlink()
    assert phones.read_stray(tmp_path).candidates[1].frame.depth is None
    for name in ("rgb.mp4", "odometry.csv"):
        (tmp_path / name).rename(tmp_path / "away")
        assert phones.read_stray(tmp_path) is None
        (tmp_path / "away").rename(tmp_path / name)


@pytest.mark.parametrize("by_columns", [False, True])
def test_scanner_app_matrices_may_be_row_or_column_major(tmp_path, by_columns):
    files = write_images(tmp_path, ["frame_00010.png", "frame_00011.png", "frame_frame.png"])
    write_images(tmp_path, ["other.png"])
    (tmp_path / "other.json").write_text("{}")
    for n, file in enumerate(files):
        E, K = POSES[n] @ FLIP, KS[n] + CORNER
        E, K = (E.T, K.T) if by_columns else (E, K)
        entries = {"cameraPoseARFrame": E.ravel().tolist(), "intrinsics": K.ravel().tolist()}
        file.with_suffix(".json").write_text(json.dumps(entries))
    depths = [tmp_path / name for name in ("depth_00010.png", "depth_00011.png", "depth_frame.png")]
    layout = phones.SCANNER_APP(tmp_path)
    assert_is_read(layout, "3D Scanner App", "m", files, sizes=None, depths=depths)
    files[0].with_suffix(".json").write_text("{}")
    assert phones.SCANNER_APP(tmp_path) is None
    for file in files:
        file.with_suffix(".json").unlink()
    assert phones.SCANNER_APP(tmp_path) is None


@pytest.mark.parametrize("below", [True, False])
def test_arkitscenes_poses_and_cameras_are_matched_by_time(tmp_path, below):
    """Poses are world-to-camera. Camera files have slightly different times, and the nearest one counts."""
    scene = tmp_path / "41069021"
    folder = scene / "41069021_frames" if below else scene
    times = (305.377, 305.477, 305.577)
    files = write_images(folder / "lowres_wide", [f"41069021_{t}.png" for t in times])
    (folder / "lowres_wide_intrinsics").mkdir()
    rows = []
    for n, t in enumerate(times):
        T = np.linalg.inv(POSES[n])
        rows.append(f"{t} {words([*vector(T), *T[:3, 3]])} 7")
        near = folder / "lowres_wide_intrinsics" / f"41069021_{t + 0.03:.3f}.pincam"
        near.write_text(words([*SIZES[n], *numbers(n)]))
    (folder / "lowres_wide.traj").write_text("\n".join(rows))
    depths = [folder / "lowres_depth" / file.name for file in files]
    layout = phones.read_arkitscenes(scene)
    assert_is_read(layout, "ARKitScenes", "m", files, depths=depths)
    (folder / "lowres_wide.traj").unlink()
    assert phones.read_arkitscenes(scene) is None


def test_arkitscenes_time_is_the_last_part_of_the_name(tmp_path):
    assert phones._seconds(tmp_path / "1_2_41069021_305.377.png") == 305.377
