"""Every reader of captures: a walk is read as its program writes it, and damaged files get a sentence."""

import json
import shutil

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.formats.captures import LAYOUTS, read_capture
from geodiff_plugin.formats.unread import CAPTURES as UNREAD
from geodiff_plugin.jobs.notices import say
from tests.contracts import captures_in_folders, captures_of_fields, captures_of_sfm
from tests.contracts.captures import (
    CENTRAL,
    TRUE,
    Twin,
    bundler,
    euroc,
    images,
    kitti_odometry,
    log,
    metashape,
    nvm,
    opensfm,
    replica,
    scanner_app,
    stray,
    tartanair,
    three_rscan,
)
from tests.contracts.captures import WRITERS as OF_SETS
from tests.contracts.captures_in_folders import colmap_as_binary
from tests.contracts.captures_of_fields import llff, nerf_plus_plus, nerfies, neus, nsvf, sdfstudio, splats
from tests.contracts.captures_of_sfm import alicevision, kapture, openmvg, realityscan
from tests.unit.capture_room import SIZE, K, render

#: Captures in which poses belong to images only by their order, and videos.
BY_ORDER = (tartanair, kitti_odometry, log, stray, replica, llff, neus, nsvf, nerf_plus_plus)
WRITERS = (*OF_SETS, *captures_in_folders.WRITERS, *captures_of_fields.WRITERS, *captures_of_sfm.WRITERS)
#: Of ``K``, the middle that every camera of the walk has.
CENTRE = K[:2, 2]
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
        np.testing.assert_allclose(frame.camera.K, twin.K, atol=1e-6)
        assert frame.size == twin.size and frame.camera.lens is None
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


@pytest.mark.parametrize("write", [tartanair, kitti_odometry, log, llff, nsvf])
def test_an_image_lost_from_what_is_matched_by_order_is_rejected(write, tmp_path):
    twin = write(tmp_path / "scan")
    opened(twin).frames[1].image.unlink()
    with pytest.raises(InputError, match=r"(of|with) (the )?3 (lines|images)|image \(3\)|one per image"):
        opened(twin)


def test_every_layout_has_a_writer_here_or_next_to_its_own_tests():
    others = {"a video", "images"}
    again = {three_rscan, nerf_plus_plus, colmap_as_binary}  # read as 7-Scenes, NSVF and COLMAP's text are
    assert len(LAYOUTS) == len(set(WRITERS) - again) + len(others)


def test_depth_maps_of_another_camera_are_left_out(tmp_path):
    """Those of 3RScan are 224x172 next to images of 960x540."""
    twin = three_rscan(tmp_path / "scan")
    file = twin.path / "_info.txt"
    file.write_text(file.read_text().replace(f"m_depthHeight = {SIZE[1]}", f"m_depthHeight = {SIZE[1] // 2}"))
    assert all(frame.depth is None for frame in opened(twin).frames)
    file.write_text("fps: 30\n")  # of another program: the camera is not known
    assert "capture.assumed-k" in [finding.code for finding in opened(twin).findings]


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
    np.testing.assert_allclose(frame.camera.undistorted_px(taken), straight, atol=0.01)


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
    straight = frame.camera.undistorted_px(focal * m + centre)
    np.testing.assert_allclose(straight, focal * rays + centre, atol=0.02)


def test_a_capture_with_cameras_but_no_poses_is_reported(tmp_path):
    sequence = euroc(tmp_path / "euroc").path
    for ground_truth in sequence.rglob("state_groundtruth*"):
        shutil.rmtree(ground_truth)
    with pytest.raises(InputError, match=r"EuRoC must be with ground truth.*cam0/data with --K"):
        opened(Twin(sequence))
    (tmp_path / "reconstruction.json").write_text("[]")
    with pytest.raises(InputError, match="aligned images"):
        opened(Twin(tmp_path))


