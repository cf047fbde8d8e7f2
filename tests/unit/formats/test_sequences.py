"""Sequences of posed frames: the camera file, and the pose and depth map of each image."""

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import sequences
from tests.unit.formats.calibrated_pair import quaternion, words
from tests.unit.formats.posed_images import (
    KS,
    POSES,
    SIZES,
    assert_is_an_immutable_record,
    assert_is_read,
    numbers,
    write_images,
)
from tests.videos import write_video

SEVEN = np.array([[525.0, 0, 320], [0, 525, 240], [0, 0, 1]])
TUM = np.array([[525.0, 0, 319.5], [0, 525, 239.5], [0, 0, 1]])
VGA = (640, 480)


def write_7scenes(folder):
    files = write_images(folder, [f"frame-0{n}.color.png" for n in range(3)])
    for n, E in enumerate(POSES):
        (folder / f"frame-0{n}.pose.txt").write_text("\n".join(words(row) for row in E))
    return files, {
        "depths": [folder / f"frame-0{n}.depth.png" for n in range(3)],
        "names": [f"frame-0{n}" for n in range(3)],
    }


def matrix(K) -> str:
    whole = np.eye(4)
    whole[:3, :3] = K
    return words(whole)


def info(colour=(KS[1], SIZES[1]), depth=(KS[1], SIZES[1]), shift="1234") -> str:
    lines = ["m_versionNumber = 4", "m_sensorName = Tango"]
    for which, of in (("color", colour), ("depth", depth)):
        if of is not None:
            K, size = of
            lines += [f"m_{which}Width = {size[0]}", f"m_{which}Height = {size[1]}"]
            lines.append(f"m_calibration{which.title()}Intrinsic = {matrix(K)}")
    lines += [f"m_depthShift = {shift}"] if shift else []
    return "\n".join(lines)


def test_seven_scenes_has_one_pose_file_per_image_and_a_published_camera(tmp_path):
    files, expected = write_7scenes(tmp_path)
    layout = sequences.read_tracked(tmp_path)
    camera = {"Ks": [SEVEN] * 3, "sizes": [VGA] * 3, "findings": ["capture.assumed-k"]}
    assert_is_read(layout, "7-Scenes", "m", files, **expected, **camera)
    assert layout.findings[0].startswith("K of 7-Scenes is assumed (525 px")
    lost = POSES[1].copy()
    lost[:3, 3] = np.inf
    (tmp_path / "frame-01.pose.txt").write_text("\n".join(words(row) for row in lost))
    layout = sequences.read_tracked(tmp_path)
    poses = [POSES[0], None, POSES[2]]
    assert_is_read(layout, "7-Scenes", "m", files, **expected, **camera, poses=poses)
    assert sequences.read_tracked(files[0]) is None


@pytest.mark.parametrize(
    ("name", "above", "form"),
    [
        ("calibration.txt", False, "four"),
        ("calibration.txt", True, "matrix"),
        ("intrinsics.txt", True, "matrix"),
        ("camera-intrinsics.txt", False, "matrix"),
        ("K.txt", True, "four"),
        ("intrinsic/intrinsic_color.txt", False, "4x4"),
        ("intrinsic_color.txt", True, "4x4"),
    ],
)
def test_camera_files_override_the_published_camera(tmp_path, above, name, form):
    folder = tmp_path / "seq-01"
    folder.mkdir()
    files, expected = write_7scenes(folder)
    file = (tmp_path if above else folder) / name
    file.parent.mkdir(exist_ok=True)
    file.write_text({"matrix": words(KS[2]), "4x4": matrix(KS[2]), "four": words(numbers(2))}[form])
    layout = sequences.read_tracked(folder)
    assert_is_read(layout, "7-Scenes", "m", files, **expected, Ks=[KS[2]] * 3, sizes=None)
    if above:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(words(KS[0]))
        np.testing.assert_array_equal(sequences.read_tracked(folder).candidates[2].camera.K, KS[0])


@pytest.mark.parametrize(("name", "above"), [("_info.txt", False), ("info.txt", False), ("_info.txt", True)])
def test_scannet_info_file_gives_the_camera_and_depth_unit(tmp_path, name, above):
    folder = tmp_path / "seq-01"
    folder.mkdir()
    files, expected = write_7scenes(folder)
    file = (tmp_path if above else folder) / name
    file.write_text(info())
    (folder / "K.txt").write_text(words(KS[0]))
    camera = {"Ks": [KS[1]] * 3, "sizes": [SIZES[1]] * 3}
    layout = sequences.read_tracked(folder)
    assert_is_read(layout, "7-Scenes", "m", files, **expected, **camera, depth_per_m=1234.0)
    assert_is_an_immutable_record(sequences._info_of(folder))
    file.write_text(info(depth=None, shift=None))
    assert_is_read(sequences.read_tracked(folder), "7-Scenes", "m", files, **expected, **camera)
    file.write_text("m_depthShift = 3\n")  # from another program
    assert sequences.read_tracked(folder).candidates[0].camera.K[0, 0] == KS[0][0, 0]


