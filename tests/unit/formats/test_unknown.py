"""Error messages for paths that are not captures."""

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import unknown
from geodiff_plugin.formats.captures import LAYOUTS
from geodiff_plugin.formats.layouts import CaptureFormat


def fake(summary, *marks, **more):
    return CaptureFormat(summary, marks, lambda path: None, **more)


FORMATS = (
    fake("two files", "a.txt", "b.txt", names_images=True),
    fake("four parts", ("c.txt", "**/c.bin"), "d.txt", "folder", "other"),
    fake("any xml", "*.xml", names_images=True),
    fake("pictures", "*.jpg", has_poses=False),
)


def touch(folder, *names, text="x"):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        if name.endswith("/"):
            (folder / name).mkdir(parents=True)
        else:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)


def refusal(path, formats=FORMATS) -> str:
    with pytest.raises(InputError) as caught:
        unknown.refuse_unknown(path, formats)
    return str(caught.value)


NONE = "It is none of these: two files, four parts, any xml or pictures."


def test_files_and_empty_folders_get_the_list_of_formats(tmp_path):
    touch(tmp_path, "f.txt", "empty/")
    assert (
        refusal(tmp_path / "f.txt")
        == f"PATH must be a capture that is read; got {tmp_path / 'f.txt'}. {NONE}"
    )
    empty = tmp_path / "empty"
    assert refusal(empty) == f"PATH must be a capture that is read; got {empty}, which holds nothing. {NONE}"
    (tmp_path / "nothing.txt").write_text("")
    assert "which is empty" in refusal(tmp_path / "nothing.txt")


def test_folder_content_is_summarized(tmp_path):
    touch(tmp_path, "1.png", "2.PNG", "3.png", "z/", "y/", "x/", "w/", "v/", "u/", "t/", "Makefile", "4.doc")
    content = unknown._content(tmp_path)
    assert content.startswith("3 .png, 1 ") and content.endswith(", t/, u/, v/, w/, x/, y/")
    assert "1 Makefile" in content and "1 .doc" in content
    touch(tmp_path, *(f"f.{n}" for n in range(9)))
    assert len(unknown._content(tmp_path).split(", ")) == 12


@pytest.mark.parametrize(
    ("there", "nearest"),
    [
        (["a.txt"], "Nearest is two files, which also has b.txt."),
        (["b.txt"], "Nearest is two files, which also has a.txt."),
        (["d.txt"], ""),
        (["d.txt", "folder/"], "Nearest is four parts, which also has c.txt or c.bin, other."),
        (["x/c.bin", "folder/"], "Nearest is four parts, which also has d.txt, other."),
        (["a.txt", "c.txt", "d.txt"], "Nearest is four parts, which also has folder, other."),
        (["a.txt", "c.txt", "folder/"], "Nearest is two files, which also has b.txt."),
        (["a.txt", "c.txt", "folder/", "d.txt"], "Nearest is four parts, which also has other."),
        (["folder/", "other/"], ""),
        (["a.txt", "b.txt"], ""),
        (["c.txt", "d.txt", "folder/", "other/"], ""),
    ],
)
def test_the_nearest_format_has_the_most_marks_present(tmp_path, there, nearest):
    touch(tmp_path, *there)
    assert unknown._nearest(tmp_path, FORMATS) == nearest
    assert (nearest or "Nearest") in refusal(tmp_path) or "Nearest" not in refusal(tmp_path)


def test_a_subfolder_that_looks_like_a_capture_is_suggested(tmp_path):
    touch(tmp_path, "m/a.txt", "n/a.txt", "n/b.txt", "o/b.txt", "p/1.jpg")
    assert unknown._inside(tmp_path, FORMATS) == "n/ looks like two files: give that folder."
    assert f"{NONE}" in refusal(
        tmp_path
    ) and "n/ looks like two files: give that folder. It is none" in refusal(tmp_path)
    touch(tmp_path / "only", "p/1.jpg")
    assert "holds p/. p/ looks like pictures: give that folder. It is none of these" in refusal(
        tmp_path / "only"
    )
    for n in range(30):
        touch(tmp_path / "many", f"{n:02d}/")
    touch(tmp_path / "many" / "19", "a.txt", "b.txt")
    assert unknown._inside(tmp_path / "many", FORMATS).startswith("19/ looks")
    (tmp_path / "many" / "19").rename(tmp_path / "many" / "20")
    (tmp_path / "many" / "19").mkdir()
    assert unknown._inside(tmp_path / "many", FORMATS) == ""


