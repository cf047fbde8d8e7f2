"""Formats that are recognised but not read, and error messages for paths that are not captures."""

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import read_calibration, unread
from geodiff_plugin.formats.captures import LAYOUTS
from geodiff_plugin.formats.layouts import CaptureFormat


def fake(summary, *marks, **more):
    return CaptureFormat(summary, marks, lambda path: None, **more)


(SENS,) = (each for each in unread.CAPTURES if each.files == "*.sens")
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
        unread.raise_unknown(path, formats)
    return str(caught.value)


NONE = "Supported are: two files, four parts, any xml and pictures."


def test_files_and_empty_folders_get_the_list_of_formats(tmp_path):
    touch(tmp_path, "f.txt", "empty/")
    assert (
        refusal(tmp_path / "f.txt") == f"PATH must be a supported capture; got {tmp_path / 'f.txt'}. {NONE}"
    )
    empty = tmp_path / "empty"
    assert refusal(empty) == f"PATH must be a supported capture; got {empty}, which contains nothing. {NONE}"
    (tmp_path / "nothing.txt").write_text("")
    assert "which is empty" in refusal(tmp_path / "nothing.txt")


def test_folder_content_is_summarized(tmp_path):
    touch(tmp_path, "1.png", "2.PNG", "3.png", "z/", "y/", "x/", "w/", "v/", "u/", "t/", "Makefile", "4.doc")
    content = unread._content(tmp_path)
    assert content.startswith("3 .png, 1 ") and content.endswith(", t/, u/, v/, w/, x/, y/")
    assert "1 Makefile" in content and "1 .doc" in content
    touch(tmp_path, *(f"f.{n}" for n in range(9)))
    assert len(unread._content(tmp_path).split(", ")) == 12


@pytest.mark.parametrize(
    ("there", "nearest"),
    [
        (["a.txt"], "The most similar format is two files, which also has b.txt."),
        (["b.txt"], "The most similar format is two files, which also has a.txt."),
        (["d.txt"], ""),
        (
            ["d.txt", "folder/"],
            "The most similar format is four parts, which also has c.txt or c.bin, other.",
        ),
        (["x/c.bin", "folder/"], "The most similar format is four parts, which also has d.txt, other."),
        (["a.txt", "c.txt", "d.txt"], "The most similar format is four parts, which also has folder, other."),
        (["a.txt", "c.txt", "folder/"], "The most similar format is two files, which also has b.txt."),
        (
            ["a.txt", "c.txt", "folder/", "d.txt"],
            "The most similar format is four parts, which also has other.",
        ),
        (["folder/", "other/"], ""),
        (["a.txt", "b.txt"], ""),
        (["c.txt", "d.txt", "folder/", "other/"], ""),
    ],
)
def test_the_nearest_format_has_the_most_marks_present(tmp_path, there, nearest):
    touch(tmp_path, *there)
    assert unread._nearest(tmp_path, FORMATS) == nearest
    assert (nearest or "Nearest") in refusal(tmp_path) or "Nearest" not in refusal(tmp_path)


def test_a_subfolder_that_looks_like_a_capture_is_suggested(tmp_path):
    touch(tmp_path, "m/a.txt", "n/a.txt", "n/b.txt", "o/b.txt", "p/1.jpg")
    assert unread._inside(tmp_path, FORMATS) == "n/ looks like two files; pass that folder."
    assert f"{NONE}" in refusal(
        tmp_path
    ) and "n/ looks like two files; pass that folder. Supported are:" in refusal(tmp_path)
    touch(tmp_path / "only", "p/1.jpg")
    assert "contains p/. p/ looks like pictures; pass that folder. Supported are: two" in refusal(
        tmp_path / "only"
    )
    for n in range(30):
        touch(tmp_path / "many", f"{n:02d}/")
    touch(tmp_path / "many" / "19", "a.txt", "b.txt")
    assert unread._inside(tmp_path / "many", FORMATS).startswith("19/ looks")
    (tmp_path / "many" / "19").rename(tmp_path / "many" / "20")
    (tmp_path / "many" / "19").mkdir()
    assert unread._inside(tmp_path / "many", FORMATS) == ""


@pytest.mark.parametrize("place", ["", "sparse/0", "sparse", "colmap/sparse/0", "sensors"])
def test_the_parent_folder_may_be_a_capture(tmp_path, place):
    images = tmp_path / "set" / "images"
    images.mkdir(parents=True)
    assert unread._above(images, FORMATS) == ""
    touch(tmp_path / "set" / place, "a.txt", "c.txt", "d.txt", "folder/", "other/", "k.xml")
    assert unread._above(images, FORMATS) == ""
    touch(tmp_path / "set" / place, "b.txt")
    assert unread._above(images, FORMATS) == "The parent folder set/ looks like two files; pass that folder."
    deep = (fake("deep", ("**/e.bin", "**/e.txt"), "**/f.txt", names_images=True),)
    touch(tmp_path / "set" / place, "e.txt", "f.txt")
    assert "looks like deep" in unread._above(images, deep)


