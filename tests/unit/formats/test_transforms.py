"""``transforms.json``: cameras, poses and depth maps of each frame."""

import json
import math

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import transforms
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.formats.posed_images import (
    KS,
    POSES,
    SIZES,
    assert_is_an_immutable_record,
    assert_is_read,
    central,
    numbers,
    write_images,
)

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
#: k1 k2 k3 k4 p1 p2, in nerfstudio's order.
LENSES = [
    [0.1, -0.2, 0.03, 0.0, 0.004, -0.005],
    [0.11, 0.2, -0.03, 0.0, 0.006, 0.005],
    [0, 0.1, 0.2, 0, 0.1, 0.3],
]
NAMES = ["images/a.png", "images/b.png", "images/c.png"]


def frame(n: int, lens: bool = True, size: bool = True, **changes) -> dict:
    entries = {"file_path": NAMES[n], "transform_matrix": (POSES[n] @ FLIP).tolist()}
    entries |= dict(zip(("fl_x", "fl_y", "cx", "cy"), numbers(n, 0.5), strict=True))
    entries |= {"w": SIZES[n][0], "h": SIZES[n][1]} if size else {}
    entries |= dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), LENSES[n], strict=True)) if lens else {}
    return {key: value for key, value in (entries | changes).items() if value is not None}


def opencv_order(lens):
    k1, k2, k3, _, p1, p2 = lens
    return [k1, k2, p1, p2, k3]


def write(file, frames, **shared):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(shared | {"frames": frames}))
    return file


def test_frame_entries_override_shared_entries():
    text = json.dumps(
        {"w": 5, "h": 6, "transform_matrix": "x", "frames": [{"w": 7}, {"file_path": "a", "h": 8}]}
    )
    assert list(transforms.nerf_frames(text)) == [
        {"w": 7, "h": 6, "file_path": "frame 0"},
        {"w": 5, "h": 8, "file_path": "a"},
    ]
    for content, got in (
        ([1], "a different value"),
        ({}, "with nothing"),
        ({"Frames": [], "w": 3}, "with Frames, w"),
        ({"frames": {}}, "with frames"),
    ):
        with pytest.raises(
            InputError,
            match=rf"\Atransforms\.json must be an object with a list 'frames'; got {got}\. "
            r"Names are lower case: frames, file_path, transform_matrix\.\Z",
        ):
            list(transforms.nerf_frames(json.dumps(content)))


def test_principal_points_lose_half_a_pixel():
    for n in range(3):
        camera = transforms.nerf_camera(frame(n))
        np.testing.assert_allclose(camera.K, KS[n])
        assert camera.size == SIZES[n] and camera.model == "OPENCV"
        assert list(camera.coefficients) == opencv_order(LENSES[n])
        bare = transforms.nerf_camera(frame(n, lens=False, size=False, cx=None, cy=None), SIZES[n])
        np.testing.assert_allclose(bare.K, central(n, KS[n][0, 0], KS[n][1, 1]))
        assert bare.size == SIZES[n] and not any(bare.coefficients) and len(bare.coefficients) == 5
        sized = transforms.nerf_camera(frame(n), (3, 4))
        assert sized.size == SIZES[n]


@pytest.mark.parametrize(
    ("entries", "fx", "fy"),
    [
        ({"fl_x": 60.5}, 60.5, 60.5),
        ({"fl_y": 60.5}, 60.5, 60.5),
        ({"fx": 60.5, "fy": 50.5}, 60.5, 50.5),
        ({"fx": 60.5, "fl_x": 70.5, "fy": 50.5}, 70.5, 50.5),
        ({"camera_angle_x": 0.9}, 41 / math.tan(0.45), 41 / math.tan(0.45)),
        ({"camera_angle_x": 0.9, "camera_angle_y": 0.7}, 41 / math.tan(0.45), 30.5 / math.tan(0.35)),
        ({"camera_angle_y": 0.7}, 30.5 / math.tan(0.35), 30.5 / math.tan(0.35)),
        ({"fl_x": 60.5, "camera_angle_x": 99, "camera_angle_y": 0.7}, 60.5, 30.5 / math.tan(0.35)),
    ],
)
def test_focal_lengths_may_be_pixels_or_angles(entries, fx, fy):
    camera = transforms.nerf_camera({"w": 82, "h": 61.0} | entries)
    np.testing.assert_allclose(camera.K[(0, 1), (0, 1)], (fx, fy))


