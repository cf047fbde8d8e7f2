"""COLMAP models: folders, models with all their points, binary files as COLMAP writes them."""

import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.sfm import model_files, read_colmap_model, read_colmap_points
from tests.contracts.calibrations import SAMPLES, choice

CAMERAS, IMAGES = SAMPLES["colmap"]
POINTS = "# 3D point list\n17 1 -2 3.5 10 20 255 0.25 1 0 2 0 3 0\n18 1 -2 4.5 10 20 255 0.25 1 1 3 1\n"


def test_a_model_of_many_images_is_read_without_its_points(tmp_path, monkeypatch):
    """The points of a hundred images exceed what any other calibration has, and no pair needs them."""
    (tmp_path / "images.bin").write_bytes(b"\0")
    with pytest.raises(IsADirectoryError, match="got the folder"):
        read_calibration(tmp_path)
    monkeypatch.setattr("geodiff_plugin.formats.files.LARGEST_TEXT_BYTES", 20_000)
    points = " ".join(["512.25 40.5 7", "3 200 -1"] * 3000)
    (tmp_path / "cameras.txt").write_text(CAMERAS)
    (tmp_path / "images.txt").write_text(IMAGES.replace("320.5 240.25 17", points))
    assert read_calibration(tmp_path, **choice("colmap")).E[0, 3] == pytest.approx(0.12)
    moved = (tmp_path / "images.txt").read_text().replace("rig/right.jpg", "rig/renamed.jpg")
    (tmp_path / "images.txt").write_text(moved)  # what is remembered is that of the old file
    with pytest.raises(ValueError, match="one of the 3 in"):
        read_calibration(tmp_path, **choice("colmap"))
    (tmp_path / "images.txt").write_text(points)
    with pytest.raises(ValueError, match="calibration must be a calibration file.*; got .* bytes"):
        read_calibration(tmp_path, **choice("colmap"))


@pytest.fixture
def models(tmp_path):
    """Folders of the sample's model in text and in COLMAP's binary, with a point that three images see."""
    pycolmap = pytest.importorskip("pycolmap")
    text, binary = tmp_path / "txt", tmp_path / "bin"
    first, other, right = IMAGES.split("320.5 240.25 17\n")[:3]
    seen = "320.5 240.25 17", " 30 40 18"  # the second point is not seen by the other image
    images = f"{first}{seen[0]}{seen[1]}\n{other}{seen[0]}\n{right}{seen[0]}{seen[1]}\n"
    for folder in (text, binary):
        folder.mkdir()
    for name, content in (("cameras", CAMERAS), ("images", images), ("points3D", POINTS)):
        (text / f"{name}.txt").write_text(content)
    pycolmap.Reconstruction(str(text)).write_binary(str(binary))
    return text, binary


def test_binary_models_are_those_in_text_and_known_points_are_seen_three_times(models):
    rigs = [read_calibration(folder, **choice("colmap")) for folder in models]
    np.testing.assert_array_equal(rigs[0].E, rigs[1].E)
    np.testing.assert_array_equal([rig.K_left for rig in rigs], [rigs[0].K_left] * 2)
    (cameras, images), (others, twins) = (read_colmap_model(model_files(folder)) for folder in models)
    assert cameras.keys() == others.keys() == {1, 2} and cameras[1].size == others[1].size == (640, 480)
    for name, (number, T, camera) in images.items():
        assert (number, camera) == (twins[name][0], twins[name][2])
        np.testing.assert_allclose(T, twins[name][1], atol=1e-12)
    for folder in models:
        points = read_colmap_points(folder)
        assert points.keys() == {1, 2, 3} and all(xyz.tolist() == [[1, -2, 3.5]] for xyz in points.values())


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_cut_off_binary_file_is_named(models, name):
    path = models[1] / name
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(InputError, match=rf"{name} must be a binary COLMAP file; got less.*cut off"):
        read_colmap_points(models[1]) if name[0] == "p" else read_calibration(models[1], **choice("colmap"))
