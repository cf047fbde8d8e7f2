"""Files that a user names: what is rejected and why, and texts, matrices and sizes as they are read."""

import codecs
import hashlib
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from geodiff_plugin._internal.checks import InputError, InputFileError, MissingFileError
from geodiff_plugin.formats import files
from geodiff_plugin.formats.files import (
    check_file,
    file_digest,
    find_map,
    is_reoriented,
    natural_order,
    open_image,
    parse_xml,
    read_intrinsics,
    read_matrix,
    read_npy,
    read_rows,
    read_text,
    save_png,
    stored_size,
    upright_size,
)
from geodiff_plugin.formats.images import intrinsics_from_exif
from tests.unit.error_sentences import check_error

RNG = np.random.default_rng(8)


def test_a_path_that_is_no_readable_file_is_rejected_with_its_kind(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "empty").touch()
    (tmp_path / "good").write_text("x")
    assert check_file(str(tmp_path / "good"), "K") == tmp_path / "good"
    for name, error, said in (
        ("", InputFileError, "K must be a thing; got the folder .* Pass a file in it."),
        ("none", MissingFileError, "K must be a thing; got .*none, which does not exist"),
        ("n" * 300, MissingFileError, "which does not exist"),
        ("pipe", InputError, "which is a pipe or a device"),
        ("empty", InputError, "which is empty. Download"),
    ):
        with pytest.raises(error, match=said):
            check_file(tmp_path / name, "K", "a thing")
    with pytest.raises(TypeError, match="K must be the path of a thing; got int"):
        check_file(3, "K", "a thing")


@pytest.mark.parametrize(
    ("head", "said"),
    [
        (b"version https://git-lfs.github.com/spec/v1", "a Git LFS pointer"),
        (b"\n <!DOCTYPE HTML><p>", "a web page"),
        (b"<HTML lang='en'>", "a web page"),
        (b"x" * 60 + b"<html", None),
        (b"# the version https://git-lfs", None),
    ],
)
def test_what_a_failed_download_left_is_no_file(head, said, tmp_path):
    (tmp_path / "a").write_bytes(head)
    if said is None:
        check_file(tmp_path / "a", "left")
        return
    with pytest.raises(InputError, match=f"left must be a file; got .*, {said}"):
        check_file(tmp_path / "a", "left")


#: Entry of a TIFF directory, 4 bytes of ASCII, and the offset of the next one.
ORIENTATION_AS_TEXT = struct.pack("<HHI4sI", 0x0112, 2, 4, b"six", 0)


def test_errors_about_unreadable_images_state_the_reason(tmp_path):
    (tmp_path / "a.png").write_bytes(b"no image at all")
    Image.fromarray(RNG.integers(0, 255, (50, 60, 3), np.uint8)).save(tmp_path / "b.png")
    (tmp_path / "c.png").write_bytes((tmp_path / "b.png").read_bytes()[:-2000])
    with pytest.raises(InputError, match="left must be an image file; got .*, a format that Pillow does not"):
        stored_size(tmp_path / "a.png", "left")
    with (
        pytest.raises(InputError, match=r"left must be a whole image file; got .*, which cannot be decoded"),
        open_image(tmp_path / "c.png", "left") as image,
    ):
        image.load()
    with pytest.raises(InputError, match=r"\Amine\Z"), open_image(tmp_path / "b.png", "left"):
        raise InputError("mine")
    assert stored_size(tmp_path / "b.png", "left") == (60, 50)


@pytest.mark.parametrize("kind", [KeyError, TypeError, ValueError, OSError, EOFError])
def test_errors_of_the_block_are_not_taken_for_damage(tmp_path, kind):
    Image.new("RGB", (4, 3)).save(tmp_path / "a.png")
    with pytest.raises(kind, match=r"\A.?mine.?\Z"), open_image(tmp_path / "a.png", "left") as image:
        image.load()
        raise kind("mine")


