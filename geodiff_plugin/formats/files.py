"""Opens user files with concise errors: text, arrays, camera matrices and poses."""

from __future__ import annotations

import codecs
import hashlib
import os
import re
import traceback
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import lru_cache
from pathlib import Path
from typing import IO, TYPE_CHECKING
from xml.etree import ElementTree

from geodiff_plugin._internal.checks import InputError, InputFileError, MissingFileError, bad_type, bad_value
from geodiff_plugin.formats.out import atomic_path

if TYPE_CHECKING:  # errors in files are reported before numpy is imported
    import numpy as np
    from PIL import Image

PathLike = str | os.PathLike[str]
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
#: EXIF tag of the orientation.
ORIENTATION = 0x0112
#: Value of the tag for an image displayed as stored.
UPRIGHT = 1
#: Values of the tag that rotate or mirror the image.
ORIENTATIONS = range(2, 9)
#: Those that swap width and height.
SWAPPING_ORIENTATIONS = range(5, 9)
#: Matches a number with a decimal comma, between blanks, semicolons or line ends.
DECIMAL_COMMA = re.compile(r"(?<![^\s;])[-+]?\d+,\d+(e[-+]?\d+)?(?![^\s;])", re.IGNORECASE)
#: Maximum size of a calibration file; larger files are of another kind.
LARGEST_TEXT_BYTES = 16_000_000
FLAT = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
#: Number of values of a pose as position and quaternion.
QUATERNION_POSE_SIZE = 7
#: Maximum deviation of a quaternion's length from 1: files have few digits.
UNIT_TOLERANCE = 1e-2
#: Minimum w of the relative rotation of two views with overlap, which turns by less than 90 degrees.
MIN_W = 0.7
#: Matches what Python prints around the numbers of an array of NumPy or PyTorch.
PRINTED = re.compile(r"(?:\b(?:np|numpy|torch)\.)?\b(?:array|matrix|tensor|asarray)(?=[(])|\b\w+=[^\s)\]]+")
#: Matches a number of NumPy in a list, as NumPy 2 prints it.
PRINTED_NUMBER = re.compile(r"\b(?:np\.)?float\d+\(([^()]*)\)")
MATRIX = "a 3x3 K or a 4x4 (or 3x4) E, as text of numbers or .npy"


def posix_path(path: PathLike) -> Path:
    """Return the path of a file, whose folders may be separated by backslashes as on Windows."""
    file = Path(path)
    slashed = Path(os.fspath(path).replace("\\", "/"))
    return slashed if os.path.exists(slashed) and not os.path.exists(file) else file


def check_file(path: PathLike, name: str, what: str = "a file") -> Path:
    """Return the path of an existing, readable, non-empty file; raise with ``name`` and ``what``."""
    if not isinstance(path, (str, os.PathLike)):
        bad_type(name, f"the path of {what}", path)
    file = Path(path)
    if os.path.isdir(file):
        bad_value(name, what, f"the folder {path}", "Pass a file in it.", InputFileError)
    if not os.path.exists(file):  # Path.exists() raises for names that are too long
        slashed = posix_path(path)
        hint = "Check the spelling." if slashed == file else f"Write / for \\: {slashed.as_posix()}."
        bad_value(name, what, f"{path}, which does not exist", hint, MissingFileError)
    if not file.is_file():
        bad_value(name, what, f"{path}, which is a pipe or a device", "Save its output to a file first.")
    if not os.access(file, os.R_OK):
        bad_value(name, what, f"{path}, which is not readable", "Check its permissions.", InputFileError)
    if file.stat().st_size == 0:
        bad_value(name, what, f"{path}, which is empty", "Download or copy it again.", code="file.empty")
    _raise_placeholder(file, name, what)
    return file