def test_errors_name_the_missing_camera_entries():
    with pytest.raises(
        InputError, match=r"\Athe file must be a file with entries 'w' and 'h'; got none\. Pass image_s"
    ):
        transforms.nerf_camera(frame(0, size=False))
    with pytest.raises(
        InputError, match=r"\Athe file must be a file with an entry 'fl_x' or 'camera_angle_x'; got none\."
    ):
        transforms.nerf_camera({"w": 3, "h": 4})
    for angle in (0, math.pi, -0.1, 50.0):
        with pytest.raises(
            InputError, match=rf"\Acamera_angle_y must be in radians, between 0 and pi; got {angle}\. It"
        ):
            transforms.nerf_camera({"w": 3, "h": 4, "fl_x": 3, "camera_angle_y": angle})


@pytest.mark.parametrize(
    ("entries", "model", "kind"),
    [
        ({}, "OPENCV", "opencv"),
        ({"is_fisheye": True}, "OPENCV_FISHEYE", "fisheye"),
        ({"is_fisheye": False}, "OPENCV", "opencv"),
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE", "fisheye"),
        ({"camera_model": "PINHOLE", "is_fisheye": True}, "PINHOLE", "opencv"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR", None),
    ],
)
@pytest.mark.parametrize("as_list", [True, False])
def test_lenses_outside_opencv_models_are_rejected(entries, model, kind, as_list):
    values = [0.1, -0.2, 0.03, 0.04, 0.005, -0.006]
    if kind == "opencv":
        values[3] = 0.0
    elif kind == "fisheye":
        values[4:] = 0.0, 0.0

    def read(values):
        lens = (
            {"distortion_params": values}
            if as_list
            else dict(zip(transforms.NERF_PARAMS, values, strict=True))
        )
        return transforms.nerf_camera(frame(0, lens=False) | entries | lens)

    camera = read(values)
    expected = {"opencv": opencv_order(values), "fisheye": values[:4], None: []}[kind]
    assert (camera.model, list(camera.coefficients)) == (model, expected)
    if kind is not None:
        wrong = [0.1, 0, 0, 0.3, 0.5, -0.6]
        others, got = ("k4", r"\[0\.3\]") if kind == "opencv" else ("p1 and p2", r"\[0\.5, -0\.6\]")
        with pytest.raises(
            InputError, match=rf"\A{others} must be zero for {model}; got {got}\. OpenCV lacks"
        ):
            read(wrong)


@pytest.mark.parametrize("rows", [3, 4])
def test_poses_are_camera_to_world_in_opengl_axes(rows):
    E = POSES[1]
    matrix = (E @ FLIP)[:rows].tolist()
    np.testing.assert_allclose(transforms.nerf_pose({"transform_matrix": matrix}), E, atol=1e-12)
    scaled = transforms.nerf_pose({"transform_matrix": matrix, "applied_scale": 2.5})
    np.testing.assert_allclose(scaled[:3, 3], E[:3, 3] / 2.5)
    np.testing.assert_allclose(scaled[:3, :3], E[:3, :3], atol=1e-12)
    for bad in (0, -1.0):
        with pytest.raises(
            InputError, match=r"\Aapplied_scale must be a finite number of units above 0; got "
        ):
            transforms.nerf_pose({"transform_matrix": matrix, "applied_scale": bad})
    for at in ((0, 0), (2, 3), (rows - 1, 1)):
        for unknown in (None, math.nan):
            lost = [list(row) for row in matrix]
            lost[at[0]][at[1]] = unknown
            assert transforms.nerf_pose({"transform_matrix": lost}) is None
    assert transforms.nerf_pose({}) is None and transforms.nerf_pose({"transform_matrix": None}) is None
    assert transforms.nerf_pose({"transform_matrix": [None]}) is None
    assert transforms.nerf_pose({"transform_matrix": math.nan}) is None


@pytest.mark.parametrize(
    ("factor", "is_scaled"),
    [(1.0, False), (1.0009, False), (1.0011, True), (0.9985, True), (3.5, True), (0.2, True)],
)
def test_homogeneous_poses_may_be_scaled(factor, is_scaled):
    given = {"transform_matrix": (factor * POSES[1] @ FLIP).tolist()}
    np.testing.assert_allclose(transforms.nerf_pose(given), POSES[1], atol=1e-9)
    assert transforms._is_scaled(given) == is_scaled
    assert not transforms._is_scaled({}) and not transforms._is_scaled({"transform_matrix": [None]})
    assert not transforms._is_scaled({"transform_matrix": (POSES[1] @ FLIP)[:3].tolist()})
    projective = factor * POSES[1] @ FLIP
    projective[3, 0] = 0.1
    for wrong in (projective, -POSES[1] @ FLIP, np.diag([1.0, 1, 1, 0])):
        with pytest.raises(InputError, match=r"\Atransform_matrix must be rigid"):
            transforms.nerf_pose({"transform_matrix": wrong.tolist()})


def test_two_named_images_form_a_pair():
    text = json.dumps({"frames": [frame(2), frame(1), frame(0)], "applied_scale": 2.0})
    names = ("b.png", "/data/images/a.png")
    rig = transforms.read_nerf((text,), CameraChoice(image_names=names))
    E = np.linalg.inv(POSES[1]) @ POSES[0]
    E[:3, 3] /= 2
    np.testing.assert_allclose(rig.E, E, atol=1e-9)
    np.testing.assert_allclose(rig.K_left, KS[1])
    np.testing.assert_allclose(rig.K_right, KS[0])
    assert (rig.size_left, rig.size_right) == (SIZES[1], SIZES[0])
    bare = json.dumps({"frames": [frame(0, size=False), frame(1, size=False)]})
    rig = transforms.read_nerf((bare,), CameraChoice(image_names=names, image_size=(82, 61)))
    assert rig.size_left == rig.size_right == (82, 61)
    lost = json.dumps({"frames": [frame(0, transform_matrix=None), frame(1)]})
    with pytest.raises(
        InputError, match=r"\Atransform_matrix must be specified for both images; got none for one of them"
    ):
        transforms.read_nerf((lost,), CameraChoice(image_names=names))


PLACES = [
    "transforms.json",
    "transforms_train.json",
    "dslr/nerfstudio/transforms_undistorted.json",
    "dslr/nerfstudio/transforms.json",
    "nerfstudio/transforms_undistorted.json",
    "nerfstudio/transforms.json",
]


@pytest.mark.parametrize(("place", "by_file"), [*((place, False) for place in PLACES), (PLACES[3], True)])
def test_capture_frames_follow_the_order_of_the_file(scan, place, by_file):
    file = write(scan / place, [frame(n) for n in (2, 0, 1)])
    files = write_images(file.parent, NAMES)
    layout = transforms.read_transforms(file if by_file else scan)
    order = [2, 0, 1]

    def moved(values):
        return [values[n] for n in order]

    assert_is_read(
        layout,
        "transforms.json",
        "m",
        moved(files),
        Ks=moved(KS),
        sizes=moved(SIZES),
        poses=moved(POSES),
        lenses=[opencv_order(lens) for lens in moved(LENSES)],
        models=["OPENCV"] * 3,
        findings=["capture.assumed-metres"],
    )
    assert transforms.read_transforms(files[0]) is None and transforms.read_transforms(scan / "none") is None
    (scan / "other.json").write_text('{"frames": [], "file": 1}')
    assert transforms.read_transforms(scan / "other.json") is None
    (scan / "other.json").write_text('{"file_path": []}')
    assert transforms.read_transforms(scan / "other.json") is None
    (scan / "mine.json").write_text(json.dumps({"frames": [frame(0)]}))
    assert transforms.read_transforms(scan / "mine.json") is not None
    if not by_file:
        file.unlink()
        assert transforms.read_transforms(scan) is None


@pytest.mark.parametrize(
    ("name", "expected"), [("transforms_undistorted", "undistorted"), ("transforms", "distorted")]
)
@pytest.mark.parametrize("resized", [True, False])
def test_scannetpp_files_use_the_images_with_matching_distortion(scan, name, expected, resized):
    """The image names are the same in both folders."""
    folders = {
        "undistorted": ("resized_undistorted_images" if resized else "undistorted_images"),
        "distorted": ("resized_images" if resized else "original_images"),
    }
    files = {
        kind: write_images(scan / "dslr" / folder, ["a.png", "b.png", "c.png"])
        for kind, folder in folders.items()
    }
    frames = [frame(n, file_path=f"{'abc'[n]}.png") for n in range(3)]
    write(scan / "dslr" / "nerfstudio" / f"{name}.json", frames)
    layout = transforms.read_transforms(scan)
    assert [each.frame.image for each in layout.candidates] == files[expected]
    for file in files[expected]:
        file.unlink()
    assert all("no image file" in each.problem for each in transforms.read_transforms(scan).candidates)
    given = transforms.read_transforms(scan, files["distorted"][0].parent)
    if expected == "undistorted":
        assert [each.frame.image for each in given.candidates] == files["distorted"]
    else:
        assert all(each.problem for each in given.candidates)


@pytest.mark.parametrize("solved", [{"colmap_im_id": 3}, {"sharpness": 3.0}, "scaled", None])
def test_poses_from_structure_from_motion_have_no_unit(scan, solved):
    write_images(scan, NAMES)
    frames = [frame(n) for n in range(3)]
    if solved == "scaled":
        frames[1]["transform_matrix"] = (3.0 * POSES[1] @ FLIP).tolist()
    elif solved:
        frames[2] |= solved
    layout = transforms.read_transforms(write(scan / "transforms.json", frames))
    assert layout.unit == (None if solved else "m")
    assert [finding.code for finding in layout.findings] == ([] if solved else ["capture.assumed-metres"])


@pytest.mark.parametrize(
    ("named", "entries", "per_m"),
    [
        ("depth_file_path", {"depth_unit_scale_factor": 0.001}, 1000.0),
        ("depth_path", {"integer_depth_scale": 0.0002}, 5000.0),
        (".png", {"depth_scaling_factor": 4000}, 4000.0),
        (".npy", {"depth_unit_scale_factor": 0.001, "depth_scaling_factor": 4000}, 1000.0),
        (".tiff", {"depth_unit_scale_factor": None, "depth_scaling_factor": None}, None),
        (".tif", {}, None),
        (".exr", {}, None),
    ],
)
def test_depth_maps_are_found_by_entry_or_by_folder(scan, named, entries, per_m):
    files = write_images(scan, NAMES)
    frames = [frame(n) for n in range(3)]
    (scan / "depth").mkdir()
    (scan / "maps").mkdir()
    if named.startswith("."):
        expected = scan / "depth" / f"b{named}"
    else:
        frames[1][named] = "maps\\d.png"
        expected = scan / "maps" / "d.png"
        (scan / "depth" / "b.png").write_text("another")
    expected.write_text("x")
    layout = transforms.read_transforms(write(scan / "transforms.json", frames, **entries))
    assert [each.frame.depth for each in layout.candidates] == [None, expected, None]
    assert [each.frame.depth_per_m for each in layout.candidates] == [per_m] * 3
    assert not layout.findings and len(files) == 3
    expected.unlink()
    assert transforms.read_transforms(scan).candidates[1].frame.depth is None


def test_depth_factors_must_be_positive():
    for entries, words in (
        (
            {"integer_depth_scale": 0.0},
            r"\Ainteger_depth_scale must be a finite number of metres per unit above 0",
        ),
        (
            {"depth_scaling_factor": -1},
            r"\Adepth_scaling_factor must be a finite number of units per metre above 0",
        ),
    ):
        with pytest.raises(InputError, match=words):
            transforms._depth_per_m(entries)


@pytest.mark.parametrize("key", ["fl_x", "fl_y", "fx", "fy", "camera_angle_x", "camera_angle_y"])
def test_frames_without_a_focal_length_have_no_camera(scan, key):
    write_images(scan, NAMES)
    no_focal = frame(0, fl_x=None, fl_y=None)
    frames = [no_focal, frame(1, fl_x=None, fl_y=None, size=False) | {key: 0.9}]
    layout = transforms.read_transforms(write(scan / "transforms.json", frames))
    assert layout.candidates[0].camera is None and layout.candidates[0].frame.E is not None
    assert layout.candidates[1].camera.size == SIZES[1]  # the size of the image


def test_unread_transforms_files_in_the_same_folder_are_reported(scan):
    write_images(scan, NAMES)
    write(scan / "transforms_train.json", [frame(0, colmap_im_id=1)])
    assert not transforms.read_transforms(scan).findings
    (scan / "transforms_val.json").write_text("{}")
    (finding,) = transforms.read_transforms(scan).findings
    assert finding == "transforms_train.json is read; transforms_val.json in the same folder is not."
    (scan / "transforms_test.json").write_text("{}")
    (finding,) = transforms.read_transforms(scan).findings
    assert (
        finding == "transforms_train.json is read; transforms_test.json, transforms_val.json in the same "
        "folder are not."
    )
    assert finding.code == "capture.part"
    write(scan / "transforms.json", [frame(0, colmap_im_id=1)])
    assert not transforms.read_transforms(scan).findings


def test_non_camera_entries_are_returned_by_image(scan):
    files = write_images(scan, NAMES)
    frames = [frame(0, extra=1, camera_model="x"), {"no_path": 1}, frame(1, extra=2), frame(0, extra=3)]
    frames.append(frame(2, file_path="nowhere.png"))
    shared = {"ply_file_path": "p.ply", "w": 3, "k3": 1, "is_fisheye": False, "camera_angle_x": 1}
    file = write(scan / "transforms.json", frames, **shared)
    read = transforms.transforms_of(scan)
    assert read.path == file and read.shared == {"ply_file_path": "p.ply", "is_fisheye": False}
    assert_is_an_immutable_record(read)
    assert list(read.frames) == files[:2]
    for image, n in ((files[0], 0), (files[1], 1)):
        assert set(read.frames[image]) == {"file_path", "transform_matrix", "extra"}
        assert read.frames[image]["extra"] == n + 1
    assert transforms.transforms_of(scan / "none") is None
    moved = write_images(scan / "else", ["a.png"])
    assert list(transforms.transforms_of(scan, scan / "else").frames) == moved
