"""Every reader of captures: a walk is read as its program writes it, and damaged files get a sentence."""

import shutil

import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.formats.captures import LAYOUTS, read_capture
from geodiff_plugin.formats.lenses import undistorted_pixels
from geodiff_plugin.formats.unknown import FOREIGN
from tests.contracts.captures import (
    CENTRAL,
    TRUE,
    WRITERS,
    Twin,
    euroc,
    kitti_odometry,
    log,
    metashape,
    nvm,
    replica,
    stray,
    tartanair,
    three_rscan,
)
from tests.unit.capture_room import SIZE, K, render

#: Where the order of the images is all that tells which pose is whose, and where they are a video.
BY_ORDER = (tartanair, kitti_odometry, log, stray, replica)
NAMES = [write.__name__ for write in WRITERS]


def opened(twin: Twin) -> Capture:
    return Capture.open(twin.path, K=twin.typed)


@pytest.mark.parametrize("write", WRITERS, ids=NAMES)
def test_a_walk_is_read_as_it_was_written(write, tmp_path):
    twin = write(tmp_path / "scan")
    capture = opened(twin)
    assert len(capture) == 4 and capture.unit == twin.unit
    for name, frame, E in zip(capture.names, capture.frames, TRUE, strict=True):
        np.testing.assert_allclose(frame.E, E, atol=1e-6)
        np.testing.assert_allclose(frame.K, twin.K, atol=1e-6)
        assert frame.size == twin.size and frame.lens is None
        off = [
            np.abs(capture.image(name) - render(other, twin.size, twin.K)[0] / 255).mean() for other in TRUE
        ]
        assert off.index(min(off)) == capture.names.index(name)
        assert min(off) < (0.1 if frame.index is not None else 1e-6)  # a video of so few frames is coarse
        if twin.has_depth:
            depth, known = capture.measured_depth(name)
            np.testing.assert_allclose(depth[known], render(E, twin.size, twin.K)[1][known], atol=1e-3)
            assert known.all()


@pytest.mark.parametrize("write", [write for write in WRITERS if write not in BY_ORDER])
def test_a_lost_image_leaves_out_its_frame_alone(write, tmp_path):
    twin = write(tmp_path / "scan")
    frames = opened(twin).frames
    frames[1].image.unlink()
    left = opened(twin)
    assert [frame.image for frame in left.frames] == [frames[i].image for i in (0, 2, 3)]
    np.testing.assert_allclose(left.frames[1].E, TRUE[2], atol=1e-6)


@pytest.mark.parametrize("write", [tartanair, kitti_odometry, log])
def test_an_image_lost_from_what_is_matched_by_order_is_refused(write, tmp_path):
    twin = write(tmp_path / "scan")
    opened(twin).frames[1].image.unlink()
    with pytest.raises(InputError, match="of (the )?3 (lines|images)"):
        opened(twin)


def test_every_layout_has_a_twin_here_or_beside_its_own_tests():
    others = {"a transforms.json", "a COLMAP model", "7-Scenes", "ScanNet", "TUM RGB-D", "a video", "images"}
    again = {three_rscan}  # read as 7-Scenes are
    assert len(LAYOUTS) == len(set(WRITERS) - again) + len(others)


def test_depth_maps_of_another_camera_are_left_out(tmp_path):
    """Those of 3RScan are 224x172 beside images of 960x540."""
    twin = three_rscan(tmp_path / "scan")
    file = twin.path / "_info.txt"
    file.write_text(file.read_text().replace(f"m_depthHeight = {SIZE[1]}", f"m_depthHeight = {SIZE[1] // 2}"))
    assert all(frame.depth is None for frame in opened(twin).frames)
    file.write_text("fps: 30\n")  # of another program: the camera is not known
    assert "capture.assumed-k" in [note.code for note in opened(twin).notes]


def test_metashape_bends_a_lens_by_its_own_formula(tmp_path):
    """x' = x (1 + K1 r2 + K2 r4) + P1 (r2 + 2 x2) + 2 P2 x y, of its manual: P1 and P2 are not OpenCV's."""
    folder = metashape(tmp_path / "scan").path
    k1, k2, p1, p2 = 0.1, -0.02, 0.01, -0.02
    lens = f"<k1>{k1}</k1><k2>{k2}</k2><p1>{p1}</p1><p2>{p2}</p2><b1>"
    text = (folder / "cameras.xml").read_text()
    (folder / "cameras.xml").write_text(text.replace("<b1>", lens))
    frame = Capture.open(folder).frames[0]
    x, y = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 40))
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2
    bent_x = x * radial + p1 * (r2 + 2 * x**2) + 2 * p2 * x * y
    bent_y = y * radial + p2 * (r2 + 2 * y**2) + 2 * p1 * x * y
    taken = np.stack([K[0, 0] * bent_x + K[0, 2], K[1, 1] * bent_y + K[1, 2]], axis=1)
    straight = np.stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]], axis=1)
    np.testing.assert_allclose(undistorted_pixels(taken, frame.K, frame.lens), straight, atol=0.01)