def _raise_placeholder(file: Path, name: str, what: str) -> None:
    """Raise an error for placeholders left by failed downloads."""
    with file.open("rb") as opened:
        head = opened.read(STAND_IN_BYTES).lstrip().lower()
    if head.startswith(b"version https://git-lfs"):
        bad_value(name, what, f"{file}, a Git LFS pointer", "Download the file with: git lfs pull.")
    if head.startswith((b"<!doctype html", b"<html")):
        hint = "The download returned an error or login page. Download it again."
        bad_value(name, what, f"{file}, a web page", hint)


#: Number of bytes needed to recognise a web page or a Git LFS pointer.
STAND_IN_BYTES = 64
MAP_SUFFIXES = (".npy", ".npz", ".pfm", ".png")
HEIC_SUFFIXES = (".heic", ".heif")
#: Types of error that Pillow's decoders raise for damaged files.
DECODE_ERRORS = (OSError, SyntaxError, ValueError, TypeError, KeyError, EOFError, zlib.error)


@contextmanager
def open_image(path: PathLike, name: str, what: str = "an image file") -> Iterator[Image.Image]:
    """Open an image file with Pillow (HEIC with pillow-heif); raise an error if it is not a whole image.

    Pillow decodes lazily, so damage may only be found inside the block. Errors that Pillow raises there are
    reported as damage as well; others are raised unchanged.
    """
    from PIL import Image, UnidentifiedImageError

    file = check_file(path, name, what)
    if file.suffix.lower() in HEIC_SUFFIXES:
        _register_heif(file, name, what)
    try:
        with warnings.catch_warnings():
            # Images that are too large raise an error.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(file)
        with image:
            yield image
    except InputError:
        raise
    except UnidentifiedImageError:
        hint = "Convert it to PNG or JPEG."
        bad_value(name, what, f"{file}, a format that Pillow does not read", hint, code="image.unreadable")
    except (Image.DecompressionBombError, *DECODE_ERRORS) as error:
        if not _is_of_decoder(error):
            raise
        hint = "It may be truncated or too large."
        got = f"{file}, which cannot be decoded ({error})"
        bad_value(name, "a whole image file", got, hint, code="image.unreadable")


def _register_heif(file: Path, name: str, what: str) -> None:
    """Let Pillow read HEIC files."""
    try:
        import pillow_heif
    except ImportError:
        hint = "Install it with: pip install pillow-heif (extra heic), or convert the file to PNG or JPEG."
        bad_value(name, what, f"{file}, which needs pillow-heif", hint, code="image.heic")
    pillow_heif.register_heif_opener()


def _is_of_decoder(error: Exception) -> bool:
    """Whether an error was raised in Pillow or pillow-heif, directly or by a function that they called."""
    modules = (frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__))
    return any(module.partition(".")[0] in ("PIL", "pillow_heif") for module in modules)


def save_png(image: Image.Image, file: PathLike | IO[bytes]) -> None:
    """Save an image as PNG, compressed with zlib's run-length strategy; a path completely or not at all.

    Images and maps become as small as with zlib's default in less than half of the time: after PNG's filters
    they contain few repetitions other than of single bytes. Only drawn patterns become larger.
    """
    from PIL.Image import RLE

    with atomic_path(file) if isinstance(file, (str, os.PathLike)) else nullcontext(file) as target:
        image.save(target, format="PNG", compress_type=RLE)


