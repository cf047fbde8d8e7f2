"""Images of a capture that are not where its camera file states."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin import InputError
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.formats.image_files import find_images, is_any_there
from geodiff_plugin.formats.transforms import transforms_of
from tests.contracts.captures import TRUE, bundler, metashape, nvm, opensfm
from tests.contracts.captures_in_folders import colmap_binary, colmap_text, transforms

#: Where the images of a project ``a/b/scan`` now lie; all but the last are at or near the file of cameras.
PLACES = {
    "another name": "scan/pictures",
    "deeper": "scan/data/camera 0/rgb",
    "beside the project": "pictures",
    "below a folder beside it": "raw/day 1/pictures",
}


def moved(folder: Path, place: str) -> Path:
    """The folder of the images of a project after they were moved to ``place``."""
    target = folder.parent / place
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(folder / "images", target)
    return target


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("write", [transforms, colmap_text, colmap_binary], ids=lambda write: write.__name__)
def test_moved_images_are_found_by_their_names_and_reported(write, place, tmp_path):
    folder = write(tmp_path / "a/b/scan")
    target = moved(folder, PLACES[place])
    path = folder if place == "another name" or write is transforms else folder / "sparse/0"
    if write is not transforms and "beside" in place:  # two folders up from a model is its project
        path = shutil.move(folder / "sparse/0", folder / "model") and folder / "model"
    capture = Capture.open(path)
    assert [frame.image for frame in capture.frames] == [target / f"f{i:02d}.png" for i in range(4)]
    np.testing.assert_allclose([frame.E for frame in capture.frames], TRUE, atol=1e-6)
    assert [finding.code for finding in capture.findings] == ["capture.images-found"]
    assert target.name in capture.findings[0]


@pytest.mark.parametrize("write", [metashape, opensfm, bundler, nvm], ids=lambda write: write.__name__)
def test_every_reader_of_named_images_finds_them(write, tmp_path):
    twin = write(tmp_path / "a/scan")
    images = [frame.image for frame in Capture.open(twin.path).frames]
    target = twin.path / "taken on Monday"
    target.mkdir()
    for image in images:
        shutil.move(image, target)
    for given in (None, target, twin.path):
        capture = Capture.open(twin.path, images=given)
        assert [frame.image for frame in capture.frames] == [target / image.name for image in images]
        reported = "capture.images-found" in [finding.code for finding in capture.findings]
        assert reported == (given is None)


def test_a_renamed_root_of_paths_is_found_and_exported_again(tmp_path):
    folder = transforms(tmp_path / "scan")
    data = json.loads((folder / "transforms.json").read_text())
    for frame in data["frames"]:
        frame["file_path"] = f"D:\\scans\\old\\rgb\\{Path(frame['file_path']).name}"
    (folder / "transforms.json").write_text(json.dumps(data))
    target = moved(folder, "scan/new/rgb")
    assert [frame.image.parent for frame in Capture.open(folder).frames] == [target] * 4
    assert set(transforms_of(folder).frames) == {target / f"f{i:02d}.png" for i in range(4)}


def test_images_spread_over_folders_are_found_each(tmp_path):
    folder = colmap_text(tmp_path / "scan")
    for i, day in enumerate(("mon", "tue", "mon", "tue")):
        (folder / day).mkdir(exist_ok=True)
        shutil.move(folder / f"images/f{i:02d}.png", folder / day)
    assert [frame.image.parent.name for frame in Capture.open(folder).frames] == ["mon", "tue", "mon", "tue"]


def test_two_files_that_a_name_could_mean_are_both_named(tmp_path):
    folder = colmap_text(tmp_path / "scan")
    shutil.copytree(folder / "images", folder / "large")
    shutil.move(folder / "images", folder / "small")
    with pytest.raises(InputError, match=r"(?s)large/f00.png and .*small/f00.png for f00.png.*--images DIR"):
        Capture.open(folder)
    capture = Capture.open(folder, images=folder / "small")
    assert [frame.image.parent.name for frame in capture.frames] == ["small"] * 4


def test_cameras_with_files_of_one_name_keep_theirs(tmp_path):
    """a/rgb/1.png and b/rgb/1.png: below a renamed root by their folders, else not at all."""
    folder = colmap_text(tmp_path / "a/b/scan")
    text = (folder / "sparse/0/images.txt").read_text()
    places = {f"f{i:02d}.png": f"{'ab'[i % 2]}/rgb/{i // 2}.png" for i in range(4)}
    for old, new in places.items():
        text = text.replace(old, new)
        (folder / "raw" / new).parent.mkdir(parents=True, exist_ok=True)
        shutil.move(folder / "images" / old, folder / "raw" / new)
    (folder / "sparse/0/images.txt").write_text(text)
    frames = Capture.open(folder).frames
    assert [frame.image.relative_to(folder / "raw").as_posix() for frame in frames] == sorted(places.values())
    for old, new in (("a", "left"), ("b", "right")):
        (folder / "raw" / old).rename(folder / "raw" / new)
    with pytest.raises(InputError, match=r"left/rgb/0.png and .*right/rgb/0.png for a/rgb/0.png"):
        Capture.open(folder)


@pytest.mark.parametrize("place", ["masks", "depth", "Normals", ".trash", "other/images"])
def test_other_images_are_not_used_as_frames_of_a_capture(place, tmp_path):
    """Masks and depth maps have the images' names, and so have the images of another capture."""
    folder = colmap_text(tmp_path / "a/b/scan")
    (folder / "other").mkdir()
    (folder / "other/transforms.json").write_text("{}")
    moved(folder, f"scan/{place}")
    with pytest.raises(InputError, match="no image file"):
        Capture.open(folder)