@pytest.mark.parametrize(
    ("scale", "off", "at", "aligned"),
    [
        (1.0, 0.0, (0, 0), True),
        (0.5, 0.0, (0, 0), True),
        (0.5, 0.015, (1, 1), True),
        (0.5, -0.015, (0, 2), True),
        (0.5, 0.025, (0, 0), False),
        (0.5, 0.025, (1, 1), False),
        (0.5, -0.025, (0, 2), False),
        (0.5, -0.025, (1, 2), False),
    ],
)
def test_depth_maps_from_another_viewpoint_are_ignored(tmp_path, scale, off, at, aligned):
    """Intrinsics are compared relative to the image size, so a half-size depth map is aligned."""
    files, expected = write_7scenes(tmp_path)
    size = (int(SIZES[1][0] * scale), int(SIZES[1][1] * scale))
    depth = np.diag([scale, scale, 1]) @ KS[1]
    depth[at] += off * size[at[0]]
    (tmp_path / "_info.txt").write_text(info(depth=(depth, size)))
    layout = sequences.read_tracked(tmp_path)
    assert [each.frame.depth for each in layout.candidates] == (expected["depths"] if aligned else [None] * 3)
    assert len(files) == 3


def test_scannet_folders_are_read(tmp_path):
    files = write_images(tmp_path / "color", ["8.png", "9.png", "10.png"])
    (tmp_path / "pose").mkdir()
    for file, E in zip(files, POSES, strict=True):
        (tmp_path / "pose" / f"{file.stem}.txt").write_text(words(E))
    depths = [tmp_path / "depth" / f"{file.stem}.png" for file in files]
    assert_is_read(sequences.read_tracked(tmp_path), "ScanNet", "m", files, depths=depths, Ks=None)
    (tmp_path / "pose").rename(tmp_path / "poses")
    assert sequences.read_tracked(tmp_path) is None


@pytest.mark.parametrize("above", [True, False])
def test_replica_has_one_pose_per_line_and_a_shared_camera(tmp_path, above):
    scene = tmp_path / "room0"
    files = write_images(scene / "results", ["frame8.png", "frame9.png", "frame10.png"])
    write_images(scene / "results", ["depth8.png"])
    (scene / "traj.txt").write_text("\n".join(words(E) for E in [*POSES, POSES[0]]))
    depths = [scene / "results" / f"depth{n}.png" for n in (8, 9, 10)]
    bare = {"Ks": None, "depths": depths}
    assert_is_read(sequences.read_replica(scene), "Replica", "m", files, **bare)
    camera = dict(zip(("fx", "fy", "cx", "cy"), numbers(1), strict=True))
    camera |= {"w": SIZES[1][0], "h": SIZES[1][1], "scale": 6553.5}
    params = (tmp_path if above else scene) / "cam_params.json"
    params.write_text(json.dumps({"camera": camera}))
    expected = {"Ks": [KS[1]] * 3, "sizes": [SIZES[1]] * 3, "depths": depths, "depth_per_m": 6553.5}
    assert_is_read(sequences.read_replica(scene), "Replica", "m", files, **expected)
    params.write_text("{")
    with pytest.raises(InputError, match=r"cam_params\.json must be a whole cam_params\.json of Replica"):
        sequences.read_replica(scene)
    (scene / "traj.txt").write_text("\n".join(words(E) for E in POSES[:2]))
    params.unlink()
    with pytest.raises(
        InputError, match=r"\A\S*traj\.txt must be a file with 3 lines, one per image; got 2\."
    ):
        sequences.read_replica(scene)
    (scene / "traj.txt").write_text("1,5 2,5 3,0\n")
    with pytest.raises(InputError, match=r"traj\.txt must be numbers with a decimal point; got .*1,5"):
        sequences.read_replica(scene)
    (scene / "traj.txt").unlink()
    assert sequences.read_replica(scene) is None


TIMES = (17.25, 17.75, 18.5)