def test_left_and_right_folders_are_referred_to_the_depth_command(tmp_path):
    touch(tmp_path, "Left_rgb/", "right/", "lefty.txt")
    expected = "For pairs of a stereo rig, use geodiff depth with Left_rgb/, right/ and --calib."
    assert unread._rig(tmp_path) == expected and expected in refusal(tmp_path)
    (tmp_path / "right").rename(tmp_path / "wright")
    assert unread._rig(tmp_path) == ""
    touch(tmp_path / "files", "left.png", "right.png")
    assert unread._rig(tmp_path / "files") == ""


def test_unread_files_are_named_with_a_hint(tmp_path):
    touch(tmp_path, "a.sens", "b.vrs")
    text = f"a.sens is {SENS.name}. {SENS.hint}"
    assert unread._unread_inside(tmp_path) == text and text in refusal(tmp_path)
    touch(tmp_path / "b", "model.ply", "x.zip", "database.db")
    assert unread._unread_inside(tmp_path / "b").startswith("database.db is COLMAP's matches without a model")
    assert unread._unread_inside(tmp_path / "b", only_poses=True) == ""
    unread.raise_unread_capture(tmp_path)
    with pytest.raises(
        InputError,
        match=r"\APATH must be a supported capture; got .*a\.sens, a ScanNet sequence\. "
        r"Export it with SensReader",
    ):
        unread.raise_unread_capture(tmp_path / "a.sens")
    touch(tmp_path, "other.txt", "c.csv")
    unread.raise_unread_capture(tmp_path / "other.txt")
    unread.raise_unread_capture(tmp_path / "c.csv")
    touch(tmp_path, "c.csv", text="#cameras 3\n")
    with pytest.raises(InputError, match="RealityCapture cameras"):
        unread.raise_unread_capture(tmp_path / "c.csv")


def test_content_is_checked_for_a_few_files_per_kind(tmp_path):
    touch(tmp_path, *(f"{n}.csv" for n in range(4)))
    touch(tmp_path, "4.csv", text="\ufeff#name,x,y,alt\n")
    assert unread._unread_inside(tmp_path).startswith("4.csv is RealityCapture cameras")
    (tmp_path / "4.csv").rename(tmp_path / "5.csv")
    touch(tmp_path, "4.csv")
    assert unread._unread_inside(tmp_path) == ""
    trajectory = '"PinholeCameraTrajectory"'
    for blanks, is_seen in ((4096 - len(trajectory), True), (4096, False)):
        touch(tmp_path / "o3d", "t.json", text=" " * blanks + trajectory)
        assert bool(unread._unread_inside(tmp_path / "o3d")) == is_seen
    touch(tmp_path / "folders", "t.json/")
    assert unread._unread_inside(tmp_path / "folders") == ""


def test_unread_poses_next_to_images_give_one_note(tmp_path):
    images = tmp_path / "set" / "images"
    touch(images, "1.jpg")
    assert unread.poses_in_folder(images, FORMATS) == ()
    touch(images, "a.sens", "x.zip", "inside/a.txt", "inside/b.txt", "only/1.jpg")
    touch(tmp_path / "set", "a.txt", "b.txt")
    (finding,) = unread.poses_in_folder(images, FORMATS)
    assert finding.code == "capture.unused-poses"
    assert finding == (
        f"Images are read without poses. a.sens is {SENS.name}. {SENS.hint} inside/ "
        "looks like two files; pass that folder. The parent folder set/ looks like two files; pass that "
        "folder."
    )


def test_hints_have_a_fixed_order(tmp_path):
    touch(tmp_path, "left/", "right/", "a.sens", "in/a.txt", "in/b.txt", "d.txt", "folder/")
    text = refusal(tmp_path)
    places = [
        text.index(part)
        for part in ("For pairs of a stereo", "a.sens is", "in/ looks", "The most similar format is", NONE)
    ]
    assert places == sorted(places)


def test_formats_without_poses_are_not_reported_next_to_images():
    without = {each.name for each in unread.CAPTURES if not each.has_poses}
    assert without == {
        "COLMAP's matches without a model",
        "an archive",
        "a model without its images",
        "pickled objects",
    }