#: The beginning of a file of formats that a name alone does not tell.
CONTENTS = {
    "RealityCapture cameras": "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n",
    "a ContextCapture block (BlocksExchange)": '<?xml version="1.0"?>\n<BlocksExchange version="3.2">',
    "an Open3D trajectory": '{"class_name": "PinholeCameraTrajectory", "parameters": []}',
    "ACE0 poses": "rgb/frame-000000.color.png 0.7 0.1 -0.7 0.1 1e-3 2.5 -0.4 525.0 9000\n",
    "a RealEstate10K sequence": "https://www.youtube.com/watch?v=a\n52553 " + "0.5 " * 17 + "0.5\n",
    "Virtual KITTI cameras": "frame cameraID r1,1 r1,2 r1,3 t1\n",
}


def test_formats_recognised_by_content_have_an_example_here():
    assert {each.name for each in UNREAD if each.content} == set(CONTENTS)


@pytest.mark.parametrize("unread", UNREAD, ids=lambda each: f"{each.files}{each.content[:4]}")
def test_a_known_format_that_is_not_read_names_what_converts_it(unread, tmp_path):
    name = unread.files.split()[0].replace("*", "scan")
    (tmp_path / name).write_text(CONTENTS.get(unread.name, "x"))
    with pytest.raises(InputError) as caught:
        read_capture(tmp_path)
    assert unread.name in str(caught.value) and unread.hint in str(caught.value)
    with pytest.raises(InputError, match="PATH must be"):
        read_capture(tmp_path / name)


@pytest.mark.parametrize(
    ("left_out", "said"),
    [
        ("calib.txt", "The most similar format is KITTI odometry, which also has calib.txt"),
        ("groundtruth.txt", "The most similar format is TUM RGB-D, which also has groundtruth.txt"),
        ("odometry.csv", "The most similar format is Stray Scanner, which also has odometry.csv"),
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
    with pytest.raises(
        InputError, match=f"(?s)which contains .*{said}.* a transforms.json, a COLMAP model, "
    ):
        read_capture(tmp_path)
    shutil.move(tmp_path / there[left_out][0], tmp_path / "other")


def test_a_folder_inside_that_is_a_capture_is_proposed(tmp_path):
    metashape(tmp_path / "scan")
    with pytest.raises(InputError, match=r"scan/ looks like .*pass that folder"):
        read_capture(tmp_path)


def test_typed_intrinsics_go_before_those_of_a_file(tmp_path):
    twin = metashape(tmp_path / "scan")
    np.testing.assert_allclose(
        Capture.open(twin.path, fov=60.0).frames[0].camera.K[0, 0], SIZE[0] / 2 / np.tan(np.pi / 6)
    )


def test_two_frames_of_reference_in_one_file_of_metashape_are_not_mixed(tmp_path):
    """Each component has a scale and a frame of its own; the one with most placed cameras is taken."""
    folder = metashape(tmp_path / "scan").path
    text = (folder / "cameras.xml").read_text()
    alone = text.replace('id="3" sensor_id="0" component_id="0"', 'id="3" sensor_id="0" component_id="1"')
    other = '<component id="1"><transform><scale>40</scale></transform></component>'
    (folder / "cameras.xml").write_text(alone.replace('active_id="0">', f'active_id="0">{other}'))
    capture = Capture.open(folder)
    assert len(capture) == 3 and "capture.part" in [finding.code for finding in capture.findings]
    for frame, E in zip(capture.frames, TRUE, strict=False):
        np.testing.assert_allclose(frame.E, E, atol=1e-6)


def bent(x: np.ndarray, y: np.ndarray, radial: tuple[float, ...], p1: float, p2: float) -> np.ndarray:
    """Normalised coordinates behind a lens, as the sources of OpenMVG, AliceVision and Nerfies write it."""
    r2 = x**2 + y**2
    along = 1 + radial[0] * r2 + radial[1] * r2**2 + radial[2] * r2**3
    return np.stack(
        [
            x * along + p2 * (r2 + 2 * x**2) + 2 * p1 * x * y,
            y * along + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ],
        axis=1,
    )


@pytest.mark.parametrize(
    ("write", "old", "new"),
    [
        (openmvg, '"disto_t2": [0.0, 0.0, 0.0, 0.0, 0.0]', '"disto_t2": [0.1, -0.02, 0.03, 0.01, -0.02]'),
        (
            alicevision,
            '"type": "radial3"',
            '"type": "brown", "distortionParams": [0.1, -0.02, 0.03, 0.01, -0.02], "x": 0',
        ),
        (
            nerfies,
            '"radial_distortion": [0.0, 0.0, 0.0], "tangential_distortion": [0.0, 0.0]',
            '"radial_distortion": [0.1, -0.02, 0.03], "tangential_distortion": [0.01, -0.02]',
        ),
    ],
    ids=["openmvg", "alicevision", "nerfies"],
)
def test_lenses_distort_as_in_their_programs(write, old, new, tmp_path):
    twin = write(tmp_path / "scan")
    for file in [twin.path / twin.file, *twin.path.glob("camera/*")]:
        text = file.read_text().replace('"distortionParams": ["0", "0", "0"], ', "")
        file.write_text(text.replace(old, new))
    frame = opened(twin).frames[0]
    x, y = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 40))
    focal, centre = np.diag(frame.camera.K)[:2], frame.camera.K[:2, 2]
    taken = bent(x, y, (0.1, -0.02, 0.03), 0.01, -0.02) * focal + centre
    straight = np.stack([x, y], axis=1) * focal + centre
    np.testing.assert_allclose(frame.camera.undistorted_px(taken), straight, atol=0.01)


