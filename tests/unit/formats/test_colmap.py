"""COLMAP models: what is written is what pycolmap reads, and what pycolmap writes is read with its values."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import colmap
from geodiff_plugin.formats import files as text_files
from geodiff_plugin.formats.clouds import Cloud
from geodiff_plugin.formats.colmap import (
    calibration_text,
    model_files,
    read_colmap,
    read_colmap_capture,
    read_model,
    read_points,
    write_colmap,
)
from geodiff_plugin.formats.rigs import CameraChoice
from tests.unit.error_sentences import check_error

pycolmap = pytest.importorskip("pycolmap")

#: No two sides, focal lengths or principal points are equal, and no view is turned about one axis alone.
SIZES = ((64, 48), (50, 70), (81, 45), (60, 60))
FOCALS = ((61.0, 55.5), (48.25, 52.0), (70.5, 66.0), (57.0, 59.0))
CENTRES = ((30.25, 22.5), (26.0, 33.75), (41.5, 20.25), (28.0, 31.0))
VECTORS = ((0.1, -0.2, 0.05), (-0.15, 0.1, 0.3), (0.2, 0.15, -0.1), (-0.05, -0.3, 0.2))
PLACES = ((0.1, 0.2, -0.3), (0.5, -0.2, 0.1), (-0.4, 0.1, 0.2), (0.2, 0.4, -0.1))


def intrinsics(number: int) -> np.ndarray:
    (fx, fy), (cx, cy) = FOCALS[number], CENTRES[number]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def pose(number: int) -> np.ndarray:
    E = np.eye(4)
    E[:3, :3], E[:3, 3] = Rotation.from_rotvec(VECTORS[number]).as_matrix(), PLACES[number]
    return E


VIEWS = [(f"view-{n}.png", intrinsics(n), pose(n), SIZES[n]) for n in range(4)]
RNG = np.random.default_rng(7)
CLOUD = Cloud(
    RNG.uniform((-2.2, -1.8, 2.5), (2.2, 1.8, 5.0), (80, 3)).round(4), RNG.integers(0, 255, (80, 3), np.uint8)
)


def pixels(points: np.ndarray, K: np.ndarray, E: np.ndarray) -> np.ndarray:
    """Pixels of world points, the centre of the first one at (0, 0)."""
    in_camera = (points - E[:3, 3]) @ E[:3, :3]
    x, y, z = in_camera.T
    return np.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], axis=1)


def sight(view) -> tuple[np.ndarray, np.ndarray]:
    _, K, E, (width, height) = view
    px = pixels(CLOUD.points_m, K, E)
    rows = np.flatnonzero((px > -0.5).all(axis=1) & (px < (width - 0.5, height - 0.5)).all(axis=1))
    rows = RNG.permutation(rows)
    return px[rows], rows


SEEN = [sight(view) for view in VIEWS]
COUNTS = np.bincount(np.concatenate([rows for _, rows in SEEN]), minlength=len(CLOUD.points_m))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    write_colmap(folder, VIEWS, CLOUD, SEEN)
    return folder


@pytest.fixture(scope="module")
def binary(model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("binary")
    pycolmap.Reconstruction(str(model)).write_binary(str(folder))
    return folder


def test_pycolmap_projects_every_written_point_to_the_pixel_that_sees_it(model):
    theirs = pycolmap.Reconstruction(str(model))
    assert len(theirs.images) == 4 and len(theirs.cameras) == 4 and len(theirs.points3D) == 80
    assert COUNTS.min() == 0 and 2 in COUNTS and COUNTS.max() == 4
    for number, (name, K, E, size) in enumerate(VIEWS, 1):
        image = theirs.images[number]
        camera = theirs.cameras[image.camera_id]
        assert image.name == name and (camera.width, camera.height) == size
        np.testing.assert_allclose(camera.calibration_matrix() - K, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        np.testing.assert_allclose(image.cam_from_world().matrix(), np.linalg.inv(E)[:3], atol=1e-9)
        px, rows = SEEN[number - 1]
        assert [point.point3D_id for point in image.points2D] == (rows + 1).tolist()
        for point in image.points2D:
            expected = camera.img_from_cam(image.cam_from_world() * theirs.points3D[point.point3D_id].xyz)
            np.testing.assert_allclose(point.xy, expected, atol=1e-3)
    for row, (xyz, colour) in enumerate(zip(CLOUD.points_m, CLOUD.colours, strict=True)):
        point = theirs.points3D[row + 1]
        np.testing.assert_allclose(point.xyz, xyz, atol=1e-5)
        assert point.color.tolist() == colour.tolist() and point.track.length() == COUNTS[row]
        for element in point.track.elements:
            assert SEEN[element.image_id - 1][1][element.point2D_idx] == row


def test_a_written_model_reads_back_as_text_and_as_binary(model, binary):
    for folder, suffix in ((model, ".txt"), (binary, ".bin")):
        files = model_files(folder)
        assert [file.name for file in files] == [f"cameras{suffix}", f"images{suffix}"]
        read = read_model(files)
        assert list(read.images) == [name for name, *_ in VIEWS] and not read.unusable
        for name, K, E, size in VIEWS:
            camera = read.camera(read.images[name].camera)
            np.testing.assert_allclose(camera.K, K, atol=1e-6)
            assert camera.size == size and camera.model == "opencv" and not camera.coefficients.any()
            np.testing.assert_allclose(read.images[name].T, np.linalg.inv(E), atol=1e-9)
        with pytest.raises(InputError, match=r"with camera 9; got only 1, 2, 3, 4"):
            read.camera(9)


def test_points_that_three_images_see_are_those_of_each_image_that_sees_them(model, binary):
    for folder in (model, binary):
        points = read_points(folder)
        for number, (_, rows) in enumerate(SEEN, 1):
            expected = CLOUD.points_m[np.sort(rows[COUNTS[rows] >= 3])]
            assert 3 < len(expected) < len(rows)
            np.testing.assert_allclose(points[number], expected, atol=1e-5)


def test_points_far_off_their_pixels_are_left_out(model, tmp_path):
    theirs = pycolmap.Reconstruction(str(model))
    kept = []
    for number, point in theirs.points3D.items():
        point.error = (0.3, 1.5, 1.51, 40.0)[number % 4]
        if point.track.length() >= 3 and number % 4 < 2:
            kept.append(number)
    for write in ("write_text", "write_binary"):
        folder = tmp_path / write
        folder.mkdir()
        getattr(theirs, write)(str(folder))
        read = np.unique(np.concatenate(list(read_points(folder).values())).round(4), axis=0)
        expected = np.unique(CLOUD.points_m[np.array(kept) - 1], axis=0)
        assert len(expected) > 5
        np.testing.assert_allclose(read, expected, atol=1e-5)


def test_the_pose_of_a_pair_is_that_of_the_right_camera_in_the_left_ones_frame(model, binary):
    for folder, suffix in ((model, ".txt"), (binary, ".bin")):
        texts = tuple(calibration_text(folder / f"{kind}{suffix}") for kind in ("images", "cameras"))
        for left, right in ((0, 2), (3, 1)):
            names = VIEWS[left][0], VIEWS[right][0]
            rig = read_colmap(texts, CameraChoice(image_names=names))
            np.testing.assert_allclose(rig.E, np.linalg.inv(pose(left)) @ pose(right), atol=1e-8)
            np.testing.assert_allclose(rig.K_left, intrinsics(left), atol=1e-6)
            np.testing.assert_allclose(rig.K_right, intrinsics(right), atol=1e-6)
            assert (rig.size_left, rig.size_right) == (SIZES[left], SIZES[right])
    with pytest.raises(InputError, match="cameras.txt and images.txt; got two of one kind"):
        read_colmap((texts[1], texts[1]), CameraChoice(image_names=names))


def test_an_export_without_sight_lines_is_thinned_and_has_no_tracks(tmp_path, monkeypatch):
    monkeypatch.setattr(colmap, "MAX_POINTS", 33)
    write_colmap(tmp_path, VIEWS, CLOUD)
    theirs = pycolmap.Reconstruction(str(tmp_path))
    assert len(theirs.points3D) == 33 and all(p.track.length() == 0 for p in theirs.points3D.values())
    assert all(len(image.points2D) == 0 for image in theirs.images.values())
    kept = np.array([theirs.points3D[number].xyz for number in sorted(theirs.points3D)])
    rows = [np.abs(CLOUD.points_m - point).sum(axis=1).argmin() for point in kept]
    assert rows[0] == 0 and rows[-1] == 79 and set(np.diff(rows)) <= {2, 3}
    np.testing.assert_allclose(kept, CLOUD.points_m[rows], atol=1e-5)


#: A model's parameters in COLMAP's order, with the focal lengths and the principal point that they mean.
PARAMETERS = {
    "SIMPLE_PINHOLE": "70 33 21",
    "PINHOLE": "70 75 33 21",
    "SIMPLE_RADIAL": "70 33 21 0.1",
    "RADIAL": "70 33 21 0.1 0.2",
    "OPENCV": "70 75 33 21 0.1 0.2 0.3 0.4",
    "OPENCV_FISHEYE": "70 75 33 21 0.1 0.2 0.3 0.4",
    "FULL_OPENCV": "70 75 33 21 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.8",
    "SIMPLE_RADIAL_FISHEYE": "70 33 21 0.1",
    "RADIAL_FISHEYE": "70 33 21 0.1 0.2",
    "SIMPLE_FISHEYE": "70 33 21",
    "FISHEYE": "70 75 33 21",
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_parameters_are_focal_lengths_then_the_centre_then_the_lens(name):
    words = PARAMETERS[name]
    camera = colmap.model_camera("3", name, (64, 48), words)
    theirs = pycolmap.Camera(model=name, width=64, height=48, params=[float(word) for word in words.split()])
    np.testing.assert_allclose(camera.K[:2, 2] + 0.5, theirs.calibration_matrix()[:2, 2])
    np.testing.assert_allclose(np.diag(camera.K)[:2], np.diag(theirs.calibration_matrix())[:2])
    lens = theirs.params[len(theirs.focal_length_idxs()) + 2 :]
    assert len(camera.coefficients) == max(4, len(lens)) and camera.size == (64, 48)
    np.testing.assert_array_equal(camera.coefficients[: len(lens)], lens)
    assert not camera.coefficients[len(lens) :].any()
    assert camera.model == ("fisheye" if "FISHEYE" in name else "opencv")


def test_cameras_that_cannot_be_used_state_the_reason():
    with pytest.raises(InputError, match="camera 3 must be a model with a focal length; got EQUIRECTANGULAR"):
        colmap.model_camera("3", "EQUIRECTANGULAR", (64, 48), "64 48")
    with pytest.raises(InputError, match="camera 3 must be one of SIMPLE_PINHOLE.*got MADE_UP"):
        colmap.model_camera("3", "MADE_UP", (64, 48), "64 48")
    with pytest.raises(InputError, match="parameters of camera 3"):
        colmap.model_camera("3", "PINHOLE", (64, 48), "70 75 33")
    with pytest.raises(InputError, match="without blanks; got 'a\\\\tb'"):
        colmap.check_colmap_names(["a", "a\tb"])


def files(folder, numbers) -> None:
    """A text model of some of the views."""
    folder.mkdir(parents=True)
    write_colmap(folder, [VIEWS[n] for n in numbers], CLOUD, [SEEN[n] for n in numbers])


def rgb_images(folder, names=tuple(name for name, *_ in VIEWS)) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"0")


def found(layout) -> list[str]:
    return [each.frame.image.as_posix() for each in layout.candidates if each.frame.image.is_file()]


def test_of_several_models_the_largest_is_read_with_its_own_points_and_the_others_are_counted(tmp_path):
    files(tmp_path / "sparse" / "0", (0, 1))
    files(tmp_path / "sparse" / "1", (1, 2, 3))
    files(tmp_path / "sparse" / "2", (0, 2, 3))
    rgb_images(tmp_path / "images")
    layout = read_colmap_capture(tmp_path)
    assert [c.frame.image.name for c in layout.candidates] == [VIEWS[n][0] for n in (1, 2, 3)]
    (finding,) = layout.findings
    assert "sparse/1, with 3 images, is used, the largest of 3 models" in finding
    assert (
        "ignored: sparse/0 with 2, sparse/2 with 3." in finding and layout.unit is None and layout.as_stored
    )
    for candidate, number in zip(layout.candidates, (1, 2, 3), strict=True):
        np.testing.assert_allclose(candidate.frame.E, pose(number), atol=1e-8)
        np.testing.assert_allclose(candidate.camera.K, intrinsics(number), atol=1e-6)
        rows = np.sort([r for r in SEEN[number][1] if all(r in SEEN[n][1] for n in (1, 2, 3))])
        np.testing.assert_allclose(candidate.frame.points, CLOUD.points_m[rows], atol=1e-5)
    assert read_colmap_capture(tmp_path / "sparse" / "0" / "cameras.txt").candidates[1].frame.name == "view-1"
    assert read_colmap_capture(tmp_path / "sparse" / "0" / "points3D.txt") is None


@pytest.mark.parametrize("up", range(6))
def test_images_of_a_model_are_looked_for_up_to_three_folders_above_it(up, tmp_path):
    folder = tmp_path / "a" / "b" / "c" / "d" / "e"
    files(folder, (0, 1))
    place = folder
    for _ in range(up):
        place = place.parent
    rgb_images(place / "input")
    layout = read_colmap_capture(folder)
    assert (len(found(layout)), layout.findings) == (2 if up < 4 else 0, ())


def test_a_project_takes_the_images_of_the_first_model_that_has_them_and_none_from_above(tmp_path):
    project = tmp_path / "project"
    files(project / "sparse", (0, 1, 2))
    files(project / "dense" / "sparse", (2, 3))
    rgb_images(tmp_path, (VIEWS[0][0],))  # of somebody else: above the project
    rgb_images(project / "dense" / "images", (VIEWS[2][0], VIEWS[3][0]))
    layout = read_colmap_capture(project)
    assert [c.frame.name for c in layout.candidates] == ["view-2", "view-3"] and len(found(layout)) == 2
    given = read_colmap_capture(project, project / "dense" / "images")
    assert [c.frame.image.stem for c in given.candidates] == ["view-0", "view-1", "view-2"]
    assert len(found(given)) == 1, "the folder that was given has one of the first model's images"
    (project / "sparse" / "points3D.txt").unlink()
    assert all(c.frame.points is None for c in read_colmap_capture(project / "sparse").candidates)


def test_a_text_model_by_other_names_is_read_by_its_first_line_and_a_cut_off_one_is_rejected(model, tmp_path):
    text = (model / "images.txt").read_text()
    other = tmp_path / "poses.txt"
    other.write_text("\ufeff" + text)
    lines = [line for line in calibration_text(other).splitlines() if line]
    assert lines[0] == colmap.IMAGES_MARK and [line.split()[-1] for line in lines[1:]] == [
        v[0] for v in VIEWS
    ]
    (tmp_path / "images.txt").write_text("\n".join(text.splitlines()[1:]))
    assert [line for line in calibration_text(tmp_path / "images.txt").splitlines() if line] == lines
    (tmp_path / "images.txt").write_text("# nothing")
    with pytest.raises(
        InputError, match="calibration must be images.txt of a COLMAP model; got .* without images"
    ):
        calibration_text(tmp_path / "images.txt")


def test_a_binary_camera_of_a_model_that_is_not_known_is_rejected_by_its_number(binary, tmp_path):
    raw = bytearray((binary / "cameras.bin").read_bytes())
    for number in (18, 255):
        raw[12] = number
        (tmp_path / "cameras.bin").write_bytes(raw)
        with pytest.raises(InputError, match=f"camera models 0 to 17 of COLMAP; got {number}"):
            calibration_text(tmp_path / "cameras.bin")


def test_a_file_of_images_may_be_longer_than_any_other_text(model, tmp_path, monkeypatch):
    """Its lines of keypoints, which are not kept, are most of it; a file of cameras is short."""
    monkeypatch.setattr(text_files, "LARGEST_TEXT_BYTES", 500)
    kept = calibration_text(model / "images.txt")
    assert (model / "images.txt").stat().st_size > 500
    assert [line.split()[-1] for line in kept.splitlines()[1:] if line] == [view[0] for view in VIEWS]
    (tmp_path / "poses.txt").write_text((model / "images.txt").read_text())
    assert calibration_text(tmp_path / "poses.txt") == kept
    cameras = (model / "cameras.txt").read_text()
    (tmp_path / "cameras.txt").write_text(cameras + "# more\n" * 100)
    size = (tmp_path / "cameras.txt").stat().st_size
    path = tmp_path / "cameras.txt"
    check_error(
        lambda: calibration_text(path), "calibration", "a calibration file", f"{path} of {size} bytes"
    )
    (tmp_path / "cameras.txt").write_text(cameras[:500])
    assert calibration_text(tmp_path / "cameras.txt") == cameras[:500]


def test_a_binary_file_that_is_cut_off_anywhere_is_rejected_by_its_name(binary, tmp_path):
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        raw = (binary / name).read_bytes()
        path = tmp_path / name
        read = (
            (lambda: read_points(tmp_path))
            if name == "points3D.bin"
            else (lambda p=path: calibration_text(p))
        )
        path.write_bytes(raw)
        read()
        for length in (7, 9, len(raw) // 2, len(raw) - 1):
            path.write_bytes(raw[:length])
            check_error(read, str(path), "a binary COLMAP file", "too few bytes", "It may be truncated.")


def test_a_camera_number_that_the_model_lacks_is_named_with_those_that_it_has():
    model = colmap.Model({3: None, 5: None}, {4: "it is a panorama."}, {})
    check_error(lambda: model.camera(9), "the cameras", "with camera 9", "only 3, 5")
    check_error(lambda: colmap.Model({}, {}, {}).camera(9), "the cameras", "with camera 9", "only none")
    with pytest.raises(InputError, match="^it is a panorama.$"):
        model.camera(4)