def test_metashape_terms_that_opencv_does_not_have_leave_out_their_sensor(tmp_path):
    folder = metashape(tmp_path / "scan").path
    text = (folder / "cameras.xml").read_text()
    (folder / "cameras.xml").write_text(text.replace("<b1>", "<k4>0.1</k4><b1>"))
    with pytest.raises(InputError, match="without k4.*Undistort in Metashape"):
        Capture.open(folder)


def test_visualsfm_straightens_by_its_own_formula(tmp_path):
    """A pixel at radius m in focal lengths belongs to the ray at m (1 + k m^2)."""
    folder, k = nvm(tmp_path / "scan").path, 0.04
    text = (folder / "model.nvm").read_text()
    (folder / "model.nvm").write_text(text.replace(" 0 0\n", f" {k} 0\n"))
    frame = Capture.open(folder).frames[0]
    m = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 2))
    rays = m * (1 + k * (m**2).sum(1, keepdims=True))
    focal, centre = CENTRAL[0, 0], CENTRAL[:2, 2]
    straight = undistorted_pixels(focal * m + centre, frame.K, frame.lens)
    np.testing.assert_allclose(straight, focal * rays + centre, atol=0.02)


def test_what_has_cameras_but_no_poses_says_so(tmp_path):
    sequence = euroc(tmp_path / "euroc").path
    for truth in sequence.rglob("state_groundtruth*"):
        shutil.rmtree(truth)
    with pytest.raises(InputError, match=r"EuRoC must be with ground truth.*cam0/data with --K"):
        opened(Twin(sequence))
    (tmp_path / "reconstruction.json").write_text("[]")
    with pytest.raises(InputError, match="images that were placed"):
        opened(Twin(tmp_path))


@pytest.mark.parametrize("foreign", FOREIGN, ids=lambda each: each.marks[0])
def test_a_known_format_that_is_not_read_names_what_converts_it(foreign, tmp_path):
    name = foreign.marks[0].replace("*", "scan")
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(InputError) as caught:
        read_capture(tmp_path)
    assert foreign.name in str(caught.value) and foreign.cure in str(caught.value)
    with pytest.raises(InputError, match="PATH must be"):
        read_capture(tmp_path / name)


@pytest.mark.parametrize(
    ("left_out", "said"),
    [
        ("calib.txt", "Nearest is KITTI odometry, which also has calib.txt"),
        ("groundtruth.txt", "Nearest is TUM RGB-D, which also has groundtruth.txt"),
        ("odometry.csv", "Nearest is Stray Scanner, which also has odometry.csv"),
    ],
)
def test_a_folder_that_nothing_recognises_is_described_and_the_nearest_named(left_out, said, tmp_path):
    there = {
        "calib.txt": ["image_2/", "poses.txt"],
        "groundtruth.txt": ["rgb.txt"],
        "odometry.csv": ["camera_matrix.csv", "rgb.mp4"],
    }
    for name in there[left_out]:
        (tmp_path / name).mkdir() if name.endswith("/") else (tmp_path / name).write_text("x")
    with pytest.raises(InputError, match=f"(?s)a transforms.json, a COLMAP model, .*it holds .*{said}"):
        read_capture(tmp_path)
    shutil.move(tmp_path / there[left_out][0], tmp_path / "other")


def test_a_folder_inside_that_is_a_capture_is_proposed(tmp_path):
    metashape(tmp_path / "scan")
    with pytest.raises(InputError, match=r"scan/ looks like .*give that folder"):
        read_capture(tmp_path)


def test_typed_intrinsics_go_before_those_of_a_file(tmp_path):
    twin = metashape(tmp_path / "scan")
    np.testing.assert_allclose(
        Capture.open(twin.path, fov=60.0).frames[0].K[0, 0], SIZE[0] / 2 / np.tan(np.pi / 6)
    )
