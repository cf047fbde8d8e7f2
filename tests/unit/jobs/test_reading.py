"""The files of a pair become images and a guidance: each view with its own image, camera and pose."""

import contextlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from geodiff_plugin._internal.checks import InputError, InputFileError, UnknownPoseError
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.findings import Finding
from geodiff_plugin.jobs import reading
from geodiff_plugin.jobs.cameras import read_cameras
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef
from geodiff_plugin.jobs.reading import read_pair
from tests.unit.formats.test_frame_packing import packed
from tests.unit.jobs.pair_files import BARE, ES, KS, LENSES, NAMES, NUMBERS, SIZES, image_of, options
from tests.unit.jobs.test_masks import rig_video


def test_every_view_has_its_own_image_camera_and_pose(files):
    pair = read_pair(options(files, "third", "fourth", parameter=("planes=99",), preset="fast"))
    guidance = pair.guidance
    np.testing.assert_allclose(guidance.inputs[0].left.K, KS[0])
    assert len(guidance.rigs) == 3
    for number, (rig, right) in enumerate(zip(guidance.rigs, guidance.rights, strict=True), 1):
        np.testing.assert_allclose(rig.K_left, KS[0])
        np.testing.assert_allclose(rig.K_right, KS[number])
        np.testing.assert_allclose(rig.E, ES[number], atol=1e-12)
        np.testing.assert_allclose(right.permute(1, 2, 0), image_of(files, NAMES[number]), atol=1e-6)
    np.testing.assert_allclose(pair.left, image_of(files, "left"), atol=1e-6)
    assert (pair.rig.size_left, pair.rig.size_right) == SIZES[:2]
    assert pair.rig.source == str(files / "K-left.txt") and not pair.rig.measured
    assert not guidance.measured_baseline and guidance.unit == "m"
    assert (guidance.config.planes, guidance.config.pose) == (99, "given")
    assert guidance.findings == [] and not pair.undistorted and pair.prior_map is None


def test_what_is_not_given_of_a_view_is_that_of_the_left_one(files, tmp_path):
    np.save(tmp_path / "parallel.npy", np.eye(4) + 0.1 * np.eye(4, k=3))
    given = options(files, "third", k_right=None, view_k=(), e=tmp_path / "parallel.npy")
    pair = read_pair(given)
    for rig in pair.guidance.rigs:
        np.testing.assert_allclose(rig.K_right, KS[0])
    assert [each.code for each in pair.guidance.findings] == ["camera.assumed-cx"]
    pair = read_pair(replace(given, k_right=files / "K-left.txt"))
    assert pair.guidance.findings == [], "it is given, and the same"


def test_missing_numbers_are_filled_in_and_reported(files):
    (width, height), pair = SIZES[0], read_pair(options(files, **NUMBERS))
    K = pair.guidance.inputs[0].left.K
    expected = np.array([[50.0, 0, (width - 1) / 2], [0, 50.0, (height - 1) / 2], [0, 0, 1]])
    np.testing.assert_allclose(K, expected)
    np.testing.assert_allclose(pair.rig.K_right, expected)
    np.testing.assert_allclose(pair.rig.E, np.eye(4) + 0.12 * np.eye(4, k=3))
    said = " ".join(pair.guidance.findings)
    assert "fy is assumed equal to fx; cx and cy are assumed at the image centre" in said
    assert "with --fy, --cx, --cy." in said and pair.guidance.measured_baseline
    given = {"fy": 46.0, "cx": 25.0, "cy": 18.0, "cx_right": 28.0}
    pair = read_pair(options(files, **NUMBERS, **given))
    np.testing.assert_allclose(pair.rig.K_left, [[50, 0, 25], [0, 46, 18], [0, 0, 1]])
    np.testing.assert_allclose(pair.rig.K_right, [[50, 0, 28], [0, 46, 18], [0, 0, 1]])
    assert pair.guidance.findings == []
    pair = read_pair(options(files, **NUMBERS, cx=25.0, fy=46.0))
    assert "cy is assumed at the image centre. Pass calibrated values with --cy." in " ".join(
        pair.guidance.findings
    )


