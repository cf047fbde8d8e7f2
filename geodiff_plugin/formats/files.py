"""Opens files that the user named, with one-sentence errors: text, arrays, camera matrices and poses."""

from __future__ import annotations

import codecs
import hashlib
import os
import re
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import IO, TYPE_CHECKING
from xml.etree import ElementTree

from geodiff_plugin._checks import InputError, InputFileError, MissingFileError, bad_type, bad_value

if TYPE_CHECKING:  # what is wrong with a file is said before numpy is imported
    import numpy as np
    from PIL import Image

PathLike = str | os.PathLike[str]
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
#: EXIF's tag of how an image is turned or mirrored; from 5 on its sides change places.
ORIENTATION = 0x0112
#: Its value for an image that is shown as it is stored.
UPRIGHT = 1
#: Its values that change anything.
TURNS = range(2, 9)
#: A number whose decimals follow a comma, alone between blanks, semicolons or the ends of a line.
DECIMAL_COMMA = re.compile(r"(?<![^\s;])[-+]?\d+,\d+(e[-+]?\d+)?(?![^\s;])", re.IGNORECASE)
#: No calibration file is near this size; a larger one is something else.
LARGEST_TEXT_BYTES = 16_000_000
FLAT = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
MATRIX = "a 3x3 K or a 4x4 (or 3x4) E, as text of numbers or .npy"


def check_file(path: PathLike, name: str, what: str = "a file") -> Path:
    """The path of an existing, readable, non-empty file; messages name the argument and what it is."""
    if not isinstance(path, (str, os.PathLike)):
        bad_type(name, f"the path of {what}", path)
    file = Path(path)
    if os.path.isdir(file):
        bad_value(name, what, f"the folder {path}", "Name the file inside it.", InputFileError)
    if not os.path.exists(file):  # Path.exists() raises on a name that is too long
        bad_value(name, what, f"{path}, which does not exist", "Check the spelling.", MissingFileError)
    if not file.is_file():
        bad_value(name, what, f"{path}, which is a pipe or a device", "Save what it gives as a file first.")
    if not os.access(file, os.R_OK):
        bad_value(name, what, f"{path}, which you may not read", "Check its permissions.", InputFileError)
    if file.stat().st_size == 0:
        bad_value(name, what, f"{path}, which is empty", "Was its download or copy cut off? Fetch it again.")
    _refuse_stand_in(file, name, what)
    return file


def _refuse_stand_in(file: Path, name: str, what: str) -> None:
    """Refuse what failed downloads leave in the place of a file."""
    with file.open("rb") as opened:
        head = opened.read(STAND_IN_BYTES).lstrip().lower()
    if head.startswith(b"version https://git-lfs"):
        bad_value(name, what, f"{file}, a pointer of Git LFS", "Fetch the file itself: git lfs pull.")
    if head.startswith((b"<!doctype html", b"<html")):
        cure = "Its download gave an error or a log-in page: fetch it again."
        bad_value(name, what, f"{file}, a web page", cure)


#: Bytes by which a web page and a pointer of Git LFS are recognised.
STAND_IN_BYTES = 64
MAP_SUFFIXES = (".npy", ".npz", ".pfm", ".png")
DECODE_ERRORS = (OSError, SyntaxError, ValueError, TypeError, KeyError, EOFError, zlib.error)


@contextmanager
def open_image(path: PathLike, name: str, what: str = "an image file") -> Iterator[Image.Image]:
    """Open an image file with Pillow, HEIC by pillow-heif; what is none, or damaged, is refused."""
    from PIL import Image, UnidentifiedImageError

    file = check_file(path, name, what)
    if file.suffix.lower() in (".heic", ".heif"):
        try:
            import pillow_heif
        except ImportError:
            cure = "Run: pip install pillow-heif (the extra heic), or convert it to PNG or JPEG."
            bad_value(name, what, f"{file}, which Pillow reads with pillow-heif only", cure)
        pillow_heif.register_heif_opener()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # what is too large is an error
            image = Image.open(file)
        with image:
            yield image
    except InputError:
        raise
    except UnidentifiedImageError:
        bad_value(name, what, f"{file}, a format that Pillow does not read", "Convert it to PNG or JPEG.")
    except (Image.DecompressionBombError, *DECODE_ERRORS) as error:
        cure = "Is it cut off, or too large?"
        bad_value(name, "a whole image file", f"{file}, which does not decode ({error})", cure)


def save_png(image: Image.Image, file: PathLike | IO[bytes]) -> None:
    """Save a picture as PNG, compressed by zlib's run lengths.

    Photographs and maps become as small as by zlib's default, in less than half of the time: behind PNG's
    filters they repeat hardly anything but single bytes. Only drawn patterns become larger.
    """
    from PIL.Image import RLE

    image.save(file, format="PNG", compress_type=RLE)