def test_an_orientation_that_is_no_number_is_ignored(tmp_path):
    Image.new("RGB", (4, 3)).save(
        tmp_path / "a.jpg", exif=b"Exif\0\0II*\0\x08\0\0\0\x01\0" + ORIENTATION_AS_TEXT
    )
    assert upright_size(tmp_path / "a.jpg", "left") == (4, 3) and not is_reoriented(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="no focal length in its EXIF"):
        intrinsics_from_exif(tmp_path / "a.jpg", "left")


@pytest.mark.parametrize("orientation", [None, *range(1, 10)])
def test_an_image_is_turned_by_orientations_2_to_8_and_lies_on_its_side_from_5_to_8(orientation, tmp_path):
    exif = Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    for suffix in ("jpg", "png"):
        path = tmp_path / f"a.{suffix}"
        Image.new("RGB", (48, 40)).save(path, exif=exif)
        number = orientation or 1
        assert is_reoriented(path) == (2 <= number <= 8)
        assert stored_size(path, "left") == (48, 40)
        assert upright_size(path, "left") == ((40, 48) if 5 <= number <= 8 else (48, 40))


def test_pngs_are_written_whole_by_run_lengths(tmp_path):
    values = RNG.integers(0, 255, (40, 50, 3), np.uint8)
    with open(tmp_path / "a.bin", "wb") as file:
        save_png(Image.fromarray(values), file)
    with Image.open(tmp_path / "a.bin") as image:
        assert image.format == "PNG"
        np.testing.assert_array_equal(np.asarray(image), values)