@pytest.mark.parametrize("place", ["", "sparse/0", "sparse", "colmap/sparse/0", "sensors"])
def test_the_parent_folder_may_be_a_capture(tmp_path, place):
    images = tmp_path / "set" / "images"
    images.mkdir(parents=True)
    assert unknown._above(images, FORMATS) == ""
    touch(tmp_path / "set" / place, "a.txt", "c.txt", "d.txt", "folder/", "other/", "k.xml")
    assert unknown._above(images, FORMATS) == ""
    touch(tmp_path / "set" / place, "b.txt")
    assert (
        unknown._above(images, FORMATS) == "The folder above, set/, looks like two files: give that folder."
    )
    deep = (fake("deep", ("**/e.bin", "**/e.txt"), "**/f.txt", names_images=True),)
    touch(tmp_path / "set" / place, "e.txt", "f.txt")
    assert "looks like deep" in unknown._above(images, deep)


def test_left_and_right_folders_are_referred_to_the_depth_command(tmp_path):
    touch(tmp_path, "Left_rgb/", "right/", "lefty.txt")
    expected = "Pairs of a stereo rig are for geodiff depth: give it Left_rgb/ and right/, with --calib."
    assert unknown._rig(tmp_path) == expected and expected in refusal(tmp_path)
    (tmp_path / "right").rename(tmp_path / "wright")
    assert unknown._rig(tmp_path) == ""
    touch(tmp_path / "files", "left.png", "right.png")
    assert unknown._rig(tmp_path / "files") == ""


def test_foreign_files_are_named_with_a_hint(tmp_path):
    touch(tmp_path, "a.sens", "b.vrs")
    text = f"a.sens is a sequence of ScanNet. {unknown.SENS}"
    assert unknown._foreign(tmp_path) == text and text in refusal(tmp_path)
    touch(tmp_path / "b", "model.ply", "x.zip", "database.db")
    assert unknown._foreign(tmp_path / "b").startswith("database.db is COLMAP's matches without a model")
    assert unknown._foreign(tmp_path / "b", only_poses=True) == ""
    unknown.refuse_foreign(tmp_path)
    with pytest.raises(
        InputError,
        match=r"\APATH must be a capture that is read; got .*a\.sens, a sequence of ScanNet\. "
        r"SensReader's",
    ):
        unknown.refuse_foreign(tmp_path / "a.sens")
    touch(tmp_path, "other.txt", "c.csv")
    unknown.refuse_foreign(tmp_path / "other.txt")
    unknown.refuse_foreign(tmp_path / "c.csv")
    touch(tmp_path, "c.csv", text="#cameras 3\n")
    with pytest.raises(InputError, match="cameras of RealityCapture"):
        unknown.refuse_foreign(tmp_path / "c.csv")


def test_content_is_checked_for_a_few_files_per_kind(tmp_path):
    touch(tmp_path, *(f"{n}.csv" for n in range(4)))
    touch(tmp_path, "4.csv", text="\ufeff#name,x,y,alt\n")
    assert unknown._foreign(tmp_path).startswith("4.csv is cameras of RealityCapture")
    (tmp_path / "4.csv").rename(tmp_path / "5.csv")
    touch(tmp_path, "4.csv")
    assert unknown._foreign(tmp_path) == ""
    trajectory = '"PinholeCameraTrajectory"'
    for blanks, is_seen in ((4096 - len(trajectory), True), (4096, False)):
        touch(tmp_path / "o3d", "t.json", text=" " * blanks + trajectory)
        assert bool(unknown._foreign(tmp_path / "o3d")) == is_seen
    touch(tmp_path / "folders", "t.json/")
    assert unknown._foreign(tmp_path / "folders") == ""


def test_unread_poses_next_to_images_give_one_note(tmp_path):
    images = tmp_path / "set" / "images"
    touch(images, "1.jpg")
    assert unknown.poses_beside(images, FORMATS) == ()
    touch(images, "a.sens", "x.zip", "inside/a.txt", "inside/b.txt", "only/1.jpg")
    touch(tmp_path / "set", "a.txt", "b.txt")
    (note,) = unknown.poses_beside(images, FORMATS)
    assert note.code == "capture.poses-beside"
    assert note == (
        f"Images are read, without poses. a.sens is a sequence of ScanNet. {unknown.SENS} inside/ "
        "looks like two "
        "files: give that folder. The folder above, set/, looks like two files: give that folder."
    )


def test_hints_have_a_fixed_order(tmp_path):
    touch(tmp_path, "left/", "right/", "a.sens", "in/a.txt", "in/b.txt", "d.txt", "folder/")
    text = refusal(tmp_path)
    places = [
        text.index(part) for part in ("Pairs of a stereo", "a.sens is", "in/ looks", "Nearest is", NONE)
    ]
    assert places == sorted(places)


def test_formats_without_poses_are_not_reported_next_to_images():
    without = {each.name for each in unknown.FOREIGN if not each.has_poses}
    assert without == {
        "COLMAP's matches without a model",
        "an archive",
        "a model without its photographs",
        "pickled objects",
    }


def test_format_tables_are_well_formed():
    assert len({each.summary for each in LAYOUTS}) == len(LAYOUTS)
    for each in unknown.FOREIGN:  # not exchanged
        assert not each.name.endswith(".") and each.cure.endswith(".") and each.cure[0].isupper()