def find_map(folder: Path, stem: str) -> Path | None:
    """The first map of a name in a folder, whatever its suffix; ``None`` where there is none."""
    paths = (folder / f"{stem}{suffix}" for suffix in MAP_SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def natural_order(path: Path) -> tuple[list[str | int], str]:
    """Sorts names as people count: f2 before f10."""
    parts = re.split(r"([0-9]+)", path.stem)  # text and numbers in turns, so that like meets like
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name


def stored_size(path: PathLike, name: str) -> tuple[int, int]:
    """``(width, height)`` of an image file as it stores its pixels."""
    with open_image(path, name) as image:
        return image.size


def exif_of(image: Image.Image) -> Image.Exif:
    """The EXIF data of an opened image, of which no more than needed is decoded.

    Pillow decodes a PNG for them, because they may lie behind its pixels.
    """
    from PIL import Image

    file = getattr(image, "fp", None)
    if image.format == "PNG" and file is not None and _ends_with_pixels(file):
        return Image.Image.getexif(image)
    return image.getexif()


def _ends_with_pixels(file: IO[bytes]) -> bool:
    """Whether a whole PNG file has nothing behind its pixels."""
    here, kinds = file.tell(), list[bytes]()
    try:
        file.seek(len(PNG_SIGNATURE))
        while kinds[-1:] != [b"IEND"]:
            head = file.read(8)
            if len(head) < 8:
                return False
            kinds.append(head[4:])
            file.seek(int.from_bytes(head[:4], "big") + 4, os.SEEK_CUR)  # its content and its checksum
    finally:
        file.seek(here)
    return kinds[-2:-1] == [b"IDAT"]


def upright_size(path: PathLike, name: str) -> tuple[int, int]:
    """``(width, height)`` of an image file as it is shown, turned by its EXIF orientation."""
    with open_image(path, name) as image:
        width, height = image.size
        turned = exif_of(image).get(ORIENTATION, 1) >= 5
    return (height, width) if turned else (width, height)


def is_turned(path: PathLike) -> bool:
    """Whether an image file is shown turned or mirrored, by its EXIF orientation."""
    with open_image(path, "the image") as image:
        return exif_of(image).get(ORIENTATION) in TURNS


def read_text(path: PathLike, name: str, what: str = "a text file") -> str:
    """The text of a file, with Unix line ends and no byte-order mark."""
    file = check_file(path, name, what)
    cure = "Is this an image or an archive?"
    size = file.stat().st_size
    if size > LARGEST_TEXT_BYTES:
        bad_value(name, what, f"{file} of {size} bytes", cure)
    raw = file.read_bytes()
    wide = raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # as Windows' shell and Notepad write
    text = raw.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    if "\0" in text or not text.strip():
        bad_value(name, what, f"{file}, which holds {'binary data' if text.strip() else 'only blanks'}", cure)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_xml(text: str) -> ElementTree.Element:
    """The root of an XML text; entities of its own, which may grow without end, are refused."""
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        bad_value("the file", "an XML file", "a document type with entities", "Remove it.")
    return ElementTree.fromstring(text.strip())


def read_rows(path: PathLike, name: str, what: str) -> list[list[str]]:
    """The words of every line that has any, without remarks behind ``#`` and ``//``, quotes and separators.

    Decimal commas are refused: ``1,5 2,5 3,0`` would be six numbers; ``1,2`` alone may be two columns.
    """
    rows = []
    for line in read_text(path, name, what).replace('"', "").splitlines():
        line = re.split("#|//", line)[0].strip(" \t,;")
        comma = DECIMAL_COMMA.search(line)
        if comma and comma.group() != line:
            cure = "Write points for commas, as 1.5 for 1,5."
            bad_value(name, "numbers with a decimal point", f"{path} with {comma.group()}", cure)
        if line:
            rows.append(re.split(r"[\s,;]+", line))
    return rows


def file_digest(path: Path) -> str:
    """SHA-256 of what a file holds, read once as long as its size and time stay the same."""
    state = path.stat()
    return _digest(path.absolute(), state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=4096)
def _digest(path: Path, size: int, changed_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_npy(path: Path, name: str, expected: str) -> np.ndarray:
    """The array of real numbers of an existing file, in the file's own type; nothing is unpickled."""
    import numpy as np

    cure = "Save one array with numpy.save."
    try:
        value = np.load(path, allow_pickle=False)
    except Exception as error:  # a damaged head is parsed as Python, which may fail in any way
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if "pickle" in reason:  # numpy's own words, of any other file too, tell how to run what is in there
            with open(path, "rb") as file:
                pickled = file.read(1) in (b"\x80", b"\x93")
            reason = "pickled objects, which are never loaded" if pickled else "it is of another format"
        bad_value(name, expected, f"{path}, which numpy cannot load ({reason})", cure)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        bad_value(name, expected, f"{path} without an array of real numbers", cure)
    return value


def read_matrix(path: PathLike, name: str = "matrix") -> np.ndarray:
    """A K ``(3, 3)`` or a pose ``(4, 4)``, float64, from ``.npy`` or text: rows, or all numbers in one."""
    import numpy as np

    file = check_file(path, name, MATRIX)
    if file.suffix.lower() == ".npy":
        matrix = read_npy(file, name, MATRIX).astype(np.float64)
    else:
        rows = [re.sub(r"[\[\]()]", " ", " ".join(row)).split() for row in read_rows(file, name, MATRIX)]
        try:
            matrix = np.array([row for row in rows if row], dtype=np.float64)
        except ValueError:
            cure = "Is it cut off? A calibration file with words goes to --calib."
            bad_value(name, MATRIX, f"{path} with words in it, or rows of several lengths", cure)
    matrix = np.squeeze(matrix)
    if matrix.ndim == 1 and matrix.size in FLAT:
        matrix = matrix.reshape(FLAT[matrix.size])
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, (0.0, 0.0, 0.0, 1.0)])
    if matrix.shape not in ((3, 3), (4, 4)):
        cure = "Are these fx fy cx cy? K is three rows: fx 0 cx, 0 fy cy, 0 0 1." if matrix.size == 4 else ""
        bad_value(name, MATRIX, f"{path} of shape {matrix.shape}", cure)
    if not np.isfinite(matrix).all():
        bad_value(name, "finite", f"NaN or infinity in {path}")
    return matrix