@pytest.mark.parametrize(
    ("version", "entries", "expected"),
    [
        (["1", "1", "0"], {"pxFocalLength": "210", "principalPoint": ["118", "91"]}, (210.0, 210.0)),
        (["1", "2", "1"], {"pxFocalLength": ["210", "205"]}, (210.0, 205.0)),
        (["1", "2", "3"], {"focalLength": "5.6", "pixelRatio": "1.25"}, (210.0, 168.0)),
        (["1", "2", "6"], {"focalLength": "5.6", "pixelRatio": "1.25"}, (210.0, 262.5)),
        (["1", "2", "11"], {"focalLength": "5.6", "pixelRatio": "1.25"}, (168.0, 210.0)),
    ],
)
def test_focal_lengths_of_alicevision_are_those_of_its_version(version, entries, expected, tmp_path):
    twin = alicevision(tmp_path / "scan")
    data = json.loads((twin.path / "cameras.sfm").read_text())
    data["version"] = version
    camera = {key: value for key, value in data["intrinsics"][0].items() if key != "pixelRatio"}
    data["intrinsics"] = [camera | entries]
    (twin.path / "cameras.sfm").write_text(json.dumps(data))
    K = opened(twin).frames[0].camera.K
    np.testing.assert_allclose((K[0, 0], K[1, 1]), expected, rtol=1e-9)
    np.testing.assert_allclose(K[:2, 2], CENTRE, atol=1e-6)


def test_an_upright_camera_of_alicevision_is_rejected_with_a_converter(tmp_path):
    twin = alicevision(tmp_path / "scan")
    text = (twin.path / "cameras.sfm").read_text()
    upright = text.replace(f'"width": "{SIZE[0]}"', '"width": "90"')
    (twin.path / "cameras.sfm").write_text(upright)
    with pytest.raises(InputError, match="a landscape image.*aliceVision_exportColmap"):
        opened(twin)


def test_row_and_column_order_of_3d_scanner_app_matrices_is_detected(tmp_path):
    twin = scanner_app(tmp_path / "scan")
    for file in twin.path.glob("*.json"):
        entries = json.loads(file.read_text())
        entries["cameraPoseARFrame"] = np.reshape(entries["cameraPoseARFrame"], (4, 4)).T.ravel().tolist()
        entries["intrinsics"] = np.reshape(entries["intrinsics"], (3, 3)).T.ravel().tolist()
        file.write_text(json.dumps(entries))
    for frame, E in zip(opened(twin).frames, TRUE, strict=True):
        np.testing.assert_allclose(frame.E, E, atol=1e-6)
        np.testing.assert_allclose(frame.camera.K, K, atol=1e-6)


