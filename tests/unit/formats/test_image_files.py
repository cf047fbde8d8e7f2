"""Images of a folder, and those that a file of cameras names, wherever they are stored."""

from pathlib import Path

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import image_files
from geodiff_plugin.formats.image_files import (
    colmap_mask,
    files_of,
    find_images,
    find_mask,
    find_moved,
    image_folders,
    images_in,
    is_any_there,
)


def touch(root: Path, *names: str) -> Path:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return root


def relative(root: Path, paths) -> list[str | None]:
    return [None if path is None else path.relative_to(root).as_posix() for path in paths]


def test_images_of_a_folder_are_sorted_by_number_and_hidden_files_are_none(tmp_path):
    suffixes = ("jpg", "jpeg", "png", "webp", "bmp", "tif", "tiff", "heic", "JPG")
    touch(
        tmp_path, *(f"f{10 - n}.{suffix}" for n, suffix in enumerate(suffixes)), "._f1.jpg", "f0.txt", "f.raw"
    )
    assert relative(tmp_path, images_in(tmp_path)) == [f"f{10 - n}.{suffixes[n]}" for n in range(8, -1, -1)]
    assert images_in(tmp_path / "none") == []


def test_files_of_a_path_are_itself_or_those_of_its_folder_pattern_by_pattern(tmp_path):
    touch(tmp_path, "b.xml", "a.xml", "c.json", "d.xml/e", "sub/f.xml")
    assert relative(tmp_path, files_of(tmp_path, "*.json", "*.xml")) == ["c.json", "a.xml", "b.xml"]
    assert relative(tmp_path, files_of(tmp_path, "*/*.xml")) == ["sub/f.xml"]
    assert list(files_of(tmp_path / "a.xml", "*.json", "*.xml")) == [tmp_path / "a.xml"]
    assert list(files_of(tmp_path / "a.xml", "*.json")) == []
    assert list(files_of(tmp_path / "none", "*.xml")) == []


def test_usual_folders_of_images_come_behind_the_folder_itself_smaller_copies_last(tmp_path):
    touch(
        tmp_path,
        *(f"a/{name}/x" for name in ("images_8", "images", "input", "images_2", "other")),
        "b/images/x",
    )
    expected = ["a", "a/images", "a/input", "a/images_2", "a/images_8", "b", "b/images"]
    folders = image_folders(tmp_path / "a", tmp_path / "b", tmp_path / "a", tmp_path / "none")
    assert relative(tmp_path, folders) == expected


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["one/f1.png", "two/f1.png"], ["one/f1.png", "two/f1.png"]),
        (["C:\\set\\one\\f1.png"], ["one/f1.png"]),
        (["/data/other/one/f1.png"], ["one/f1.png"]),
        (["./one/f1.png"], ["one/f1.png"]),
        (["one/f1.jpg"], ["one/f1.png"]),  # another suffix
        (["one/f1"], ["one/f1.png"]),  # none
        (["one/F1.PNG"], ["one/f1.png"]),
        (["f2.jpg"], ["f2.JPG.jpg"]),  # as OpenSfM adds one
        (["f3.png"], [None]),  # two of the same stem
        (["three/f1.png"], [None]),
        (["notes.txt"], [None]),
        ([""], [None]),
    ],
)
def test_names_are_found_whole_or_by_their_last_parts(names, expected, tmp_path):
    touch(tmp_path, "one/f1.png", "two/f1.png", "f2.JPG.jpg", "f3.jpg", "f3.tif", "notes.txt")
    assert relative(tmp_path, find_images(names, [tmp_path])) == expected