def test_known_depths_alone_need_one_camera(files, tmp_path):
    np.save(tmp_path / "points.npy", np.array([[0.1, 0.2, 2.5], [0.0, -0.1, 3000.0]]))
    np.save(tmp_path / "sure.npy", np.array([0.25, 0.75]))
    alone = {"right": None, "k_right": None, "e": None, "points": tmp_path / "points.npy"}
    pair = read_pair(options(files, **alone, points_scale=1000.0, points_confidence=tmp_path / "sure.npy"))
    assert pair.guidance.rights == [] and pair.rig.size_right is None
    np.testing.assert_allclose(pair.rig.E, np.eye(4))
    points = pair.guidance.inputs[0].points.numpy()
    np.testing.assert_allclose(points[:, :3] * 1000, [[0.1, 0.2, 2.5], [0.0, -0.1, 3000.0]], rtol=1e-6)
    np.testing.assert_allclose(points[:, 3], [0.25, 0.75])
    np.testing.assert_allclose(pair.guidance.inputs[0].left.K, KS[0])
    by_numbers = read_pair(options(files, **alone | {"k": None}, fx=50.0))
    np.testing.assert_allclose(by_numbers.rig.E, np.eye(4))
    outside = np.array([[50.0, 0, 90], [0, 50, 19], [0, 0, 1]])
    np.savetxt(tmp_path / "K.txt", outside)
    with pytest.raises(InputError, match="K "):
        read_pair(options(files, **alone | {"k": tmp_path / "K.txt"}))
    read_pair(options(files, **alone | {"k": tmp_path / "K.txt"}, cropped=True))


def test_one_camera_info_is_enough_for_points_of_a_left_image_alone(files, tmp_path):
    np.save(tmp_path / "points.npy", np.array([[0.1, 0.2, 2.5], [0.0, -0.1, 3.0]]))
    height, width = image_of(files, "left").shape[:2]
    K = np.loadtxt(files / "K-left.txt")
    entries = {"width": width, "height": height, "distortion_model": "plumb_bob", "K": K.ravel().tolist()}
    entries |= {"D": [-0.1, 0.02, 0, 0, 0], "R": np.eye(3).ravel().tolist(), "P": [0.0] * 12}
    (tmp_path / "left.yaml").write_text(yaml.safe_dump(entries))
    alone = {"right": None, "k": None, "k_right": None, "e": None, "points": tmp_path / "points.npy"}
    pair = read_pair(options(files, **alone, calib=(tmp_path / "left.yaml",)))
    np.testing.assert_allclose(pair.rig.K_left, K)
    assert pair.undistorted and len(pair.cameras) == 1 and not pair.guidance.rights