def write_tum(folder, head="# ground truth trajectory\n"):
    files = write_images(folder / "rgb", [f"{t}.png" for t in TIMES])
    rows = [
        f"{t + 0.001:.3f} {words([*E[:3, 3], *quaternion(E)])} 9" for t, E in zip(TIMES, POSES, strict=True)
    ]
    (folder / "groundtruth.txt").write_text(head + "\n".join(rows[::-1]))  # out of order
    (folder / "rgb.txt").write_text("seconds name\n" + "".join(f"{t} rgb/{t}.png\n" for t in TIMES))
    depths = (TIMES[0] - 0.04, TIMES[1] + 0.03, TIMES[2] + 0.06, TIMES[1] - 0.04)
    (folder / "depth.txt").write_text("".join(f"{t:.3f} depth/{t:.3f}.png\n" for t in depths))
    return files, [folder / f"depth/{depths[0]:.3f}.png", folder / f"depth/{depths[1]:.3f}.png", None]


def assert_poses_near(layout, atol=0.02):
    """Images precede their poses by a millisecond."""
    for each, E in zip(layout.candidates, POSES, strict=True):
        np.testing.assert_allclose(each.frame.E, E, atol=atol)


def test_tum_lists_may_have_paths_of_windows(tmp_path):
    files, _ = write_tum(tmp_path)
    (tmp_path / "rgb.txt").write_text("\n".join(f"{t} .\\rgb\\{t}.png" for t in TIMES))
    assert [each.frame.image for each in sequences.read_tum(tmp_path).candidates] == files


def test_tum_images_get_the_nearest_pose_and_depth_map(tmp_path):
    files, depths = write_tum(tmp_path)
    layout = sequences.read_tum(tmp_path)
    assert_poses_near(layout)
    assert [each.frame.image for each in layout.candidates] == files
    assert [each.frame.name for each in layout.candidates] == [str(t) for t in TIMES]
    assert [each.frame.depth for each in layout.candidates] == depths
    assert [each.frame.depth_per_m for each in layout.candidates] == [5000.0] * 3
    assert (layout.kind, layout.unit) == ("TUM RGB-D", "m")
    assert [finding.code for finding in layout.findings] == ["capture.assumed-k"]
    for each in layout.candidates:
        np.testing.assert_array_equal(each.camera.K, TUM)
        assert each.camera.size == VGA
    (tmp_path / "depth.txt").unlink()
    assert [each.frame.depth for each in sequences.read_tum(tmp_path).candidates] == [None] * 3
    (tmp_path / "K.txt").write_text(words(KS[2]))
    layout = sequences.read_tum(tmp_path)
    assert not layout.findings and layout.candidates[1].camera.K[0, 0] == KS[2][0, 0]
    (tmp_path / "rgb.txt").rename(tmp_path / "away")
    assert sequences.read_tum(tmp_path) is None
    (tmp_path / "away").rename(tmp_path / "rgb.txt")
    (tmp_path / "groundtruth.txt").unlink()
    assert sequences.read_tum(tmp_path) is None


@pytest.mark.parametrize(
    ("name", "depth_first", "keeps_list"),
    [
        ("associations.txt", True, False),
        ("associated.txt", False, False),
        ("association.txt", True, False),
        ("association.txt", False, True),
    ],
)
def test_tum_associations_pair_images_with_depth_maps(tmp_path, name, depth_first, keeps_list):
    files, depths = write_tum(tmp_path)
    lines = ["seconds rgb seconds depth"]
    for n, t in enumerate(TIMES):
        pair = [f"{t} rgb/{t}.png", f"{t + 0.01:.3f} depth/d{n}.png"]
        lines.append(" ".join(reversed(pair) if depth_first else pair) + " more")
    (tmp_path / name).write_text("\n".join(lines))
    if not keeps_list:
        (tmp_path / "rgb.txt").unlink()
        depths = [tmp_path / f"depth/d{n}.png" for n in range(3)]
    layout = sequences.read_tum(tmp_path)
    assert [each.frame.image for each in layout.candidates] == files
    assert [each.frame.depth for each in layout.candidates] == depths
    assert_poses_near(layout)


@pytest.mark.parametrize(
    ("image", "depth"),
    [
        ("rgb/1.png", "depth/1.png"),
        ("rgb/sub/1.png", "depth/sub/1.png"),
        ("color/1.png", "aligned_depth/1.png"),
        ("color/1.png", "Aligned_Depth_to_color/1.png"),
        ("depth_data/rgb/1.png", "depth_data/depth/1.png"),
        ("1.png", "1_depth.png"),
    ],
)
@pytest.mark.parametrize("depth_first", [False, True])
def test_associated_depth_maps_are_recognised_by_their_paths(tmp_path, image, depth, depth_first):
    names = (depth, image) if depth_first else (image, depth)
    (tmp_path / "associations.txt").write_text("1.0 {} 1.5 {}\n2.0 {} 2.5 {}\n".format(*names, *names))
    images, depths = sequences._associated_names(tmp_path / "associations.txt")
    times = ([1.0, 2.0], [1.5, 2.5])
    assert images == [(t, image) for t in times[depth_first]]
    assert depths == [(t, depth) for t in times[not depth_first]]