def find_map(folder: Path, stem: str) -> Path | None:
    """Return the first map with a name in a folder, with any suffix; ``None`` if there is none."""
    paths = (folder / f"{stem}{suffix}" for suffix in MAP_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def natural_order(path: Path) -> tuple[list[str | int], str]:
    """Key for sorting names in natural order: f2 before f10."""
    parts = re.split(r"([0-9]+)", path.stem)  # alternating text and numbers, so that keys are comparable
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


def stored_size(path: PathLike, name: str) -> tuple[int, int]:
    """Return ``(width, height)`` of an image file as stored."""
    with open_image(path, name) as image:
        return image.size


def exif_of(image: Image.Image) -> Image.Exif:
    """Return the EXIF data of an opened image, decoding no more than necessary.

    Pillow would decode a PNG completely, because EXIF may follow the pixels.
    """
    from PIL import Image

    file = getattr(image, "fp", None)
    if image.format == "PNG" and file is not None and _ends_with_pixels(file):
        return Image.Image.getexif(image)
    return image.getexif()


def _ends_with_pixels(file: IO[bytes]) -> bool:
    """Whether a PNG file has no chunks after its pixels."""
    here = file.seek(0, os.SEEK_CUR)
    kinds = list[bytes]()
    try:
        file.seek(len(PNG_SIGNATURE))
        while kinds[-1:] != [b"IEND"]:
            head = file.read(8)
            if len(head) < 8:
                return False
            kinds.append(head[4:])
            file.seek(int.from_bytes(head[:4], "big") + 4, os.SEEK_CUR)  # content and checksum
    finally:
        file.seek(here)
    return kinds[-2:-1] == [b"IDAT"]


def upright_size(path: PathLike, name: str) -> tuple[int, int]:
    """Return ``(width, height)`` of an image file in its EXIF orientation."""
    with open_image(path, name) as image:
        width, height = image.size
        swapped = exif_of(image).get(ORIENTATION) in SWAPPING_ORIENTATIONS
    return (height, width) if swapped else (width, height)


def is_reoriented(path: PathLike) -> bool:
    """Whether an image file is rotated or mirrored by its EXIF orientation."""
    with open_image(path, "the image") as image:
        return exif_of(image).get(ORIENTATION) in ORIENTATIONS


def read_text(path: PathLike, name: str, what: str = "a text file") -> str:
    """Read a text file with Unix line ends and without byte-order mark."""
    file = check_file(path, name, what)
    hint = "Pass a text file, not an image or archive."
    size = file.stat().st_size
    if size > LARGEST_TEXT_BYTES:
        bad_value(name, what, f"{file} of {size} bytes", hint)
    raw = file.read_bytes()
    wide = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # written by PowerShell and Notepad
    text = raw.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    if "\0" in text or not text.strip():
        content, code = ("binary data", "") if text.strip() else ("only blanks", "file.empty")
        bad_value(name, what, f"{file}, which holds {content}", hint, code=code)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_xml(text: str) -> ElementTree.Element:
    """Parse XML; raise an error for custom entities, which can expand without limit."""
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        bad_value("the file", "an XML file", "a document type with entities", "Remove it.")
    return ElementTree.fromstring(text.strip())


def read_rows(path: PathLike, name: str, what: str) -> list[list[str]]:
    """Return the words of all non-empty lines, without comments (``#``, ``//``), quotes and separators.

    Raises an error for decimal commas: ``1,5 2,5 3,0`` would be six numbers. ``1,2`` alone may be two
    columns.
    """
    rows = []
    for line in read_text(path, name, what).replace('"', "").splitlines():
        line = re.split("#|//", line)[0].strip(" \t,;")
        comma = DECIMAL_COMMA.search(line)
        if comma and comma.group() != line:
            hint = "Use decimal points, such as 1.5 for 1,5."
            bad_value(name, "numbers with a decimal point", f"{path} with {comma.group()}", hint)
        if line:
            rows.append(re.split(r"[\s,;]+", line))
    return rows


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, cached until its size or modification time changes."""
    state = path.stat()
    return _digest(path.absolute(), state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=4096)
def _digest(path: Path, size: int, changed_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_npy(path: Path, name: str, expected: str) -> np.ndarray:
    """Read an array of real numbers in its own dtype; never unpickles."""
    import numpy as np

    hint = "Save one array with numpy.save."
    try:
        value = np.load(path, allow_pickle=False)
    except Exception as error:  # numpy parses a damaged header as Python, which may raise any error
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if "pickle" in reason:  # numpy's message suggests allow_pickle, also for other files
            with open(path, "rb") as file:
                pickled = file.read(1) in (b"\x80", b"\x93")
            reason = "pickled objects, which are never loaded" if pickled else "it is in a different format"
        bad_value(name, expected, f"{path}, which numpy cannot load ({reason})", hint)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        bad_value(name, expected, f"{path} without an array of real numbers", hint)
    return value


def _printed_rows(text: str) -> list[list[str]]:
    """Return the numbers of an array as Python or NumPy prints it, one row per innermost bracket."""
    text = PRINTED.sub(" ", PRINTED_NUMBER.sub(r"\1", text))
    text = re.sub(r"[()]", lambda found: "[]"["()".index(found[0])], text)
    if re.sub(r"\[[^\[\]]*\]|[\[\]\s]", "", text):  # words, or numbers outside of brackets
        return [line.split() for line in re.sub(r"[\[\]]", " ", text).splitlines()]
    return [row.split() for row in re.findall(r"\[([^\[\]]*)\]", text)]


def _pose_of_quaternion(values: np.ndarray, path: PathLike, name: str) -> np.ndarray:
    """Return the ``(4, 4)`` pose of ``tx ty tz qx qy qz qw``, the order of TUM and ROS."""
    import numpy as np

    x, y, z, w = values[3:]
    if abs(np.linalg.norm(values[3:]) - 1.0) > UNIT_TOLERANCE or w < MIN_W:
        hint = (
            "COLMAP and others write qw first: write the position, then the quaternion with qw last, or a "
            "4x4 matrix."
        )
        expected = "tx ty tz qx qy qz qw, with a unit quaternion that turns by less than 90 degrees"
        bad_value(name, expected, f"{path} with {' '.join(f'{value:g}' for value in values)}", hint)
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), values[:3]
    return pose


def read_intrinsics(path: PathLike, name: str = "K") -> np.ndarray:
    """Read K ``(3, 3)`` as ``read_matrix`` does; a projection is named as such."""
    K = read_matrix(path, name)
    if K.shape == (4, 4):
        rows = "; ".join(" ".join(f"{value:g}" for value in row) for row in K[:3, :3])
        hint = f"If it is a projection P = K [I | t], its first three columns are K: {rows}."
        if K[0, 1] or abs(K[2, :2]).any() or K[2, 2] != 1 or K[0, 0] <= 1:
            hint = "If it is a pose, pass it with --E."
        bad_value(name, "a 3x3 matrix", f"{path} with 3x4 or 4x4 numbers", hint)
    return K


def read_matrix(path: PathLike, name: str = "matrix") -> np.ndarray:
    """Read K ``(3, 3)`` or a pose ``(4, 4)`` as float64 from ``.npy`` or text, in rows or as a flat list.

    Text may be an array as Python or NumPy prints it. Seven numbers are ``tx ty tz qx qy qz qw``.
    """
    import numpy as np

    file = check_file(path, name, MATRIX)
    if file.suffix.lower() == ".npy":
        matrix = read_npy(file, name, MATRIX).astype(np.float64)
    else:
        lines = [" ".join(row) for row in read_rows(file, name, MATRIX)]
        has_brackets = any(bracket in line for line in lines for bracket in "[(")
        rows = _printed_rows("\n".join(lines)) if has_brackets else [line.split() for line in lines]
        try:
            matrix = np.array([row for row in rows if row], dtype=np.float64)
        except ValueError:
            hint = "It may be truncated. Pass calibration files with --calib."
            bad_value(name, MATRIX, f"{path} with words in it, or rows of several lengths", hint)
    matrix = np.squeeze(matrix)
    if matrix.ndim == 1 and matrix.size in FLAT:
        matrix = matrix.reshape(FLAT[matrix.size])
    if matrix.shape == (QUATERNION_POSE_SIZE,):
        return _pose_of_quaternion(matrix, path, name)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, (0.0, 0.0, 0.0, 1.0)])
    if matrix.shape not in ((3, 3), (4, 4)):
        hint = (
            "If these are fx fy cx cy, write K in three rows: fx 0 cx, 0 fy cy, 0 0 1."
            if matrix.size == 4
            else ""
        )
        bad_value(name, MATRIX, f"{path} of shape {matrix.shape}", hint)
    if not np.isfinite(matrix).all():
        bad_value(name, "finite", f"NaN or infinity in {path}")
    return matrix