def test_images_are_undistorted_by_the_lens_of_each_view(files):
    first, second, third = LENSES
    pair = read_pair(
        options(
            files,
            "third",
            "fourth",
            distortion=(first, second),
            view_distortion=(third, "0,0,0,0"),
            parameter=("clean_images=false",),
        )
    )
    assert pair.undistorted
    found = [pair.left, *(right.permute(1, 2, 0).numpy() for right in pair.guidance.rights)]
    for number, (image, lens) in enumerate(zip(found, (first, second, third, None), strict=True)):
        taken = image_of(files, NAMES[number])
        if lens is None:
            np.testing.assert_allclose(image, taken, atol=1e-6)
            continue
        numbers = np.array(lens.rpartition(":")[2].split(","), float)
        height, width = taken.shape[:2]
        v, u = np.mgrid[:height, :width]
        rays = np.stack([u, v, np.ones(u.shape)], -1) @ np.linalg.inv(KS[number]).T
        if lens.startswith("fisheye"):
            flat = np.ascontiguousarray(rays[..., :2].reshape(-1, 1, 2))
            at = cv2.fisheye.distortPoints(flat, KS[number], numbers)
        else:
            at, _ = cv2.projectPoints(rays.reshape(-1, 3), np.zeros(3), np.zeros(3), KS[number], numbers)
        at = at.reshape(height, width, 2).astype(np.float32)
        expected = cv2.remap(taken, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        inside = (at >= 1).all(-1) & (at[..., 0] < width - 2) & (at[..., 1] < height - 2)
        assert np.abs(expected - taken)[inside].max() > 0.02
        np.testing.assert_allclose(image[inside], expected[inside], atol=0.02)


@pytest.fixture
def estimated(monkeypatch):
    """The arguments with which cameras would be estimated."""
    calls = []

    def from_unposed_images(images, **given):
        calls.append((images, given))
        views = zip(images, given["K"], ES, strict=False)
        return GeometryGuidance.from_views(list(views))

    monkeypatch.setattr(reading.GeometryGuidance, "from_unposed_images", from_unposed_images)
    return calls


def test_a_pose_that_is_not_found_names_exif(files, monkeypatch):
    def fails(*views, **given):
        raise UnknownPoseError("No pose.")

    monkeypatch.setattr(reading.GeometryGuidance, "from_unposed_images", fails)
    finding = Finding("camera.from-exif", "K of a.jpg: 26 mm.")
    monkeypatch.setattr(
        reading, "read_cameras", lambda *given: replace(read_cameras(*given), findings=(finding,))
    )
    base = {"e": None, "view_e": (), "estimate_pose": True}
    with pytest.raises(UnknownPoseError, match=r"\ANo pose\. K of a.jpg: 26 mm\. EXIF is outdated"):
        read_pair(options(files, "third", **base, baseline=0.25))


def test_cameras_of_images_without_poses_are_those_that_are_given(files, estimated, tmp_path):
    base = {"e": None, "view_e": (), "estimate_pose": True}
    pair = read_pair(options(files, "third", "fourth", **base, baseline=0.25, cropped=True))
    (images, given), *_ = estimated
    for image, name in zip(images, NAMES, strict=True):
        np.testing.assert_allclose(image, image_of(files, name), atol=1e-6)
    np.testing.assert_allclose(given["K"][0], KS[0])
    for K, expected in zip(given["K"][1:], KS[1:], strict=True):
        np.testing.assert_allclose(K, expected)
    assert (given["baseline_m"], given["known_length"], given["cropped"]) == (0.25, None, True)
    assert given["points"] is None and given["config"].planes == 160
    assert (pair.rig.size_left, pair.rig.size_right, pair.rig.source) == (*SIZES[:2], "estimated")

    read_pair(options(files, "third", **base | {"view_k": (), "k_right": None}, known_length="1,2,3,4,5"))
    _, given = estimated[-1]
    np.testing.assert_allclose(given["K"], [KS[0]] * 3)
    assert given["known_length"] == (1.0, 2.0, 3.0, 4.0, 5.0)

    read_pair(options(files, "third", **base | BARE | {"view_k": ()}, fov=70.0))
    _, given = estimated[-1]
    for K, (width, height) in zip(given["K"], SIZES, strict=False):
        assert 2 * np.degrees(np.arctan(width / 2 / K[0, 0])) == pytest.approx(70.0)
        np.testing.assert_allclose(K[:2, 2], [(width - 1) / 2, (height - 1) / 2])

    pair = read_pair(options(files, **base | BARE | {"view_k": ()}, fx=50.0, cy=18.0))
    _, given = estimated[-1]
    np.testing.assert_allclose(given["K"][1], [[50, 0, 29.5], [0, 50, 18], [0, 0, 1]])
    assert [each.code for each in pair.guidance.findings].count("camera.assumed-intrinsics") == 1

    exif = Image.Exif()
    exif[0x8769] = {0xA405: 35}  # focal length in 35 mm equivalent
    for name in NAMES[:2]:
        Image.open(files / f"{name}.png").save(tmp_path / f"{name}.png", exif=exif)
    paths = {name: tmp_path / f"{name}.png" for name in NAMES[:2]}
    pair = read_pair(options(files, **base | BARE | paths | {"view_k": ()}))
    _, given = estimated[-1]
    for K, (width, height) in zip(given["K"], SIZES, strict=False):
        assert K[0, 0] == pytest.approx(35 * np.hypot(width, height) / np.hypot(36, 24), rel=1e-6)
    assert [each.code for each in pair.guidance.findings].count("camera.from-exif") == 2


def test_views_that_are_no_files_take_the_place_of_the_images(files):
    frames = [image_of(files, "fourth"), image_of(files, "third")]
    pair = read_pair(options(files), frames)
    np.testing.assert_array_equal(pair.left, frames[0])
    np.testing.assert_allclose(pair.guidance.rights[0].permute(1, 2, 0), frames[1], atol=1e-6)
    assert (pair.rig.size_left, pair.rig.size_right) == (SIZES[3], SIZES[2])


def test_both_halves_of_one_image_are_left_and_right(files, tmp_path):
    left = image_of(files, "left")
    both = np.concatenate([left, left[::-1]], axis=1)
    Image.fromarray(np.rint(both * 255).astype(np.uint8)).save(tmp_path / "both.png")
    more = {"left": tmp_path / "both.png", "right": None, "side_by_side": "auto"}
    pair = read_pair(options(files, "third", **more))
    np.testing.assert_allclose(pair.left, left, atol=1e-6)
    np.testing.assert_allclose(pair.guidance.rights[0].permute(1, 2, 0), left[::-1], atol=1e-6)
    np.testing.assert_allclose(pair.guidance.rights[1].permute(1, 2, 0), image_of(files, "third"), atol=1e-6)


def test_a_prior_map_and_names_for_colmap_are_read_before_the_work(files, tmp_path):
    values = np.linspace(0.1, 0.9, 20 * 30, dtype=np.float32).reshape(20, 30)
    np.save(tmp_path / "prior.npy", values)
    pair = read_pair(options(files, prior_map=tmp_path / "prior.npy"))
    np.testing.assert_array_equal(pair.prior_map, values)
    blank = tmp_path / "le ft.png"
    Image.open(files / "left.png").save(blank)
    with pytest.raises(InputError, match="le ft.png"):
        read_pair(options(files, left=blank, export=("colmap",)))
    read_pair(options(files, left=blank, export=("glb",)))


def test_videos_and_bags_are_opened_once_and_closed(monkeypatch):
    opened = []

    class Reader:
        def __init__(self, *given):
            opened.append(given)
            self.name = str(given[0])

        def __enter__(self):
            return self

        def __exit__(self, *_):
            opened.append(f"{self.name} closed")

        def read(self, frame):
            return f"{self.name} {frame}" if "side" not in self.name else SimpleNamespace(frame=frame)

    monkeypatch.setattr(reading.recordings, "VideoReader", Reader)
    monkeypatch.setattr(reading.recordings, "BagReader", Reader)
    monkeypatch.setattr(reading.Packing, "split", lambda packing, image, name: (packing.layout, image.frame))
    given = DepthOptions(left=Path("l.mp4"), left_topic="/l", right_topic="/r", tolerance=0.25)
    made = reading.PairReader(given)
    assert made.frames_of(PairRef("a", Path("a.png"), Path("b.png"))) is None and opened == []
    pair = PairRef("3", Path("l.mp4"), Path("r.mp4"), frame=3)
    assert made.frames_of(pair) == made.frames_of(pair) == ("l.mp4 3", "r.mp4 3")
    assert made.frames_of(replace(pair, right_frame=7)) == ("l.mp4 3", "r.mp4 7")
    assert sorted(opened) == [(Path("l.mp4"),), (Path("r.mp4"),)]
    assert made.frames_of(PairRef("5", Path("side.mp4"), None, frame=5)) == ("full", 5)
    stacked = PairRef("5", Path("side.mp4"), None, frame=5, packing=reading.Packing("over-under"))
    assert made.frames_of(stacked) == ("over-under", 5)
    made.frames_of(PairRef("0", Path("side.mcap"), None, frame=0))
    assert opened[-1] == (Path("side.mcap"), ("/l", "/r"), 0.25)
    made.close()
    assert {"l.mp4 closed", "r.mp4 closed", "side.mp4 closed", "side.mcap closed"} <= set(map(str, opened))


def test_damaged_frames_do_not_keep_a_bag_from_having_overlays(monkeypatch):
    """Overlays are sought for every pair, so an error would fail all pairs of the bag."""
    views_of = rig_video("12:34 REC")
    damaged = {1: InputError("an image must be 6 rows"), 6: InputFileError("an image cannot be decoded")}

    class Reader(contextlib.nullcontext):
        def __init__(self, path, topics, tolerance):
            super().__init__(self)

        def read(self, frame):
            if frame in damaged:
                raise damaged[frame]
            if (views := views_of(frame)) is None:
                raise reading.recordings.EndOfRecordingError("no such pair")
            return np.hstack(views)

    monkeypatch.setattr(reading.recordings, "BagReader", Reader)
    given = DepthOptions(left=Path("drive.mcap"), left_topic="/l", right_topic="/r")
    with reading.PairReader(given) as reader:
        overlays = reader._overlays_of(PairRef("000001", given.left, None, frame=1))
    assert overlays is not None and overlays[16:30, 14:120].mean() > 0.8


def test_a_pair_of_many_is_read_with_its_origin(files, monkeypatch):
    given, frames = options(files, k_right=None, view_k=()), [image_of(files, "left")] * 2
    monkeypatch.setattr(reading.PairReader, "frames_of", lambda *_: frames)
    with reading.PairReader(given) as reader:
        pair = reader.read(PairRef("a", given.left, given.right, frame=4), given)
    assert pair.options is given and pair.inputs.left is frames[0]
    assert (pair.origin.name, pair.origin.frame) == ("a", 4)
    assert set(pair.origin.sha256) == {str(path) for path in given.read_files()}
    assert list(pair.log.seconds) == ["calibration"]


def write_both(files, name: str, layout: str):
    """An image of both views ``(64, 48)``, with texture on several scales, squeezed for a layout."""
    Image.fromarray(packed(layout, (160, 120))).save(files / name)
    return files / name


def read_both(files, name: str, side_by_side: str, **more):
    given = {"left": files / name, "right": None, "side_by_side": side_by_side, **more}
    return read_pair(DepthOptions(baseline=0.1, **given) if "fx" in more else DepthOptions(**given))


@pytest.mark.parametrize(("layout", "by_x", "by_y"), [("half", 2, 1), ("half-over-under", 1, 2)])
def test_k_of_squeezed_views_is_for_their_shape_before(files, layout, by_x, by_y):
    """The views stay as they are in the file, so that K is scaled to them."""
    write_both(files, "both.png", layout)
    for side_by_side in (layout, "auto"):
        pair = read_both(files, "both.png", side_by_side, fx=150.0, cx=70.0)
        height, width = pair.left.shape[:2]
        assert (width, height) == (160 / by_x, 120 / by_y) == pair.rig.size_left
        K = [[150 / by_x, 0, 70.5 / by_x - 0.5], [0, 150 / by_y, 60 / by_y - 0.5], [0, 0, 1]]
        np.testing.assert_allclose(pair.rig.K_left, K, atol=1e-9)
        np.testing.assert_allclose(pair.rig.K_right, K, atol=1e-9)
        codes = [finding.code for finding in pair.guidance.findings]
        assert ("pairs.side-by-side" in codes or "pairs.layout" in codes) == (side_by_side == "auto")


def test_cameras_for_squeezed_views_settle_an_inferred_layout(files):
    write_both(files, "both.png", "half")
    pair = read_both(files, "both.png", "auto", fx=75.0, fy=150.0)
    np.testing.assert_allclose(pair.rig.K_left.diagonal(), [75, 150, 1])
    assert any("by its cameras" in finding for finding in pair.guidance.findings)
    with pytest.warns(UserWarning, match="pixels are usually square"):  # a given layout stays
        pair = read_both(files, "both.png", "half", fx=75.0, fy=150.0)
    np.testing.assert_allclose(pair.rig.K_left.diagonal(), [37.5, 150, 1])


@pytest.mark.parametrize("layout", ["full", "half"])
def test_the_image_size_of_a_calibration_settles_an_inferred_layout(files, layout):
    """A view of 80 x 120 is unusual, as a full one and as a squeezed one."""
    write_both(files, "both.png", "half")
    width = 80 if layout == "full" else 160
    text = f"cam0=[100 0 {width / 2}; 0 100 60; 0 0 1]\ncam1=[100 0 {width / 2}; 0 100 60; 0 0 1]\n"
    (files / "calib.txt").write_text(f"{text}doffs=0\nbaseline=100\nwidth={width}\nheight=120\n")
    pair = read_both(files, "both.png", "auto", calib=(files / "calib.txt",))
    assert pair.left.shape[:2] == (120, 80) == pair.rig.size_left[::-1]
    assert pair.rig.K_left[0, 0] == pytest.approx(100 if layout == "full" else 50)
    assert any(f"({layout}), by its cameras" in finding for finding in pair.guidance.findings)