def test_format_tables_are_well_formed():
    assert len({each.summary for each in LAYOUTS}) == len(LAYOUTS)
    for each in (*unread.CAPTURES, *unread.CALIBRATIONS):  # not swapped
        assert not each.name.endswith(".") and each.hint.endswith((".", ")")) and each.hint[0].isupper()


def test_only_the_beginning_of_a_calibration_is_searched(tmp_path):
    file = tmp_path / "c.yaml"
    signature = "camera.A=[1 2 3]\n"
    for blanks, is_seen in ((0, True), (4096 - len(signature) - 1, True), (4097, False)):
        file.write_text(" " * blanks + "\n" + signature)
        if not is_seen:
            unread.raise_unread_calibration(file)
            continue
        with pytest.raises(
            InputError,
            match=r"\Acalibration must be in a supported format; got .*c\.yaml, rc_visard or cvkit "
            r"parameters\. Pass --fx .*--baseline\.\Z",
        ):
            unread.raise_unread_calibration(file)


def test_missing_files_and_folders_are_not_rejected_here(tmp_path):
    unread.raise_unread_calibration(tmp_path / "none.yaml")
    unread.raise_unread_calibration(tmp_path)


#: The beginning of a file of each calibration format that is not read, in the order of the table.
BEGINNINGS = (
    b'<?xml version="1.0"?>\n<opencv_storage>\n<imagelist>\n"l0.jpg"\n"r0.jpg"\n',
    b"RadTan 0.61 0.95 0.49 0.52 -0.28 0.07 0 0\n752 480\ncrop\n752 480\n",
    b"\x89HDF\r\n\x1a\n",
    b"\x80\x04\x95",
    b"\x93NUMPY\x01",
    b"PIEH",
    b"Calibration results\n===\nCamera-system parameters:\n cam0\n",
    b'<?xml version="1.0"?>\n<calibration>\n  <projection>frame</projection>\n',
    b"%YAML:1.0\n---\nmodel_type: PINHOLE\nimage_width: 752\n",
    b"Device info: \n    Name : \tIntel RealSense D435\n",
    b'[{"cameras": [{"intrinsics": {"distortion_model": "pinhole"}, "transform": []}]}]',
    b'{"CalibrationInformation": {"Cameras": []}}',
    b'{"calibDataSource": "x", "cameras": [{"K": [], "R": []}]}',
    b'{"class_name": "PinholeCameraParameter", "extrinsic_r": [], "world2cam": true}',
    b'{"extrinsics": [{"rotation": {"qw": 1.0}}], "intrinsics": [{"fx": 9}]}',
    b"fu = 620.5\nfv = 622.1\ncu = 526\ncv = 374\nu_direction = 1 0 0\n",
    b"https://www.youtube.com/watch?v=a\n52553 " + b"0.5 " * 18 + b"\n",
    b"# Bundle file v0.3\n2 0\n",
    b"intrinsics:\n  camRect0:\n    camera_matrix: [1, 2, 3, 4]\n",
    b"camera.height=960\ncamera.A=[1085 0 640; 0 1085 480; 0 0 1]\nt=0.159\n",
    b'{"intrinsic_matrix": [1, 0, 0, 0, 1, 0, 5, 5, 1], "width": 9}',
)
#: Further beginnings, and words of the format's name.
OTHERS = {
    b"MATLAB 5.0 MAT-file, Platform: GLNXA64": "MATLAB .mat",
    b'[{"token": "a", "camera_intrinsic": []}]': "nuScenes",
    b'<?xml version="1.0"?>\n<document version="2.0.0">\n<chunk label="1">': "many images",
    b'[{"cameras": {}, "shots": {}}]': "many images",
    b"NVM_V3 \n": "many images",
    b"\xef\xbb\xbfEquiDistant 0.5 0.6": "DSO",
    b"disparity_to_depth:\n": "DSEC",
}


def test_unread_calibrations_are_rejected_with_name_and_hint(tmp_path):
    file = tmp_path / "calib.dat"
    pairs = list(zip(BEGINNINGS, unread.CALIBRATIONS, strict=True))
    for content, words in OTHERS.items():
        pairs += [(content, each) for each in unread.CALIBRATIONS if words in each.name]
    assert len(pairs) == len(BEGINNINGS) + len(OTHERS)
    for content, each in pairs:
        file.write_bytes(content + bytes(90) * (content[:1] in b"\x80\x89\x93M"))
        with pytest.raises(InputError) as caught:
            read_calibration(file)
        expected = f"calibration must be in a supported format; got {file}, {each.name}. {each.hint}"
        assert str(caught.value) == expected