def test_folders_are_searched_in_order_and_a_file_in_full_goes_before_one_by_its_end(tmp_path):
    touch(tmp_path, "a/f1.png", "b/f1.png", "b/set/f1.png", "b/f2.png", "a/f4.tif", "b/f4.png")
    folders = [tmp_path / "a", tmp_path / "b"]
    names = ["f1.png", "set/f1.png", "f2.png", "f4.png", "f5.png"]
    expected = ["a/f1.png", "b/set/f1.png", "b/f2.png", "b/f4.png", None]
    assert relative(tmp_path, find_images(names, folders)) == expected
    assert relative(tmp_path, find_images(names[:3], folders[::-1])) == [
        "b/f1.png",
        "b/set/f1.png",
        "b/f2.png",
    ]


def test_a_file_that_two_names_mean_belongs_to_the_one_in_full_or_to_none(tmp_path):
    touch(tmp_path, "f1.png", "f2.png")
    names = ["x/f1.png", "f1.png", "x/f2.png", "y/f2.png"]
    assert relative(tmp_path, find_images(names, [tmp_path])) == [None, "f1.png", None, None]
    assert is_any_there(["x/f2.png", "y/f2.png"], [tmp_path]) and not is_any_there(["f3.png"], [tmp_path])


def test_a_name_of_very_many_parts_is_looked_for_by_its_last_ones(tmp_path):
    touch(tmp_path, "f1.png", "k/f2.png")
    for depth, found in ((30, True), (200, True)):
        names = ["/".join(["d"] * depth + ["f1.png"]), "/".join(["d"] * depth + ["k", "f2.png"])]
        assert relative(tmp_path, find_images(names, [tmp_path])) == (
            ["f1.png", "k/f2.png"] if found else [None] * 2
        )
    deep = "/".join(str(n) for n in range(40))
    touch(tmp_path, *(f"{'/'.join(str(n) for n in range(start, 40))}/f.png" for start in (9, 8)))
    assert relative(tmp_path, find_images([f"{deep}/f.png"], [tmp_path])) == [
        f"{'/'.join(map(str, range(9, 40)))}/f.png"
    ]


NAMES = [f"set/f{n}.jpg" for n in range(4)]


@pytest.mark.parametrize(
    ("place", "levels", "found"),
    [
        ("p/q/model/x/y", 2, True),  # below
        ("p/q/x", 2, True),  # one above
        ("p/x", 2, True),
        ("x", 2, False),  # three above
        ("p/x", 1, False),
        ("p/q/model/1/2/3/4/5", 0, True),
        ("p/q/model/1/2/3/4/5/6", 0, False),
        ("p/q/model/depth_maps", 0, False),
        ("p/q/model/Masks", 0, False),
        ("p/q/model/.hidden", 0, False),
        ("p/q/model/mine", 0, False),
    ],
)
def test_moved_images_are_found_near_the_file_but_not_among_others(place, levels, found, tmp_path):
    folder = tmp_path / "p" / "q" / "model"
    folder.mkdir(parents=True)
    touch(tmp_path / place, *(f"f{n}.jpg" for n in range(4)))
    moved = find_moved(NAMES, folder, levels, other=("mine",))
    assert (moved is not None) == found
    if moved is not None:
        assert moved.below == tmp_path / place
        assert relative(tmp_path / place, moved.files) == [f"f{n}.jpg" for n in range(4)]


@pytest.mark.parametrize(("there", "found"), [(0, False), (1, False), (2, True), (3, True)])
def test_half_of_the_images_must_be_found_in_one_go(there, found, tmp_path):
    root = touch(tmp_path / "p" / "q", *(f"a/f{n}.jpg" for n in range(there)), "other/x")
    moved = find_moved(NAMES, root / "other" / "y")  # by default two folders above are looked through
    assert (moved is not None) == found
    if moved is not None:
        assert relative(root, moved.files) == [f"a/f{n}.jpg" for n in range(there)] + [None] * (4 - there)
    assert find_moved([], root, 0) is None
    assert find_moved(["none.jpg"], root, 0) is None