def test_unread_poses_next_to_images_are_reported(tmp_path):
    folder = splats(tmp_path / "scan").path.parent
    findings = read_capture(folder, fov=60.0)[3]
    assert [finding.code for finding in findings] == ["capture.unused-poses"]
    assert "output/ looks like 3D Gaussian splatting; pass that folder" in findings[0]
    (folder / "output" / "cameras.json").rename(folder / "sfm_data.bin")
    (finding,) = read_capture(folder, fov=60.0)[3]
    assert "sfm_data.bin is an OpenMVG reconstruction" in finding
    (folder / "sfm_data.bin").unlink()
    assert not read_capture(folder, fov=60.0)[3]


@pytest.mark.parametrize(
    ("file", "said"), [("transforms.json", "a transforms.json"), ("sparse/0/cameras.txt", "a COLMAP model")]
)
def test_for_a_folder_of_images_inside_a_capture_the_parent_folder_is_reported(file, said, tmp_path):
    images = splats(tmp_path / "scan").path.parent / "images"
    assert not read_capture(images, fov=60.0)[3]
    model = images.parent / file
    model.parent.mkdir(parents=True, exist_ok=True)
    model.write_text("")
    model.with_name("images.txt").write_text("")
    (finding,) = read_capture(images, fov=60.0)[3]
    assert finding.code == "capture.unused-poses"
    assert f"The parent folder {images.parent.name}/ looks like {said}; pass that folder." in finding


def test_folders_of_a_rig_are_sent_to_the_command_for_pairs(tmp_path):
    for side in ("Left", "right"):
        images(tmp_path / side, [f"{i}.png" for i in range(4)])
    with pytest.raises(InputError, match="rig, use geodiff depth with Left/, right/ and --calib"):
        read_capture(tmp_path)


def test_frames_without_a_focal_length_share_one_reason(tmp_path):
    images = splats(tmp_path / "scan").path.parent / "images"
    with pytest.raises(InputError, match="two frames; got 0") as refused:
        read_capture(images)
    assert str(refused.value).count("no focal length in its EXIF") == 1


def test_a_file_written_before_alignment_is_reported(tmp_path):
    twin = openmvg(tmp_path / "scan")
    (twin.path / "sfm_data_final.json").unlink()
    frames, _, unit, findings = read_capture(twin.path)
    assert unit is None and all(frame.E is None for frame in frames)
    assert [finding.code for finding in findings] == ["capture.no-poses"]


@pytest.mark.parametrize("side", [-1, -2, 0.5])
def test_images_of_nearly_the_size_of_their_cameras_are_doubted(side, tmp_path):
    """COLMAP's undistorter changes sizes by few pixels; smaller copies have half the sides."""
    folder = splats(tmp_path / "scan").path
    text = (folder / "cameras.json").read_text()
    for name, pixels in zip(("width", "height"), SIZE, strict=True):
        other = 2 * pixels if side == 0.5 else pixels - side
        text = text.replace(f'"{name}": {pixels}', f'"{name}": {other}')
    (folder / "cameras.json").write_text(text)
    said = [(each.code, each.is_reason) for each in Capture.open(folder).findings]
    assert said == [("capture.size-mismatch", True)] * (side == -2)


def test_what_a_failed_download_left_is_named_whatever_its_format(tmp_path):
    (tmp_path / "model.nvm").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n")
    with pytest.raises(InputError, match=r"Git LFS pointer\. Download the file with"):
        read_capture(tmp_path / "model.nvm")


def test_bundler_finds_its_list_where_its_script_keeps_it_or_asks_for_it(tmp_path):
    twin = bundler(tmp_path / "scan")
    (twin.path / "prepare").mkdir()
    shutil.move(twin.path / "list.txt", twin.path / "prepare" / "list.txt")
    assert len(opened(twin)) == 4
    (twin.path / "prepare" / "list.txt").unlink()
    with pytest.raises(InputError, match="with its list of images.*one name per line"):
        opened(twin)


#: The name of the second image in the file of a twin.
SECOND = {
    splats: ("cameras.json", "DSC_1"),
    sdfstudio: ("meta_data.json", "000001_rgb.png"),
    kapture: ("sensors/records_camera.txt", "walk one/001.png"),
    openmvg: ("sfm_data_final.json", "M_1.png"),
    alicevision: ("cameras.sfm", "D:/set/A_1.png"),
}
HOSTILE = (
    *("../../../../../../etc/passwd", "/dev/zero", "a\0b.png", "x" * 5000, "a/" * 3000, "..", ""),
    "\x1b[2J.png",
)