#: Published calibrations of the three cameras: fx fy cx cy, and k1 k2 p1 p2 k3.
FREIBURG = {
    1: ([517.3, 516.5, 318.6, 255.3], [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
    2: ([520.9, 521.0, 325.1, 249.7], [0.2312, -0.7849, -0.0033, -0.0001, 0.9172]),
    3: ([535.4, 539.2, 320.1, 247.6], []),
}


@pytest.mark.parametrize(
    ("number", "where"), [(1, "folder"), (2, "rgb.txt"), (3, "groundtruth.txt"), (2, "folder")]
)
def test_tum_camera_is_chosen_by_sequence_name(tmp_path, number, where):
    name = f"rgbd_dataset_Freiburg{number}_xyz"
    folder = tmp_path / (name if where == "folder" else "mine")
    write_tum(folder)
    if where != "folder":
        text = (folder / where).read_text()
        (folder / where).write_text(f"# color images\n# file: '{name}.bag'\n{text}")
    layout = sequences.read_tum(folder)
    (fx, fy, cx, cy), lens = FREIBURG[number]
    for each in layout.candidates:
        np.testing.assert_array_equal(each.camera.K, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        assert each.camera.size == VGA and list(each.camera.coefficients) == lens
    assert not layout.findings


def test_trajectory_poses_are_interpolated():
    """Linear in position and slerp in rotation; just beyond the ends the last pose is held."""
    times = np.array([3.0, 1.0, 1.08, 1.0])
    places = np.array([[9.0, 9, 9], [1, 2, 3], [3, -2, 4], [8, 8, 8]])
    turns = Rotation.from_matrix([POSES[0][:3, :3], POSES[1][:3, :3], POSES[2][:3, :3], POSES[0][:3, :3]])
    pose_at = sequences.TimedPoses(times, places, turns.as_quat())
    between = pose_at(1.02)
    np.testing.assert_allclose(between[:3, 3], 0.75 * places[1] + 0.25 * places[2])
    slerp = Slerp([1.0, 1.08], turns[[1, 2]])
    np.testing.assert_allclose(between[:3, :3], slerp(1.02).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(between[3], [0, 0, 0, 1])
    np.testing.assert_allclose(pose_at(0.96)[:3, 3], places[1])
    np.testing.assert_allclose(pose_at(0.96)[:3, :3], turns[1].as_matrix(), atol=1e-12)
    np.testing.assert_allclose(pose_at(3.04)[:3, :3], turns[0].as_matrix(), atol=1e-12)
    assert pose_at(0.94) is None and pose_at(2.0) is None and pose_at(3.06) is None
    assert pose_at(1.12) is not None and pose_at(1.14) is None


def test_trajectory_files_may_have_a_heading(tmp_path):
    file = tmp_path / "t.txt"
    lines = [f"{t} {words([*E[:3, 3], *quaternion(E)])}" for t, E in zip((1, 2.5, 4), POSES, strict=True)]
    for head in ("", "time x y z qx qy qz qw\n", "# time\n-x y\n"):
        file.write_text(head + "\n".join(lines) + "\n")
        pose_at = sequences.read_trajectory(file)
        for t, E in zip((1, 2.5, 4), POSES, strict=True):
            np.testing.assert_allclose(pose_at(t), E, atol=1e-9)
    signed = "-1.5 0 0 0 0 0 0 1\n+.5e0 1 0 0 0 0 0 1\n"
    file.write_text(signed)
    assert (
        sequences.read_trajectory(file)(0.5)[0, 3] == 1 and sequences.read_trajectory(file)(-1.5)[0, 3] == 0
    )
    file.write_text("1 2 3 4\n")
    with pytest.raises(
        InputError, match=r"t\.txt must be a whole trajectory of lines seconds tx ty tz qx qy qz qw"
    ):
        sequences.read_trajectory(file)


def test_video_frames_take_poses_from_the_trajectory(tmp_path):
    file, trajectory = tmp_path / "v.mp4", tmp_path / "t.txt"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 8, (64, 48))
    for n in range(3):
        writer.write(np.full((48, 64, 3), 40 * n, np.uint8))
    writer.release()
    layout = sequences.read_video(file)
    frames = [each.frame for each in layout.candidates]
    assert [frame.name for frame in frames] == ["000000", "000001", "000002"]
    assert [(frame.index, frame.image, frame.E) for frame in frames] == [(n, file, None) for n in range(3)]
    assert [(each.camera.K, each.camera.size) for each in layout.candidates] == [(None, (64, 48))] * 3
    assert (layout.kind, layout.unit) == ("video", "m")
    assert [finding.code for finding in layout.findings] == ["capture.no-trajectory"]
    lines = [f"{n / 8} {words([*E[:3, 3], *quaternion(E)])}" for n, E in enumerate(POSES)]
    trajectory.write_text("\n".join(lines))
    layout = sequences.read_video(file, trajectory)
    for each, E in zip(layout.candidates, POSES, strict=True):
        np.testing.assert_allclose(each.frame.E, E, atol=1e-9)
    assert not layout.findings
    assert sequences.read_video(tmp_path) is None and sequences.read_video(trajectory) is None


#: Times of frames of a phone, whose rate varies; at their mean rate all but a few are .05 s off or more.
FRAME_TIMES = np.array([0.0, 0.033, 0.066, 0.266, 0.299, 0.499, 0.532, 0.932, 0.965, 1.0])


def slide(file, times) -> None:
    """A trajectory that moves by one metre per second along x."""
    file.write_text("\n".join(f"{t:.6f} {t:.6f} 0 0 0 0 0 1" for t in times))


def test_frames_of_a_variable_rate_have_the_poses_of_their_own_times(tmp_path):
    file = write_video(
        tmp_path / "v.mp4", [np.full((48, 64, 3), 20 * n, np.uint8) for n in range(10)], FRAME_TIMES
    )
    slide(tmp_path / "t.txt", np.arange(0, 1.02, 0.01))
    layout = sequences.read_video(file, tmp_path / "t.txt")
    found = [each.frame.E[0, 3] for each in layout.candidates]
    np.testing.assert_allclose(found, FRAME_TIMES, atol=1e-3)
    assert not layout.findings


def test_a_trajectory_of_other_times_is_reported(tmp_path):
    file = write_video(
        tmp_path / "v.mp4", [np.full((48, 64, 3), 20 * n, np.uint8) for n in range(10)], FRAME_TIMES
    )
    slide(tmp_path / "t.txt", np.arange(0, 0.4, 0.01))
    layout = sequences.read_video(file, tmp_path / "t.txt")
    (finding,) = layout.findings
    assert finding.code == "capture.trajectory-times"
    assert "Only 5 of 10 frames have a pose within 0.05 s. The frames are at 0 to 1 s" in finding
    assert "at 0 to 0.39 s" in finding
    for start, unit, hint in (
        (1.6e9, 1.0, "subtract its first time"),
        (5000.0, 1e3, "in milliseconds. Divide them by 1000"),
        (1.6e15, 1e6, "in microseconds"),
        (1.6e18, 1e9, "in nanoseconds. Divide them by 1e[+]09"),
    ):
        times = np.arange(0, 1.02, 0.01)
        rows = [f"{start + t * unit:.6f} {t:.6f} 0 0 0 0 0 1" for t in times]
        (tmp_path / "t.txt").write_text("\n".join(rows))
        with pytest.raises(InputError, match=rf"times in the video, 0 to 1 s after its first frame.*{hint}"):
            sequences.read_video(file, tmp_path / "t.txt")


@pytest.mark.parametrize("folder", ["", "images", "input"])
def test_plain_image_folders_follow_exif_orientation(tmp_path, folder):
    files = write_images(tmp_path / folder, ["b9.png", "b10.png", "b11.png"])
    layout = sequences.read_unposed_images(tmp_path)
    assert_is_read(layout, "images without poses", None, files, Ks=None, poses=[None] * 3, as_stored=False)
    for file in files:
        file.unlink()
    assert sequences.read_unposed_images(tmp_path) is None


@pytest.mark.parametrize("line", ["1.0 rgb/0.png", "x rgb/1.png 1.0 depth/1.png"])
def test_a_damaged_list_of_associations_is_named_with_what_it_should_be(tmp_path, line):
    file = tmp_path / "associations.txt"
    file.write_text(f"0.5 rgb/0.png 0.5 depth/0.png\n{line}\n")
    with pytest.raises(
        InputError, match=r"associations\.txt.*list of seconds and file names, twice per line"
    ):
        sequences._associated_names(file)