def test_a_folder_of_another_capture_is_skipped_but_not_the_one_that_is_searched(tmp_path):
    touch(tmp_path, "transforms.json", "other/sparse/x", *(f"other/f{n}.jpg" for n in range(4)))
    touch(tmp_path, *(f"other/deep/f{n}.jpg" for n in range(4)))
    assert find_moved(NAMES, tmp_path, 0) is None
    touch(tmp_path, *(f"mine/f{n}.jpg" for n in range(4)))
    assert find_moved(NAMES, tmp_path, 0).below == tmp_path / "mine"


def test_of_files_of_one_name_the_one_that_shares_most_of_the_path_is_meant(tmp_path):
    touch(
        tmp_path, "x/a/set/f1.jpg", "x/b/set/f1.jpg", "x/c/f1.jpg", "x/a/set/f2.png", "x/c/f2.jpg", "x/f3.jpg"
    )
    names = ["a/set/f1.jpg", "set/f2.jpg", "k/f3.jpg"]
    moved = find_moved(names, tmp_path, 0)
    assert relative(tmp_path, moved.files) == ["x/a/set/f1.jpg", "x/a/set/f2.png", "x/f3.jpg"]
    assert moved.below == tmp_path / "x"
    with pytest.raises(
        InputError, match=r"the images must be files with unambiguous names; got .* and .* for set/f1"
    ):
        find_moved(["set/f1.jpg"], tmp_path, 0)
    names = ["a/set/f1.jpg", "b/set/f1.jpg"]
    assert relative(tmp_path, find_moved(names, tmp_path, 0).files) == ["x/a/set/f1.jpg", "x/b/set/f1.jpg"]


def test_an_end_of_the_same_suffix_goes_before_another_suffix(tmp_path):
    touch(tmp_path, "a/f1.jpg", "b/f1.png")
    assert relative(tmp_path, find_moved(["f1.png"], tmp_path, 0).files) == ["b/f1.png"]
    touch(tmp_path, "c/f1.tif")
    assert relative(tmp_path, find_moved(["x/f1.jpg"], tmp_path, 0).files) == ["a/f1.jpg"]


def test_a_huge_folder_is_not_listed_to_its_end(tmp_path, monkeypatch):
    touch(tmp_path, *(f"a/f{n}.jpg" for n in range(4)), "b/1", "b/2")
    for most, found in ((8, True), (7, True), (5, False)):
        monkeypatch.setattr(image_files, "MAX_LISTED", most)
        assert (find_moved(NAMES, tmp_path, 0) is not None) == found


def test_a_mask_has_the_name_of_its_image_and_its_folders(tmp_path):
    touch(tmp_path, "a.png", "b.jpg.png", "cam1/a.png", "c.bmp")
    image = Path("/scan/images")
    assert find_mask(tmp_path, image / "a.jpg") == tmp_path / "a.png"
    assert find_mask(tmp_path, image / "b.jpg") == tmp_path / "b.jpg.png"
    assert find_mask(tmp_path, image / "c.jpg") == tmp_path / "c.bmp"
    assert find_mask(tmp_path, image / "cam1/a.jpg") == tmp_path / "cam1/a.png"
    assert find_mask(tmp_path, image / "cam2/a.jpg") == tmp_path / "a.png"
    assert (
        find_mask(tmp_path, image / "d.jpg") is None
        and find_mask(tmp_path, Path("/a.jpg")) == tmp_path / "a.png"
    )


def test_masks_of_colmap_are_next_to_the_image_folder(tmp_path):
    touch(tmp_path, "masks/a.jpg.png", "masks/cam/b.png.png", "flat/masks/c.jpg.png", "masks/e.png")
    images = tmp_path / "images"
    assert colmap_mask(images / "a.jpg") == tmp_path / "masks/a.jpg.png"
    assert colmap_mask(images / "cam/b.png") == tmp_path / "masks/cam/b.png.png"
    assert colmap_mask(tmp_path / "flat/c.jpg") == tmp_path / "flat/masks/c.jpg.png"
    for name in ("cam/a.jpg", "b.png", "e.jpg"):
        assert colmap_mask(images / name) is None