@pytest.mark.parametrize("write", SECOND, ids=lambda write: write.__name__)
@pytest.mark.parametrize("name", HOSTILE, ids=[name[:6] for name in HOSTILE])
def test_a_hostile_name_leaves_out_its_frame_alone(write, name, tmp_path, capsys):
    twin = write(tmp_path / "scan")
    file, second = twin.path / SECOND[write][0], SECOND[write][1]
    typed = json.dumps(name)[1:-1] if file.suffix != ".txt" else name
    text = file.read_text()
    assert second in text
    file.write_text(text.replace(second, typed, 1))
    if "\0" in typed:  # no text
        with pytest.raises(InputError, match="binary data"):
            opened(twin)
        return
    capture = opened(twin)
    assert len(capture) == 3
    for frame, E in zip(capture.frames, np.delete(TRUE, 1, axis=0), strict=True):
        np.testing.assert_allclose(frame.E, E, atol=1e-6)
        assert frame.image.resolve().is_relative_to((tmp_path / "scan").resolve())
    for finding in capture.findings:
        say(finding)
    assert all(line.isprintable() and len(line) < 1000 for line in capsys.readouterr().err.splitlines())


def test_distorted_images_do_not_stand_in_for_the_undistorted_ones_of_opensfm(tmp_path):
    folder = opensfm(tmp_path / "scan").path
    (folder / "undistorted").mkdir()
    shutil.copytree(folder / "images", folder / "undistorted" / "images")
    for image in list((folder / "undistorted" / "images").iterdir()):
        image.rename(image.with_name(f"{image.name}.png"))  # as OpenSfM names them
    shutil.copy(folder / "reconstruction.json", folder / "undistorted")
    frames = Capture.open(folder / "undistorted").frames
    assert {frame.image.parent for frame in frames} == {folder / "undistorted" / "images"}
    shutil.rmtree(folder / "undistorted" / "images")
    with pytest.raises(InputError, match="no image file"):
        Capture.open(folder / "undistorted")


def test_realityscan_counts_tangential_coefficients_the_other_way_round(tmp_path):
    """x' = x (1 + k1 r2 + ...) + t1 (r2 + 2 x2) + 2 t2 x y, of its description: t2, t1 are p1, p2."""
    twin = realityscan(tmp_path / "scan")
    for file in twin.path.glob("*.xmp"):
        text = file.read_text().replace("perspective", "brown3t2")
        file.write_text(text.replace(">0 0 0 0 0 0<", ">0.1 -0.02 0.03 0 -0.02 0.01<"))
    frame = opened(twin).frames[0]
    x, y = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 40))
    focal, centre = np.diag(frame.camera.K)[:2], frame.camera.K[:2, 2]
    taken = bent(x, y, (0.1, -0.02, 0.03), p1=0.01, p2=-0.02) * focal + centre
    straight = np.stack([x, y], axis=1) * focal + centre
    np.testing.assert_allclose(frame.camera.undistorted_px(taken), straight, atol=0.01)
    for file in twin.path.glob("*.xmp"):
        file.write_text(file.read_text().replace("brown3t2", "division"))
    with pytest.raises(InputError, match="a lens of RealityScan.*undistorted images"):
        opened(twin)


def test_other_sidecars_are_no_poses_and_the_largest_component_is_taken(tmp_path):
    twin = realityscan(tmp_path / "scan")
    files = sorted(twin.path.glob("*.xmp"))
    files[0].write_text(files[0].read_text().replace('xcr:Skew="0"', 'xcr:Skew="0" xcr:ComponentId="{B}"'))
    capture = opened(twin)
    assert len(capture) == 3 and [finding.code for finding in capture.findings] == ["capture.part"]
    np.testing.assert_allclose(capture.frames[0].E, TRUE[1], atol=1e-6)
    for file in files:
        file.write_text('<x:xmpmeta xmlns:x="adobe:ns:meta/"></x:xmpmeta>')
    assert read_capture(twin.path, fov=60.0)[1] == "images without poses"