def test_names_of_one_file_are_not_sought_elsewhere(tmp_path):
    """Two could mean what lies in the usual place; another capture's files of that name are not these."""
    folder = colmap_text(tmp_path / "a/b/scan")
    shutil.copytree(folder / "images", tmp_path / "a/b/of-another")
    text = (folder / "sparse/0/images.txt").read_text()
    for name, twin in (("f00", "f01"), ("f01", "f01"), ("f02", "f03"), ("f03", "f03")):
        text = text.replace(f" {name}.png", f" {name}/{twin}.png")
    (folder / "sparse/0/images.txt").write_text(text)
    with pytest.raises(InputError, match="no image file"):
        Capture.open(folder)


def test_a_few_chance_names_are_not_taken_for_the_images(tmp_path):
    folder = colmap_text(tmp_path / "a/b/scan")
    target = moved(folder, "scan/odd")
    for i in (1, 2, 3):
        (target / f"f{i:02d}.png").unlink()
    with pytest.raises(InputError, match="no image file"):
        Capture.open(folder)


def test_a_folder_of_images_is_rejected_where_no_file_names_them(tmp_path):
    folder = colmap_text(tmp_path / "scan")
    with pytest.raises(InputError, match=r"omitted unless a file lists the images.*for images"):
        Capture.open(folder / "images", fov=60.0, images=folder / "images")


def test_a_file_belongs_to_the_name_with_its_whole_path(tmp_path):
    """Of the other camera's image of the same moment, which is lost, only the name is left."""
    (tmp_path / "left").mkdir()
    Image.new("RGB", (4, 3)).save(tmp_path / "left/1.png")
    folders, names = [tmp_path, tmp_path / "left"], ["left/1.png", "right/1.png"]
    assert find_images(names, folders) == [tmp_path / "left/1.png", None]
    assert find_images(names[::-1], folders) == [None, tmp_path / "left/1.png"]
    assert find_images(["a/1.png", "b/1.png"], folders) == [None, None]  # either could mean it
    assert is_any_there(["a/1.png", "b/1.png"], folders)
