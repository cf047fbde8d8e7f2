"""Readers of captures: every layout gives the same frames, and bad input a sentence."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin import InputError
from geodiff_plugin.capture.capture import Capture
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.clouds import Cloud
from geodiff_plugin.formats.sfm import write_colmap
from tests.unit.capture_room import SIZE, K, render, walk, write_transforms

TRUE = walk(4)
IMAGES = [render(E)[0] for E in TRUE]


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def transforms(folder: Path) -> Path:
    return write_transforms(folder, TRUE, TRUE)


def colmap_text(folder: Path) -> Path:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    views = [(f"f{i:02d}.png", K, E, SIZE) for i, E in enumerate(TRUE)]
    for (name, *_), image in zip(views, IMAGES, strict=True):
        save(folder / "images" / name, image)
    cloud = Cloud(np.array([[0.5, 0.25, 2.6]]), np.full((1, 3), 9, np.uint8))
    seen = [(np.full((1, 2), 10.0), np.zeros(1, int))] * 2 + [(np.zeros((0, 2)), np.zeros(0, int))]
    write_colmap(model, views, cloud, [*seen, seen[0]])
    return folder


def colmap_binary(folder: Path) -> Path:
    model = colmap_text(folder) / "sparse" / "0"
    pytest.importorskip("pycolmap").Reconstruction(str(model)).write_binary(str(model))
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.txt").unlink()
    return folder


def seven_scenes(folder: Path) -> Path:
    for i, (E, image) in enumerate(zip(TRUE, IMAGES, strict=True)):
        save(folder / f"frame-{i:06d}.color.png", image)
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", E, fmt="%.9f")
    np.savetxt(folder / "intrinsics.txt", K)
    return folder


def scannet(folder: Path) -> Path:
    for i, (E, image) in enumerate(zip(TRUE, IMAGES, strict=True)):
        save(folder / "color" / f"{10 * i}.png", image)  # 30 comes after 0, 10, 20
        save(folder / "depth" / f"{10 * i}.png", image)
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / "pose" / f"{10 * i}.txt", E, fmt="%.9f")
    np.savetxt(folder / "intrinsic_color.txt", np.pad(K, (0, 1)) + np.diag([0, 0, 0, 1]))
    return folder


def trajectory(E: np.ndarray, times: np.ndarray) -> str:
    rows = np.c_[times, E[:, :3, 3], Rotation.from_matrix(E[:, :3, :3]).as_quat()]
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(" ".join(f"{v:.9f}" for v in row) for row in rows)


def tum(folder: Path) -> Path:
    for i, image in enumerate(IMAGES):
        save(folder / "rgb" / f"{i}.png", image)
    names = "".join(f"{i}.5 rgb/{i}.png\n" for i in range(4))
    (folder / "rgb.txt").write_text("# timestamp filename\n" + names)
    (folder / "depth.txt").write_text(names.replace(".5", ".51"))
    (folder / "groundtruth.txt").write_text(trajectory(TRUE, np.arange(4) + 0.5))
    np.savetxt(folder / "K.txt", K)
    return folder


LAYOUTS = [transforms, colmap_text, colmap_binary, seven_scenes, scannet, tum]


@pytest.mark.parametrize("write", LAYOUTS, ids=lambda write: write.__name__)
def test_every_layout_gives_the_same_frames(write, tmp_path):
    capture = Capture.open(write(tmp_path / "scan"))
    assert len(capture.frames) == 4 and not capture.notes
    for frame, E in zip(capture.frames, TRUE, strict=True):
        np.testing.assert_allclose(frame.E, E, atol=1e-6)
        np.testing.assert_allclose(frame.K, K, atol=1e-9)
        assert frame.size == SIZE and frame.lens is None and frame.image.is_file()
    assert capture.unit == (None if "colmap" in write.__name__ else "m")
    assert (capture.frames[3].depth is not None) == (write in (transforms, scannet, tum))
    points = [None if frame.points is None else frame.points.tolist() for frame in capture.frames]
    seen = [[0.5, 0.25, 2.6]] if "colmap" in write.__name__ else None
    assert points == [seen, seen, None, seen]


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_binary_models_are_calibrations_and_a_cut_off_file_is_named(tmp_path, name):
    path = colmap_binary(tmp_path) / "sparse" / "0" / name
    rig = read_calibration(path.parent, image_names=("f00.png", "f03.png"), baseline_m=0.3)
    np.testing.assert_allclose(rig.K_right, K)
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(InputError, match=rf"{name} must be a binary COLMAP file; got less.*cut off"):
        Capture.open(tmp_path)


def test_a_video_takes_its_poses_from_a_trajectory(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "v.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, SIZE)
    for image in IMAGES:
        writer.write(image[..., ::-1])
    writer.release()
    (tmp_path / "t.txt").write_text(trajectory(TRUE[:3], np.arange(3) / 10))
    np.savetxt(tmp_path / "K.txt", K)
    capture = Capture.open(tmp_path / "v.mp4", K=K, trajectory=tmp_path / "t.txt")
    assert [frame.index for frame in capture.frames] == [0, 1, 2] and "000003" in capture.notes[0]
    np.testing.assert_allclose([frame.E for frame in capture.frames], TRUE[:3], atol=1e-6)
    with pytest.raises(InputError, match="--fov"):
        Capture.open(tmp_path / "v.mp4")


def test_images_without_poses_take_a_field_of_view(tmp_path):
    for i, image in enumerate(IMAGES):
        save(tmp_path / f"i{i}.png", image)
    capture = Capture.open(tmp_path, fov=60.0)
    assert all(frame.E is None for frame in capture.frames) and capture.unit is None
    np.testing.assert_allclose(capture.frames[0].K[0, 0], 120 / np.tan(np.radians(30)))
    with pytest.raises(InputError, match="K"):
        Capture.open(tmp_path)


def test_units_and_lenses_of_transforms(tmp_path):
    folder = write_transforms(tmp_path, TRUE, TRUE, k1=-0.1)
    path = folder / "transforms.json"
    path.write_text(path.read_text().replace('"transform_matrix"', '"colmap_im_id": 1, "transform_matrix"'))
    capture = Capture.open(folder)
    assert capture.unit is None and capture.frames[0].lens.coefficients[0] == -0.1
    assert capture.frames[0].depth == folder / "depth/f00.png"


def crop(folder: Path, data: dict) -> None:
    Image.fromarray(IMAGES[0][:90]).save(folder / "images/f00.png")


def lose(folder: Path, data: dict) -> None:
    for i in range(3):
        (folder / f"images/f{i:02d}.png").unlink()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lose, "at least two frames"),
        (lambda _, data: [data.pop(key) for key in ("fl_x", "fl_y")], "fl_x"),
        (lambda _, data: data["frames"][1].update(transform_matrix=[[1, 2]]), "transform_matrix"),
        (lambda _, data: data["frames"][1].pop("transform_matrix"), "no 'transform_matrix'"),
        (lambda folder, _: (folder / "images/f00.png").write_bytes(b"?"), "f00.png must be an image file"),
        (crop, "crop"),
    ],
)
def test_bad_captures_get_a_sentence(change, words, tmp_path):
    folder = write_transforms(tmp_path, TRUE, TRUE)
    data = json.loads((folder / "transforms.json").read_text())
    change(folder, data)
    (folder / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=words):
        Capture.open(folder)


def test_missing_images_and_lost_poses_are_named(tmp_path):
    folder = write_transforms(tmp_path / "a", TRUE, TRUE)
    (folder / "images/f01.png").unlink()
    capture = Capture.open(folder)
    assert len(capture.frames) == 3 and "f01" in capture.notes[0]
    lost = seven_scenes(tmp_path / "b")
    (lost / "frame-000002.pose.txt").write_text("-inf " * 16)
    capture = Capture.open(lost)
    assert len(capture.frames) == 3 and "frame-000002" in capture.notes[0]
    with pytest.raises(FileNotFoundError):
        Capture.open(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="none of these"):
        Capture.open(tmp_path / "empty")
