"""Captures with depth for trainers of splats: our own reader and arithmetic of nerfstudio read it back."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.capture.splats import SplatFrame, write_splats
from geodiff_plugin.formats.clouds import Cloud
from geodiff_plugin.formats.transforms import transforms_of
from geodiff_plugin.types import DepthFrame, Distortion
from tests.contracts.captures import euroc
from tests.unit.capture_room import FLIP, SIZE, K, render, walk, write_transforms
from tests.unit.test_capture_files import colmap_text

TRUE = walk(4)
NAMES = ["f00", "f02", "f03"]
CLOUD = Cloud(np.array([[0.5, 0.25, 2.6], [1.0, 0.0, 2.0]]), np.full((2, 3), 9, np.uint8))


def sure_of() -> np.ndarray:
    """All but a corner."""
    sure = np.ones(SIZE[::-1], bool)
    sure[:20, :30] = False
    return sure


def loader(capture: Capture, length: float = 1.0):
    """True depth and poses of a frame, in a capture whose unit is ``length`` metres before it is rescaled."""
    factor = capture.metres_per_unit / length

    def load(name: str) -> SplatFrame:
        E = TRUE[capture.names.index(name)].copy()
        depth = render(E)[1].astype(np.float32) * factor
        E[:3, 3] *= factor
        confidence = np.full(depth.shape, 0.8, np.float32)
        return SplatFrame(DepthFrame(name, depth, confidence, K, E), sure_of())

    return load


def written(capture: Capture, folder: Path, load, original=None, names=NAMES) -> dict:
    write_splats(folder, capture, names, load, CLOUD, original)
    return json.loads((folder / "transforms.json").read_text())


def check(folder: Path, length: float = 1.0) -> Capture:
    """Our own reader finds cameras, images and depth as they are, in units of ``length`` metres."""
    again = Capture.open(folder)
    assert again.names == NAMES
    for name, frame in zip(NAMES, again.frames, strict=True):
        true = TRUE[int(name[1:])]
        np.testing.assert_allclose(frame.E[:3, :3], true[:3, :3], atol=1e-9)
        np.testing.assert_allclose(frame.E[:3, 3], true[:3, 3] / length, atol=1e-9)
        np.testing.assert_allclose(frame.K, K, atol=1e-9)
        depth, known = again.measured_depth(name)
        np.testing.assert_array_equal(known, sure_of())
        np.testing.assert_allclose(depth[known] * length, render(true)[1][known], atol=6e-4 * length)
        np.testing.assert_allclose(again.image(name), render(true)[0] / 255, atol=1e-6)
        mask = np.asarray(Image.open(folder / "depth_masks" / f"{name}.png"))
        np.testing.assert_array_equal(mask, np.where(sure_of(), 204, 0))
    return again


def test_a_copy_of_a_transforms_json_keeps_what_is_not_of_cameras(tmp_path):
    given = TRUE.copy()
    given[:, :3, 3] *= 2  # lengths of the file are those of the poses times applied_scale
    source = write_transforms(
        tmp_path / "scan",
        TRUE,
        given,
        applied_scale=2.0,
        aabb_scale=16,
        ply_file_path="old.ply",
        train_filenames=["images/f00.png", "images/f01.png"],
    )
    said = json.loads((source / "transforms.json").read_text())
    said["frames"][2] |= {"sharpness": 7.5, "mask_path": "masks/f02.png", "colmap_im_id": 3}
    (source / "transforms.json").write_text(json.dumps(said))
    (source / "masks").mkdir()
    Image.fromarray(np.full(SIZE[::-1], 255, np.uint8)).save(source / "masks/f02.png")
    capture = Capture.open(source)
    capture.rescale(1.0)
    data = written(capture, tmp_path / "out/nerfstudio", loader(capture), transforms_of(source))
    check(tmp_path / "out/nerfstudio")
    assert data["aabb_scale"] == 16 and data["train_filenames"] == ["images/f00.png"]
    assert "applied_scale" not in data and data["ply_file_path"] == "points.ply"
    assert data["depth_unit_scale_factor"] == 0.001 and data["fl_x"] == K[0, 0]
    frame = data["frames"][1]
    assert frame["sharpness"] == 7.5 and (tmp_path / "out/nerfstudio" / frame["mask_path"]).samefile(
        source / "masks/f02.png"
    )
    assert "fl_x" not in frame and "applied_transform" not in data


def test_a_colmap_model_gets_one_in_its_own_lengths(tmp_path):
    capture = Capture.open(colmap_text(tmp_path / "scan"))
    capture.rescale(2.5)  # as by --known-length; the unit of the model is 1 m here
    data = written(capture, tmp_path / "out", loader(capture))
    check(tmp_path / "out")
    assert data["metres_per_unit"] == 2.5
    np.testing.assert_array_equal(data["applied_transform"], np.eye(4)[:3])
    points = (tmp_path / "out/points.ply").read_bytes().split(b"end_header\n")[1]
    rows = np.frombuffer(points, [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    np.testing.assert_allclose(rows["xyz"], CLOUD.points_m / 2.5, rtol=1e-6)


@pytest.mark.parametrize("length", [40.0, 0.01])
def test_depth_that_16_bits_do_not_hold_well_is_of_floats(length, tmp_path):
    source = write_transforms(tmp_path / "scan", TRUE, TRUE)
    capture = Capture.open(source)
    written(capture, tmp_path / "out", loader(capture, length))
    assert len(list((tmp_path / "out/depths").glob("*.npy"))) == 3
    check(tmp_path / "out", length)


def test_the_mask_of_a_pixel_that_is_used_is_never_0_however_little_is_known_of_it(tmp_path):
    """Trainers leave out pixels whose mask is 0."""
    capture = Capture.open(write_transforms(tmp_path / "scan", TRUE, TRUE))
    load = loader(capture)

    def unsure(name: str) -> SplatFrame:
        found = load(name)
        confidence = np.zeros_like(found.depth.confidence)
        confidence[:, 100:] = 0.001
        return replace(found, depth=replace(found.depth, confidence=confidence))

    written(capture, tmp_path / "out", unsure)
    mask = np.asarray(Image.open(tmp_path / "out/depth_masks/f02.png"))
    np.testing.assert_array_equal(mask, sure_of().astype(np.uint8))


def test_images_with_a_lens_are_written_without_it_and_without_their_masks(tmp_path):
    source = write_transforms(tmp_path / "scan", TRUE, TRUE)
    capture = Capture.open(source)
    lens = Distortion("opencv", np.array([-0.1, 0.01, 0.0, 0.0]))
    capture.frames = [replace(frame, lens=lens) for frame in capture.frames]
    written(capture, tmp_path / "out", loader(capture), transforms_of(source))
    image = np.asarray(Image.open(tmp_path / "out/images/f02.png"))
    straight = cv2.undistort(render(TRUE[2])[0], K, lens.coefficients)
    assert np.abs(image.astype(int) - straight).mean() < 0.6


def test_turned_pictures_stay_as_stored(tmp_path):
    source = write_transforms(tmp_path / "scan", TRUE, TRUE)
    path = source / "images/f02.png"
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.open(path).save(path, exif=exif)
    capture = Capture.open(source)
    written(capture, tmp_path / "out", loader(capture), transforms_of(source))
    check(tmp_path / "out")
    assert (tmp_path / "out/images/f02.png").read_bytes() == path.read_bytes()


def test_any_other_capture_gets_one_too(tmp_path):
    twin = euroc(tmp_path / "scan")
    capture = Capture.open(twin.path)

    def load(name: str) -> SplatFrame:
        frame = capture.frame(name)
        depth = render(frame.E, frame.size, frame.K)[1].astype(np.float32)
        found = DepthFrame(name, depth, np.ones_like(depth), frame.K, frame.E)
        return SplatFrame(found, np.ones(depth.shape, bool))

    written(capture, tmp_path / "out", load, names=capture.names)
    again = Capture.open(tmp_path / "out")
    assert again.unit == "m" and again.names == capture.names
    for one, other in zip(again.frames, capture.frames, strict=True):
        np.testing.assert_allclose(one.E, other.E, atol=1e-9)
        np.testing.assert_allclose(again.image(one.name), capture.image(other.name), atol=1e-6)


def test_the_axes_are_opengls_and_pixels_begin_at_a_corner(tmp_path):
    """By the arithmetic of ``nerfstudio.cameras.cameras``: rays of pixel centres, x right, y up, z back."""
    source = write_transforms(tmp_path / "scan", TRUE, TRUE)
    capture = Capture.open(source)
    data = written(capture, tmp_path / "out", loader(capture))
    row, column, frame = 120, 77, data["frames"][1]
    x, y = (column + 0.5 - data["cx"]) / data["fl_x"], -(row + 0.5 - data["cy"]) / data["fl_y"]
    depth = np.asarray(Image.open(tmp_path / "out" / frame["depth_file_path"]))[row, column] * 1e-3
    matrix = np.array(frame["transform_matrix"])
    point = matrix[:3, :3] @ np.array([x, y, -1]) * depth + matrix[:3, 3]
    ray = np.linalg.inv(K) @ [column, row, 1] * render(TRUE[2])[1][row, column]
    np.testing.assert_allclose(point, TRUE[2][:3, :3] @ ray + TRUE[2][:3, 3], atol=2e-3)
    np.testing.assert_allclose(matrix, TRUE[2] @ FLIP, atol=1e-9)
