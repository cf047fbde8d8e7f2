"""Return values of capture readers, and the search for the images that a file names."""

from pathlib import Path

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import layouts
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Images
from tests.unit.formats.posed_images import write_images


@pytest.mark.parametrize(
    ("images", "reported"),
    [
        ([7], None),
        ([7, 0, 0], None),
        (
            [9, 4, 0, 1],
            "The largest part, with 9 images, is used. Others (with 4, 1 images) are ignored, as each has "
            "a separate coordinate frame.",
        ),
        (
            [2, 2],
            "The largest part, with 2 images, is used. Others (with 2 images) are ignored, as each has "
            "a separate coordinate frame.",
        ),
    ],
)
def test_omitted_parts_are_counted(images, reported):
    findings = layouts.largest_part_findings("part", images)
    assert [str(finding) for finding in findings] == ([] if reported is None else [reported])
    assert all(finding.code == "capture.part" for finding in findings)


def test_errors_in_a_frame_exclude_only_that_frame():
    frame = CaptureFrame("a", Path("a.png"))

    def fail(error):
        def build(frame, entry):
            raise error

        return layouts.build_frame(frame, build, None)

    assert layouts.build_frame(frame, lambda frame, x: Candidate(frame, problem=x), "x").problem == "x"
    for error, problem in (
        (InputError("K is bad"), "K is bad"),
        (KeyError("K"), "its entries cannot be read (KeyError: 'K')"),
        (ZeroDivisionError("by 0"), "its entries cannot be read (ZeroDivisionError: by 0)"),
    ):
        candidate = fail(error)
        assert (candidate.frame, candidate.camera, candidate.problem) == (frame, None, problem)


def test_frame_and_layout_defaults():
    frame = CaptureFrame("a", Path("a.png"))
    assert (frame.E, frame.depth, frame.depth_per_m, frame.index, frame.points) == (None,) * 5
    assert not frame.as_stored
    layout = layouts.Layout("kind", "m", [])
    assert (layout.as_stored, layout.findings, layout.has_poses) == (True, (), True)
    entry = layouts.CaptureFormat("s", ("m",), lambda path: None)
    assert (entry.names_images, entry.has_poses) == (False, True)


def build(frame, entry):
    return Candidate(frame, None, f"{frame.name} {entry}")


def test_images_are_found_and_duplicate_names_are_skipped(scan):
    a, b = write_images(scan / "images", ["a.png", "b.jpg"])
    names = ["set/a.png", "b.png", "set/a.png", "sub\\c.png"]
    images = Images.find(names, [scan, scan / "images"], scan / "model.txt")
    assert images.names == names and images.findings == ()
    assert [images.file(name) for name in names] == [a, b, a, None]
    candidates = images.candidates(build, "wxyz")
    assert [each.frame.image for each in candidates] == [a, b, Path("set/a.png"), Path("sub/c.png")]
    assert [each.frame.name for each in candidates] == ["a", "b", "a.png", "c.png"]
    assert [each.problem for each in candidates] == [
        "a w",
        "b x",
        "named twice; the first is used",
        "no image file in its folder, images",
    ]
    with pytest.raises(ValueError, match="zip"):
        images.candidates(build, "wxy")


def test_moved_images_are_searched_up_to_two_folders_above(scan):
    moved = write_images(scan.parent / "photos" / "set", ["a.png", "b.png"])
    (scan / "sparse" / "model").mkdir(parents=True)
    file = scan / "sparse" / "model" / "cameras.txt"
    images = Images.find(["a.png", "b.png"], [file.parent], file)
    assert [images.file(name) for name in ("a.png", "b.png")] == [None, None]
    problem = images.candidates(build, "xy")[0].problem
    assert problem == "no image file in its folder or elsewhere near it; pass their folder (--images)"
    file = scan / "cameras.txt"
    images = Images.find(["a.png", "b.png"], [scan], file)
    assert [images.file(name) for name in ("a.png", "b.png")] == moved
    (finding,) = images.findings
    assert finding.code == "capture.images-found"
    assert finding == "Images are read from ../photos/set, because its folder has none."
    assert Images.find(["a.png"], [scan], file, other=("photos",)).file("a.png") is None
    by_folder = Images.find(["a.png", "b.png"], [scan], scan)
    assert by_folder.findings[0] == finding


def test_the_reason_for_a_missing_image_names_the_folder_of_the_others(scan):
    """The others are in ``../photos``, so that its own folder is not where to look for this one."""
    write_images(scan.parent / "photos", ["a.png", "b.png"])
    images = Images.find(["a.png", "b.png", "c.png"], [scan], scan / "cameras.txt")
    assert images.file("c.png") is None
    assert images.candidates(build, "xyz")[2].problem == "no image file in ../photos"


def test_a_given_folder_is_searched_exclusively(scan):
    here = write_images(scan, ["a.png"])
    there = write_images(scan.parent / "photos" / "set", ["a.png"])
    write_images(scan.parent, ["b.png"])
    images = Images.find(["a.png", "b.png"], [scan], scan / "cameras.txt", scan.parent / "photos" / "set")
    assert images.file("a.png") == there[0] != here[0] and images.file("b.png") is None
    assert images.candidates(build, "xy")[1].problem == "no image file in ../photos/set"
    below = Images.find(["a.png"], [scan], scan / "cameras.txt", scan.parent / "photos")
    assert below.file("a.png") == there[0] and below.findings == ()
    (scan.parent / "empty").mkdir()
    none = Images.find(["b.png"], [scan], scan / "cameras.txt", scan.parent / "empty")
    assert none.file("b.png") is None
    with pytest.raises(
        InputError,
        match=r"\Aimages \(--images\) must be a folder; got .*a\.png, which is not a folder\. Pass",
    ):
        Images.find(["a.png"], [scan], scan / "cameras.txt", here[0])
    assert Images.find([], [scan], scan / "cameras.txt").candidates(build, "") == []


def frames(*paths: str) -> list[CaptureFrame]:
    return [CaptureFrame(Path(path).stem, Path(path)) for path in paths]


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (("a/1.png", "a/2.png"), ["1", "2"]),
        (("a/1.png", "b/1.png"), ["a-1", "b-1"]),
        (("x/a/1.png", "y/a/1.png", "y/a/2.png"), ["x-a-1", "y-a-1", "y-a-2"]),
        (("a/1.png", "1.png"), ["a-1", "1"]),
        (("a/1.png", "a/1.png"), ["1-0", "1-1"]),
        (("a/..png", "a/.b.png"), ["_", "_b"]),
        (("a/\x1b1.png", "a/2\n.png"), ["_1", "2_"]),
        (("/a/b/1.png", "/c/b/1.png"), ["a-b-1", "c-b-1"]),
        (("../1.png", "a/1.png"), ["_-1", "a-1"]),
        ((), []),
    ],
)
def test_frame_names_are_unique_and_safe_as_folder_names(paths, names):
    assert layouts.unique_names(frames(*paths)) == names


def test_slashes_in_frame_names_become_dashes():
    given = [CaptureFrame("one/a", Path("x/a.png")), CaptureFrame("two/a", Path("x/b.png"))]
    assert layouts.unique_names(given) == ["one-a", "two-a"]
