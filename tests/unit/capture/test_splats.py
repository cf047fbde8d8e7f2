"""``transforms.json`` for trainers of splats, from a capture whose frames all have cameras of their own."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from geodiff_plugin.cameras import Camera, Distortion
from geodiff_plugin.capture import splats
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.capture.splats import SplatFrame, write_splats
from geodiff_plugin.formats.clouds import Cloud
from geodiff_plugin.formats.transforms import transforms_of
from tests.contracts.captures import euroc
from tests.contracts.captures_in_folders import colmap_text
from tests.unit.capture.cameras import ES, KS, NAMES, SIZES, depth_of, image_of, write_capture
from tests.unit.capture_room import FLIP, HALF, SIZE, K, render, walk, write_transforms
from tests.views import posed_frame

LENS = Distortion("opencv", np.array([-0.1, 0.0, 0.0, 0.0]))
ORDER = ["c", "a", "d"]
CLOUD = Cloud(
    np.random.default_rng(0).uniform(-2, 2, (50, 3)),
    np.random.default_rng(1).integers(0, 256, (50, 3), np.uint8),
)


def sure_of(number: int) -> np.ndarray:
    return np.random.default_rng(number).random(depth_of(number).shape) < 0.8


def confidence_of(number: int) -> np.ndarray:
    return np.random.default_rng(10 + number).uniform(0, 1, depth_of(number).shape).astype(np.float32)


def load(name: str, metres: float = 1.0) -> SplatFrame:
    """A frame of the room, of which ``metres`` are a unit."""
    number = NAMES.index(name)
    E = ES[number].copy()
    E[:3, 3] *= metres
    depth = depth_of(number) * np.float32(metres)
    return SplatFrame(posed_frame(name, depth, confidence_of(number), KS[number], E), sure_of(number))


def exported(capture: Capture, folder, original=None, metres: float = 1.0) -> dict:
    write_splats(folder, capture, ORDER, lambda name: load(name, metres), CLOUD, original)
    return json.loads((folder / "transforms.json").read_text())


def nerfstudio_points(folder, data: dict, entry: dict) -> tuple[np.ndarray, np.ndarray]:
    """World points of the known pixels, and which those are, by nerfstudio's arithmetic."""
    camera = data | entry
    path = folder / entry["depth_file_path"]
    units = np.load(path) if path.suffix == ".npy" else np.asarray(Image.open(path))
    assert units.shape == (camera["h"], camera["w"])
    v, u = np.nonzero(units)
    x, y = (u + 0.5 - camera["cx"]) / camera["fl_x"], -(v + 0.5 - camera["cy"]) / camera["fl_y"]
    rays = np.stack([x, y, -np.ones(len(u))], -1)
    matrix, depth = np.array(entry["transform_matrix"]), units[v, u] * camera["depth_unit_scale_factor"]
    return (rays * depth[:, None]) @ matrix[:3, :3].T + matrix[:3, 3], units > 0


@pytest.mark.parametrize("unit", ["m", None])
def test_depth_and_cameras_of_every_frame_put_the_walls_where_they_are(unit, tmp_path):
    """In the lengths that the capture came with, of which one is a fifth of a metre here."""
    capture = Capture.open(write_capture(tmp_path / "scan"))
    capture.rescale(0.2)
    capture.unit = unit
    folder = tmp_path / "out"
    data = exported(capture, folder, metres=0.2)
    assert [entry["file_path"] for entry in data["frames"]] == [f"images/{name}.png" for name in ORDER]
    assert data["camera_model"] == "OPENCV"
    assert {key: data.get(key) for key in ("metres_per_unit",)} == {"metres_per_unit": 0.2 if unit else None}
    np.testing.assert_array_equal(data["applied_transform"], np.eye(4)[:3])
    for name, entry in zip(ORDER, data["frames"], strict=True):
        number = NAMES.index(name)
        points, known = nerfstudio_points(folder, data, entry)
        np.testing.assert_array_equal(known, sure_of(number))
        assert np.abs(np.abs(points) - HALF).min(1).max() < 2e-3
        with (
            Image.open(folder / entry["file_path"]) as image,
            Image.open(folder / entry["depth_mask_path"]) as mask,
        ):
            np.testing.assert_allclose(np.asarray(image) / 255, image_of(number), atol=1e-6)
            used = np.where(known, np.maximum(255 * confidence_of(number), 1), 0)
            assert np.abs(np.asarray(mask) - used).max() < 0.51
        assert not {"fl_x", "fl_y", "cx", "cy", "w", "h"} - set(entry) and not set(entry) & {
            "k1",
            "k2",
            "p1",
            "p2",
        }
        assert "original_path" not in entry
    assert [data[key] for key in ("k1", "k2", "p1", "p2")] == [0, 0, 0, 0]
    read = trimesh.load(folder / data["ply_file_path"], process=False)
    np.testing.assert_allclose(read.vertices, CLOUD.points_m / 0.2, rtol=1e-5)
    np.testing.assert_array_equal(read.colors[:, :3], CLOUD.colours)
    again = Capture.open(folder)
    assert again.names == ORDER