def test_a_png_that_cannot_be_written_leaves_the_earlier_one(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    save_png(Image.new("RGB", (5, 4), "red"), path)
    before = path.read_bytes()

    def torn(self, file, **options):
        Path(file).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", torn)
    with pytest.raises(OSError, match="No space"):
        save_png(Image.new("RGB", (5, 4), "blue"), path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_maps_are_found_by_their_suffix_in_order(tmp_path):
    assert find_map(tmp_path, "a") is None
    (tmp_path / "a.npy").mkdir()
    for suffix in (".png", ".pfm", ".npz"):
        (tmp_path / f"a{suffix}").touch()
        assert find_map(tmp_path, "a") == tmp_path / f"a{suffix}"
    (tmp_path / "a.npy").rmdir()
    (tmp_path / "a.npy").touch()
    assert find_map(tmp_path, "a") == tmp_path / "a.npy" and find_map(tmp_path, "b") is None


def test_numbers_in_names_are_counted():
    order = ["2b", "10b", "f2.png", "f2a10.png", "f2a10b.jpg", "f2a10b.png", "f03.png", "f10.png", "g1"]
    shuffled = [Path(order[i]) for i in RNG.permutation(len(order))]
    assert [path.name for path in sorted(shuffled, key=natural_order)] == order


@pytest.mark.parametrize(
    ("raw", "text"),
    [
        (b"a\r\nb\rc\n", "a\nb\nc\n"),
        (codecs.BOM_UTF8 + "Höhe 1".encode(), "Höhe 1"),
        ("a 1\nb".encode("utf-16"), "a 1\nb"),
        (codecs.BOM_UTF16_BE + "a 1\nb".encode("utf-16-be"), "a 1\nb"),
        (b"caf\xe9 1", "caf\ufffd 1"),
    ],
)
def test_texts_of_every_system_are_read_alike(raw, text, tmp_path):
    (tmp_path / "a.txt").write_bytes(raw)
    assert read_text(tmp_path / "a.txt", "K") == text


@pytest.mark.parametrize(("raw", "said"), [(b"a\0b", "binary data"), (b" \n\t ", "only blanks")])
def test_a_non_text_is_rejected(raw, said, tmp_path, monkeypatch):
    (tmp_path / "a.txt").write_bytes(raw)
    with pytest.raises(InputError, match=f"which holds {said}. Pass a text file, not an image"):
        read_text(tmp_path / "a.txt", "K")
    monkeypatch.setattr(files, "LARGEST_TEXT_BYTES", 10)
    (tmp_path / "a.txt").write_bytes(b"x" * 10)
    assert read_text(tmp_path / "a.txt", "K") == "x" * 10
    (tmp_path / "a.txt").write_bytes(b"x" * 11)
    with pytest.raises(InputError, match=r"K must be a text file; got .* of 11 bytes"):
        read_text(tmp_path / "a.txt", "K")


def test_an_xml_text_with_entities_is_rejected():
    assert parse_xml("\n <?xml version='1.0'?><a><b>1</b></a>\n").find("b").text == "1"
    for text in ("<!DOCTYPE a><a/>", "<a><! entity x ''></a>"):
        with pytest.raises(InputError, match="an XML file; got a document type with entities"):
            parse_xml(text)


def test_rows_lose_remarks_quotes_and_separators_and_keep_blank_lines_out(tmp_path):
    text = '# head\n1, 2; 3\t4 // rest\n\n "a" , b,\n;5 6#7\n1,5\n'
    (tmp_path / "a.txt").write_text(text)
    assert read_rows(tmp_path / "a.txt", "K", "x") == [
        ["1", "2", "3", "4"],
        ["a", "b"],
        ["5", "6"],
        ["1", "5"],
    ]
    for line, word in (("1,5 2,5 3", "1,5"), ("7 -2,5e-3", "-2,5e-3"), ("1.5;+3,0;2", "+3,0")):
        (tmp_path / "a.txt").write_text(f"1 2 3\n{line}\n")
        with pytest.raises(InputError) as caught:
            read_rows(tmp_path / "a.txt", "K", "x")
        assert f"K must be numbers with a decimal point; got {tmp_path / 'a.txt'} with {word}." in str(
            caught.value
        )


def test_a_digest_is_that_of_the_content_and_follows_a_change(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_bytes(b"one")
    os.utime(path, ns=(5, 5))
    assert file_digest(path) == hashlib.sha256(b"one").hexdigest()
    other = tmp_path / "b"
    other.write_bytes(b"two")
    os.utime(other, ns=(5, 5))
    assert file_digest(other) == hashlib.sha256(b"two").hexdigest()
    path.write_bytes(b"six")
    os.utime(path, ns=(5, 6))
    assert file_digest(path) == hashlib.sha256(b"six").hexdigest(), "another time"
    path.write_bytes(b"eleven")
    os.utime(path, ns=(5, 6))
    assert file_digest(path) == hashlib.sha256(b"eleven").hexdigest(), "another size"
    monkeypatch.setattr(Path, "open", lambda *_: pytest.fail("it was read again"))
    assert file_digest(path) == hashlib.sha256(b"eleven").hexdigest()


def test_arrays_of_real_numbers_alone_are_read_and_nothing_is_unpickled(tmp_path):
    path = tmp_path / "a.npy"
    for kind in (np.float16, np.int8, np.uint64):
        np.save(path, np.arange(6).astype(kind).reshape(2, 3))
        read = read_npy(path, "K", "numbers")
        assert read.dtype == kind and read.tolist() == [[0, 1, 2], [3, 4, 5]]
    for values in (np.array(["a"]), np.array([True]), np.array([1j])):
        np.save(path, values)
        with pytest.raises(InputError, match="K must be numbers; got .* without an array of real numbers"):
            read_npy(path, "K", "numbers")
    with open(path, "wb") as file:
        np.savez(file, a=np.zeros(3))
    with pytest.raises(InputError, match="without an array of real numbers"):
        read_npy(path, "K", "numbers")
    np.save(path, np.array([{}, 1], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="pickled objects, which are never loaded"):
        read_npy(path, "K", "numbers")
    path.write_bytes(b"\x80\x04K\x01.")
    with pytest.raises(InputError, match="pickled objects, which are never loaded"):
        read_npy(path, "K", "numbers")
    path.write_bytes(b"1 2 3")
    with pytest.raises(InputError, match="it is in a different format"):
        read_npy(path, "K", "numbers")


@pytest.mark.parametrize("form", ["npy", "rows", "line", "brackets", "column"])
@pytest.mark.parametrize("shape", [(3, 3), (3, 4), (4, 4)])
def test_matrices_are_read_row_by_row_and_a_pose_gets_its_last_row(form, shape, tmp_path):
    values = RNG.integers(-9, 9, shape) + 0.25
    path = tmp_path / f"m.{'npy' if form == 'npy' else 'txt'}"
    words = [[str(v) for v in row] for row in values]
    flat = [word for row in words for word in row]
    if form == "npy":
        np.save(path, values[None].astype(np.float32))
    else:
        path.write_text(
            {
                "rows": "\n".join(", ".join(row) for row in words),
                "line": " ".join(flat),
                "brackets": "[" + ",\n ".join(f"[{', '.join(row)}]" for row in words) + "\n]",
                "column": "\n".join(flat),
            }[form]
        )
    expected = np.vstack([values, [[0, 0, 0, 1]]]) if shape == (3, 4) else values
    read = read_matrix(path, "E")
    np.testing.assert_array_equal(read, expected)
    assert read.dtype == np.float64


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("500 500 320 240", r"of shape \(4,\)\. If these are fx fy cx cy"),
        ("1 2 3\n4 5 6", r"of shape \(2, 3\)\.\Z"),
        ("1 2 3\n4 5\n6 7 8", "with words in it, or rows of several lengths"),
        ("fx 1 2\n0 1 2\n0 0 1", "with words in it"),
        ("1 0 0\n0 nan 0\n0 0 1", "E must be finite; got NaN or infinity"),
        ("1 0 0\n0 inf 0\n0 0 1", "E must be finite; got NaN or infinity"),
    ],
)
def test_a_non_matrix_is_rejected(text, said, tmp_path):
    (tmp_path / "m.txt").write_text(text)
    with pytest.raises(InputError, match=said):
        read_matrix(tmp_path / "m.txt", "E")


PRINTED_POSE = np.array([[1.0, 0.0, 0.0, 0.53715059], [0, 1, 0, 1e-7], [0, 0, 1, -0.25], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    "text",
    [
        repr(PRINTED_POSE),
        str(PRINTED_POSE),
        f"np.{PRINTED_POSE!r}",
        repr(PRINTED_POSE.tolist()),
        repr(PRINTED_POSE.astype(">f8")).replace("dtype", "device='cuda:0', dtype"),
        f"torch.tensor({PRINTED_POSE.tolist()}, dtype=torch.float64)",
        str([[np.float64(value) for value in row] for row in PRINTED_POSE]),
        str([[f"np.float64({value})" for value in row] for row in PRINTED_POSE]).replace("'", ""),
        repr(tuple(map(tuple, PRINTED_POSE.tolist()))),
        np.array2string(PRINTED_POSE, max_line_width=20, separator=", "),
        "[" + "; ".join(" ".join(map(str, row)) for row in PRINTED_POSE) + "]",
    ],
)
def test_arrays_are_read_as_python_prints_them(text, tmp_path):
    (tmp_path / "E.txt").write_text(text)
    np.testing.assert_allclose(read_matrix(tmp_path / "E.txt", "E"), PRINTED_POSE, atol=1e-6)


@pytest.mark.parametrize(
    "text", ["array([[1, 2, 3], [4, 5], [6, 7, 8]])", "array([[1, x, 3]] * 3)", "[1] 2 [3]"]
)
def test_printed_text_that_is_no_matrix_is_rejected(text, tmp_path):
    (tmp_path / "m.txt").write_text(text)
    with pytest.raises(InputError):
        read_matrix(tmp_path / "m.txt", "E")


def test_seven_numbers_are_a_position_and_a_quaternion(tmp_path):
    path = tmp_path / "E.txt"
    path.write_text("0.5 -0.1 0.2 0 0 0.5 0.8660254")
    E = read_matrix(path, "--E")
    np.testing.assert_allclose(E[:3, 3], [0.5, -0.1, 0.2])
    turn = [[0.5, -(0.75**0.5), 0], [0.75**0.5, 0.5, 0], [0, 0, 1]]
    np.testing.assert_allclose(E[:3, :3], turn, atol=1e-6)
    assert E.shape == (4, 4) and E[3].tolist() == [0, 0, 0, 1]
    for wrong in ("1 0 0 0 0.5 0 0", "0.5 0 0 1 0 0 0", "0.5 0 0 0 0 0 2"):  # w first, or no quaternion
        path.write_text(wrong)
        with pytest.raises(InputError, match=r"tx ty tz qx qy qz qw.*qw last, or a 4x4 matrix"):
            read_matrix(path, "--E")


def test_a_projection_is_not_K(tmp_path):
    path = tmp_path / "P.txt"
    path.write_text("721.5 0 609.5 44.8 0 720.5 172.5 0.2 0 0 1 0.003")
    said = r"--K must be a 3x3 matrix; .*first three columns are K: 721\.5 0 609\.5; 0 720\.5 172\.5; 0 0 1\."
    with pytest.raises(InputError, match=said):
        read_intrinsics(path, "--K")
    np.savetxt(path, PRINTED_POSE)
    with pytest.raises(InputError, match="If it is a pose, pass it with --E"):
        read_intrinsics(path, "--K")
    np.savetxt(path, np.diag([500.0, 400.0, 1.0]))
    np.testing.assert_array_equal(read_intrinsics(path, "--K"), np.diag([500.0, 400.0, 1.0]))


def test_backslashes_of_windows_paths_are_named(tmp_path):
    (tmp_path / "left").mkdir()
    (tmp_path / "left/0.png").write_bytes(b"x")
    with pytest.raises(MissingFileError, match=r"Write / for \\: .*/left/0\.png\."):
        check_file(f"{tmp_path}\\left\\0.png", "LEFT")


NO_FILE = ("view", "an image")


@pytest.mark.parametrize(
    ("name", "content", "call", "parts"),
    [
        (None, None, lambda p: check_file(3, *NO_FILE), ("view", "the path of an image", "int")),
        ("folder", None, lambda p: check_file(p, *NO_FILE), (*NO_FILE, "the folder {}", "Pass a file")),
        ("none", None, lambda p: check_file(p, *NO_FILE), (*NO_FILE, "{}, which does not exist", "Check")),
        ("pipe", None, lambda p: check_file(p, *NO_FILE), (*NO_FILE, "{}, which is a pipe", "Save")),
        (
            "a",
            b"",
            lambda p: check_file(p, *NO_FILE),
            (*NO_FILE, "{}, which is empty", "Download or copy it again"),
        ),
        (
            "a",
            b"version https://git-lfs.x/v1",
            lambda p: check_file(p, *NO_FILE),
            (*NO_FILE, "{}, a Git LFS pointer", "git lfs pull"),
        ),
        (
            "a",
            b"<html>",
            lambda p: check_file(p, *NO_FILE),
            (*NO_FILE, "{}, a web page", "Download it again"),
        ),
        (
            "a.png",
            b"no image",
            lambda p: list(opened(p)),
            (*NO_FILE, "{}, a format that Pillow does not", "PNG"),
        ),
        (
            "a.png",
            b"half of an image",
            lambda p: list(opened(p)),
            ("view", "a whole image file", "{}, which cannot be decoded (", "It may be truncated"),
        ),
        (
            "a",
            b"\0\1",
            lambda p: read_text(p, *NO_FILE),
            (*NO_FILE, "{}, which holds binary data", "archive."),
        ),
        (
            "a",
            b" \n ",
            lambda p: read_text(p, *NO_FILE),
            (*NO_FILE, "{}, which holds only blanks", "archive."),
        ),
        (
            "a",
            b"1,5 2,5",
            lambda p: read_rows(p, *NO_FILE),
            ("view", "numbers with a decimal point", "{} with 1,5", "1.5 for 1,5"),
        ),
        (
            None,
            None,
            lambda p: parse_xml("<!DOCTYPE x>"),
            ("the file", "an XML file", "a document type", "Remove"),
        ),
        (
            "a.npy",
            b"not numpy's",
            lambda p: read_npy(p, *NO_FILE),
            (*NO_FILE, "{}, which numpy cannot load (it is in a different format)", "numpy.save"),
        ),
        (
            "bool.npy",
            None,
            lambda p: read_npy(p, *NO_FILE),
            (*NO_FILE, "{} without an array of real numbers", "Save one array"),
        ),
        ("a", b"1 2 x", lambda p: read_matrix(p, "K"), ("K", files.MATRIX, "{} with words in it", "--calib")),
        (
            "a",
            b"1 2 3 4",
            lambda p: read_matrix(p, "K"),
            ("K", files.MATRIX, "{} of shape (4,)", "fx fy cx cy, write"),
        ),
        ("a", b"1 2 nan\n" * 3, lambda p: read_matrix(p, "K"), ("K", "finite", "NaN or infinity in {}")),
    ],
)
def test_errors_state_what_was_expected_and_what_was_found(tmp_path, name, content, call, parts):
    path = tmp_path / (name or "x")
    if name == "folder":
        path.mkdir()
    elif name == "pipe":
        os.mkfifo(path)
    elif name == "bool.npy":
        np.save(path, np.ones(2, bool))
    elif content == b"half of an image":
        save_png(Image.fromarray(RNG.integers(0, 255, (40, 40, 3), np.uint8)), path)
        path.write_bytes(path.read_bytes()[:2000])
    elif content is not None:
        path.write_bytes(content)
    check_error(lambda: call(path), *(part.format(path) for part in parts))


def opened(path):
    with open_image(path, *NO_FILE) as image:
        yield image.load()


PIXELS = np.mgrid[0:40, 0:48][[0, 1, 1]].transpose(1, 2, 0).astype(np.uint8)


def _turned_png(folder, behind: bool):
    """A PNG file of an image on its side, whose EXIF data lie before or behind its pixels."""
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 35  # the focal length in 35 mm equivalent
    path = folder / "x.png"
    Image.fromarray(PIXELS).save(path, exif=exif)
    if behind:
        raw = path.read_bytes()
        start, end = raw.index(b"eXIf") - 4, len(raw) - 12
        stop = start + 12 + int.from_bytes(raw[start : start + 4], "big")
        path.write_bytes(raw[:start] + raw[stop:end] + raw[start:stop] + raw[end:])
    return path


@pytest.mark.parametrize("behind", [False, True])
def test_exif_of_a_png_is_found_before_and_behind_its_pixels(tmp_path, behind):
    path = _turned_png(tmp_path, behind)
    assert is_reoriented(path) and upright_size(path, "left") == (40, 48)
    assert intrinsics_from_exif(path, "left")[0][0, 2] == 39 / 2


def test_a_png_is_not_decoded_for_its_exif_unless_it_is_cut_off(tmp_path, monkeypatch):
    path = _turned_png(tmp_path, behind=False)
    cut = tmp_path / "cut.png"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="cannot be decoded"):
        is_reoriented(cut)
    monkeypatch.setattr(PngImageFile, "load", lambda _: pytest.fail("its pixels were decoded"))
    assert is_reoriented(path) and upright_size(path, "left") == (40, 48)
    Image.fromarray(PIXELS).save(tmp_path / "plain.png")
    assert not is_reoriented(tmp_path / "plain.png")
    assert intrinsics_from_exif(path, "left")[0][0, 2] == 39 / 2


def test_an_image_beyond_pillows_limit_is_reported(tmp_path, monkeypatch):
    path = tmp_path / "x.png"
    Image.fromarray(PIXELS).save(path)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 40 * 48 - 1)
    assert stored_size(path, "left") == (48, 40)  # beyond Pillow's warning alone
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 40 * 48 // 3)
    with pytest.raises(ValueError, match=r"x\.png, which cannot be decoded .*pixels.*too large"):
        stored_size(path, "left")
