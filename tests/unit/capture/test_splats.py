"""``transforms.json`` for trainers of splats, from a capture whose frames all have cameras of their own."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

from geodiff_plugin import Capture
from geodiff_plugin.capture import splats
from geodiff_plugin.capture.splats import SplatFrame, write_splats
from geodiff_plugin.formats.clouds import Cloud
from geodiff_plugin.formats.transforms import transforms_of
from geodiff_plugin.types import DepthFrame, Distortion
from tests.unit.capture.cameras import ES, KS, NAMES, SIZES, depth_of, image_of, write_capture
from tests.unit.capture_room import HALF

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
    return SplatFrame(DepthFrame(name, depth, confidence_of(number), KS[number], E), sure_of(number))


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
        return replace(found, depth=replace(found.depth, name=name, K=KS[0] if name == "a" else K))

    write_splats(tmp_path / "out", capture, ORDER, alike, CLOUD, None)
    data = json.loads((tmp_path / "out/transforms.json").read_text())
    assert data["fl_y"] == KS[0][1, 1] and (data["w"], data["h"]) == SIZES[0]
    assert [entry["fl_x"] for entry in data["frames"]] == [K[0, 0], KS[0][0, 0], K[0, 0]]
    assert "fl_x" not in data and not any("fl_y" in entry or "w" in entry for entry in data["frames"])


def test_what_the_original_says_beside_cameras_and_depth_is_kept(tmp_path):
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
            "mask_path": "masks/m.png",
            "note": entry["file_path"],
        }
    said["frames"][0]["mask_path"] = "masks/none.png"  # is not there
    (source / "transforms.json").write_text(json.dumps(said))
    (source / "masks").mkdir()
    Image.fromarray(np.full((9, 9), 255, np.uint8)).save(source / "masks/m.png")
    capture = Capture.open(source)
    capture.frames[3] = replace(capture.frames[3], lens=Distortion("opencv", np.array([-0.1, 0.0, 0.0, 0.0])))
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
    # The mask of an image with lens distortion does not fit the image without it.
    assert masked == {"c": "../scan/masks/m.png", "a": None, "d": None}


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
        ({"lens": Distortion("opencv", np.array([-0.1, 0.0, 0.0, 0.0]))}, ".png", False),
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
    monkeypatch.setattr(splats, "MOST_POINTS", 20)
    capture = Capture.open(write_capture(tmp_path / "scan"))
    exported(capture, tmp_path / "out")
    assert len(trimesh.load(tmp_path / "out/points.ply", process=False).vertices) == 20