def test_cameras_that_frames_have_in_common_are_written_once(tmp_path):
    """And nothing that only the first and the last have in common."""
    capture = Capture.open(write_capture(tmp_path / "scan"))
    K = KS[0].copy()
    K[0, 0] = KS[1][0, 0]

    def alike(name: str) -> SplatFrame:
        found = load("a")
        camera = replace(found.depth.camera, K=KS[0] if name == "a" else K)
        return replace(found, depth=replace(found.depth, name=name, camera=camera))

    write_splats(tmp_path / "out", capture, ORDER, alike, CLOUD, None)
    data = json.loads((tmp_path / "out/transforms.json").read_text())
    assert data["fl_y"] == KS[0][1, 1] and (data["w"], data["h"]) == SIZES[0]
    assert [entry["fl_x"] for entry in data["frames"]] == [K[0, 0], KS[0][0, 0], K[0, 0]]
    assert "fl_x" not in data and not any("fl_y" in entry or "w" in entry for entry in data["frames"])


def test_fields_of_the_original_other_than_cameras_and_depth_are_kept(tmp_path):
    source = write_capture(tmp_path / "scan", with_depth=True)
    said = json.loads((source / "transforms.json").read_text())
    said |= {
        "aabb_scale": 4,
        "ply_file_path": "old.ply",
        "integer_depth_scale": 5.0,
        "is_fisheye": False,
        "scene": "room",
    }
    said |= {"train_filenames": ["d.png", "b.png"], "val_filenames": ["c.png"], "test_filenames": "none"}
    for entry in said["frames"]:
        entry |= {
            "sharpness": 3.0,
            "depth_path": "x",
            "k1": 0.0,
            "mask_path": f"masks/{entry['file_path']}",
            "note": entry["file_path"],
        }
    said["frames"][0]["mask_path"] = "masks/none.png"  # is not there
    (source / "transforms.json").write_text(json.dumps(said))
    (source / "masks").mkdir()
    masks = {name: np.arange(w)[None].repeat(h, 0) > 5 for name, (w, h) in zip(NAMES, SIZES, strict=True)}
    for name, valid in masks.items():
        Image.fromarray(valid.astype(np.uint8) * 255).save(source / f"masks/{name}.png")
    capture = Capture.open(source)
    last = capture.frames[3]
    capture.frames[3] = replace(last, camera=replace(last.camera, lens=LENS))
    data = exported(capture, tmp_path / "out", transforms_of(source))
    assert (data["aabb_scale"], data["scene"], data["ply_file_path"]) == (4, "room", "points.ply")
    assert data["train_filenames"] == ["images/d.png"] and data["val_filenames"] == ["images/c.png"]
    assert data["test_filenames"] == "none" and "applied_transform" not in data
    assert not set(data) & {"integer_depth_scale", "is_fisheye"}
    masked = {}
    for name, entry in zip(ORDER, data["frames"], strict=True):
        assert entry["sharpness"] == 3.0 and "depth_path" not in entry and entry["note"] == f"{name}.png"
        masked[name] = entry.get("mask_path")
        number = NAMES.index(name)
        assert (entry["w"], entry["h"]) == SIZES[number]
    assert masked == {"c": "masks/c.png", "a": None, "d": "masks/d.png"}
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "out/masks/c.png")) > 0, masks["c"])
    # An image with lens distortion has the mask of the undistorted image.
    straight = np.asarray(Image.open(tmp_path / "out/masks/d.png")) > 0
    np.testing.assert_array_equal(straight, capture.valid("d"))


@pytest.mark.parametrize(
    ("units", "suffix"),
    [
        ([65535.0, 900.0, 0.0], ".png"),
        ([65536.0, 900.0, 0.0], ".npy"),
        ([500.0, 500.4, 3.0], ".png"),
        ([499.0, 499.0, 2000.0], ".npy"),
        ([0.0, 0.0, 0.0], ".png"),
        ([0.0, 0.0, 700.3], ".png"),
    ],
)
def test_units_are_whole_where_they_fit_and_are_fine_enough(units, suffix, tmp_path):
    """What is unknown does not count as a coarse value."""
    (tmp_path / "depths").mkdir()
    values = np.array([units])
    path = splats._write_units(tmp_path, "f", values)
    assert path == f"depths/f{suffix}"
    read = np.load(tmp_path / path) if suffix == ".npy" else np.asarray(Image.open(tmp_path / path))
    assert read.dtype == (np.float32 if suffix == ".npy" else np.uint16)
    np.testing.assert_allclose(read, values, atol=0.5 if suffix == ".png" else 0)


