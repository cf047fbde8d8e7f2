"""COLMAP models: folders, models with all their points, binary files."""

from __future__ import annotations

import re
import struct

import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.colmap import read_colmap_cameras, read_colmap_images, read_colmap_points
from tests.contracts import factory_calibrations as factory


def test_colmap_folder(tmp_path):
    (tmp_path / "images.bin").write_bytes(b"\0")
    with pytest.raises(IsADirectoryError, match="a COLMAP model with its cameras and images"):
        read_calibration(tmp_path)
    (tmp_path / "cameras.txt").write_text(factory.COLMAP_CAMERAS)
    (tmp_path / "images.txt").write_text(factory.COLMAP_IMAGES)
    assert read_calibration(tmp_path, **factory.COLMAP_CHOICE).E[0, 3] == pytest.approx(0.12)


def test_colmap_model_of_many_images_with_all_their_points(tmp_path, monkeypatch):
    """The points of a hundred images exceed what any other calibration has, and no pair needs them."""
    monkeypatch.setattr("geodiff_plugin.formats.files.LARGEST_TEXT_BYTES", 20_000)
    points = " ".join(["512.25 40.5 7", "3 200 -1"] * 3000)
    (tmp_path / "cameras.txt").write_text(factory.COLMAP_CAMERAS)
    (tmp_path / "images.txt").write_text(factory.COLMAP_IMAGES.replace("320.5 240.25 17", points))
    assert read_calibration(tmp_path, **factory.COLMAP_CHOICE).E[0, 3] == pytest.approx(0.12)
    moved = (tmp_path / "images.txt").read_text().replace("rig/right.jpg", "rig/renamed.jpg")
    (tmp_path / "images.txt").write_text(moved)  # what is remembered is that of the old file
    with pytest.raises(ValueError, match="one of the 3 in"):
        read_calibration(tmp_path, **factory.COLMAP_CHOICE)
    (tmp_path / "images.txt").write_text(points)
    with pytest.raises(ValueError, match="calibration must be a calibration file; got .* bytes"):
        read_calibration(tmp_path, **factory.COLMAP_CHOICE)


def binary_model(folder) -> None:
    """The sample's model as COLMAP writes it in binary, with two points."""
    folder.mkdir()
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 640, 480, 700, 700, 300.5, 200.5)
    (folder / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", 3)
    for number, words in enumerate(
        re.findall(r"^\d+ (.*) 1 (rig/.*)$", factory.COLMAP_IMAGES, re.MULTILINE), 1
    ):
        images += struct.pack("<I7dI", number, *map(float, words[0].split()), 1) + words[1].encode() + b"\0"
        images += struct.pack("<Qddq", 1, 320.5, 240.25, -1)
    (folder / "images.bin").write_bytes(images)
    points = struct.pack("<Q", 2)
    for number, track in ((7, (1, 0, 3, 5)), (9, (2, 4))):
        points += struct.pack("<Q3d3BdQ", number, 1.0, -2.0, 0.5 * number, 10, 20, 255, 0.25, len(track) // 2)
        points += struct.pack(f"<{len(track)}I", *track)
    (folder / "points3D.bin").write_bytes(points)


def test_colmap_binary_models_are_those_in_text(tmp_path):
    binary_model(tmp_path / "bin")
    (tmp_path / "txt").mkdir()
    (tmp_path / "txt" / "cameras.txt").write_text(factory.COLMAP_CAMERAS)
    (tmp_path / "txt" / "images.txt").write_text(factory.COLMAP_IMAGES)
    (tmp_path / "txt" / "points3D.txt").write_text(
        "# 3D point list\n7 1 -2 3.5 10 20 255 0.25 1 0 3 5\n9 1 -2 4.5 10 20 255 0.25 2 4\n"
    )
    rigs = [read_calibration(tmp_path / kind, **factory.COLMAP_CHOICE) for kind in ("bin", "txt")]
    for name in ("K_left", "K_right", "E"):
        np.testing.assert_array_equal(getattr(rigs[0], name), getattr(rigs[1], name))
    assert rigs[0].size_left == rigs[1].size_left == (640, 480)
    cameras, images, points = (
        [read(tmp_path / kind) for kind in ("bin", "txt")]
        for read in (read_colmap_cameras, read_colmap_images, read_colmap_points)
    )
    assert cameras[0].keys() == cameras[1].keys() == {1} and images[0].keys() == images[1].keys()
    for name, (number, T, camera) in images[0].items():
        assert (number, camera) == (images[1][name][0], 1)
        np.testing.assert_array_equal(T, images[1][name][1])
    for ours, theirs in zip(points[0][:3], points[1][:3], strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert [track.tolist() for track in points[0][3]] == [[1, 3], [2]] == [t.tolist() for t in points[1][3]]
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        path = tmp_path / "bin" / name
        path.write_bytes(path.read_bytes()[:-3])
        with pytest.raises(InputError, match=rf"{name} must be a binary COLMAP file; got less.*cut off"):
            (read_colmap_points if name.startswith("p") else read_calibration)(
                tmp_path / "bin", **({} if name.startswith("p") else factory.COLMAP_CHOICE)
            )
        binary_model(tmp_path / name)
        path.write_bytes((tmp_path / name / name).read_bytes())