@pytest.mark.parametrize(
    ("change", "suffix", "copied"),
    [
        ({}, ".jpg", True),
        ({"camera": Camera(KS[1], SIZES[1], LENS)}, ".png", False),
        ({"as_stored": True, "turned": True}, ".jpg", True),
        ({"turned": True}, ".png", False),
        ({"heic": True}, ".png", False),
        ({"index": 2}, ".png", False),
    ],
)
def test_images_are_copied_if_a_trainer_reads_them_as_they_are(change, suffix, copied, tmp_path, monkeypatch):
    capture = Capture.open(write_capture(tmp_path / "scan"))
    exif, path = Image.Exif(), tmp_path / ("b.HEIC" if change.pop("heic", False) else "b.JPG")
    if change.pop("turned", False):
        exif[0x0112] = 3
    Image.open(tmp_path / "scan/b.png").save(path, "JPEG", exif=exif)
    frame = replace(capture.frames[1], image=path, **({"as_stored": False} | change))
    shown = np.random.default_rng(0).random((*SIZES[1][::-1], 3))
    monkeypatch.setattr(capture, "image", lambda name: shown if name == "b" else None)
    (tmp_path / "images").mkdir()
    found = splats._write_image(tmp_path, capture, frame)
    assert found == f"images/b{suffix}"
    if copied:
        assert (tmp_path / found).read_bytes() == path.read_bytes()
    else:
        assert np.abs(np.asarray(Image.open(tmp_path / found)) - 255 * shown).max() < 0.51


def test_points_to_start_from_are_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr(splats, "MAX_POINTS", 20)
    capture = Capture.open(write_capture(tmp_path / "scan"))
    exported(capture, tmp_path / "out")
    assert len(trimesh.load(tmp_path / "out/points.ply", process=False).vertices) == 20


TRUE = walk(4)
NAMES_SPLATS = ["f00", "f02", "f03"]
CLOUD_SPLATS = Cloud(np.array([[0.5, 0.25, 2.6], [1.0, 0.0, 2.0]]), np.full((2, 3), 9, np.uint8))


def sure_of_of_splats() -> np.ndarray:
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
        return SplatFrame(posed_frame(name, depth, confidence, K, E), sure_of_of_splats())

    return load


def written(capture: Capture, folder: Path, load, original=None, names=NAMES_SPLATS) -> dict:
    write_splats(folder, capture, names, load, CLOUD_SPLATS, original)
    return json.loads((folder / "transforms.json").read_text())


def check(folder: Path, length: float = 1.0) -> Capture:
    """Our own reader finds cameras, images and depth as they are, in units of ``length`` metres."""
    again = Capture.open(folder)
    assert again.names == NAMES_SPLATS
    for name, frame in zip(NAMES_SPLATS, again.frames, strict=True):
        true = TRUE[int(name[1:])]
        np.testing.assert_allclose(frame.E[:3, :3], true[:3, :3], atol=1e-9)
        np.testing.assert_allclose(frame.E[:3, 3], true[:3, 3] / length, atol=1e-9)
        np.testing.assert_allclose(frame.camera.K, K, atol=1e-9)
        depth, known = again.measured_depth(name)
        np.testing.assert_array_equal(known, sure_of_of_splats())
        np.testing.assert_allclose(depth[known] * length, render(true)[1][known], atol=6e-4 * length)
        np.testing.assert_allclose(again.image(name), render(true)[0] / 255, atol=1e-6)
        mask = np.asarray(Image.open(folder / "depth_masks" / f"{name}.png"))
        np.testing.assert_array_equal(mask, np.where(sure_of_of_splats(), 204, 0))
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
    Image.fromarray(np.uint8(255) * (np.indices(SIZE[::-1])[1] > 9)).save(source / "masks/f02.png")
    capture = Capture.open(source)
    capture.rescale(1.0)
    data = written(capture, tmp_path / "out/nerfstudio", loader(capture), transforms_of(source))
    check(tmp_path / "out/nerfstudio")
    assert data["aabb_scale"] == 16 and data["train_filenames"] == ["images/f00.png"]
    assert "applied_scale" not in data and data["ply_file_path"] == "points.ply"
    assert data["depth_unit_scale_factor"] == 0.001 and data["fl_x"] == K[0, 0]
    frame = data["frames"][1]
    mask = np.asarray(Image.open(tmp_path / "out/nerfstudio" / frame["mask_path"]))
    assert frame["sharpness"] == 7.5 and np.array_equal(
        mask, np.asarray(Image.open(source / "masks/f02.png"))
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
    np.testing.assert_allclose(rows["xyz"], CLOUD_SPLATS.points_m / 2.5, rtol=1e-6)


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
    np.testing.assert_array_equal(mask, sure_of_of_splats().astype(np.uint8))


def test_images_with_a_lens_are_written_without_it_and_without_their_masks(tmp_path):
    source = write_transforms(tmp_path / "scan", TRUE, TRUE)
    capture = Capture.open(source)
    lens = Distortion("opencv", np.array([-0.1, 0.01, 0.0, 0.0]))
    capture.frames = [replace(f, camera=replace(f.camera, lens=lens)) for f in capture.frames]
    written(capture, tmp_path / "out", loader(capture), transforms_of(source))
    image = np.asarray(Image.open(tmp_path / "out/images/f02.png"))
    straight = cv2.undistort(render(TRUE[2])[0], K, lens.coefficients)
    assert np.abs(image.astype(int) - straight).mean() < 0.6


def test_rotated_images_stay_as_stored(tmp_path):
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
        depth = render(frame.E, frame.size, frame.camera.K)[1].astype(np.float32)
        found = posed_frame(name, depth, np.ones_like(depth), frame.camera.K, frame.E)
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
