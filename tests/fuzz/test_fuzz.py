"""No file and no argument, however damaged, ends in a traceback."""

import io
import os
import signal
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.config import PARAMETERS
from geodiff_plugin.formats import as_image_01, read_calibration, read_image, read_matrix, read_points
from geodiff_plugin.formats.captures import read_capture
from geodiff_plugin.formats.images import warn_of_other_lens
from geodiff_plugin.formats.out import check_out
from geodiff_plugin.jobs.pairs import is_many
from tests.contracts import captures, captures_of_fields, captures_of_sfm
from tests.contracts.calibrations import SAMPLES, choice, written
from tests.contracts.captures_in_folders import colmap_text, transforms

COMMON: dict[str, Any] = {
    "deadline": None,
    "database": None,
    "derandomize": True,
    "suppress_health_check": list(HealthCheck),
}
EXAMPLES = settings(max_examples=15, **COMMON)
MANY = settings(max_examples=int(os.environ.get("GEODIFF_FUZZ", "1500")), **COMMON)

WORDS = b'nan inf -inf 1e999 -1 0 1e-300 [ ] { } : , ; = < > 1e5 # " rows:'
TOKENS = [*WORDS.split(), b"\n", b" ", b"\0", b"\xff\xfe", b"9" * 400, b"[" * 3000, b"rows: 99999999999"]


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """A file with a few of its pieces cut out, doubled, overwritten or spoiled."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(0, 4))):
        start = draw(st.integers(0, max(0, len(data))))
        stop = min(len(data), start + draw(st.sampled_from([0, 1, 2, 8, 64, len(whole)])))
        twice = bytes(data[start:stop]) * 2
        data[start:stop] = draw(
            st.just(b"") | st.sampled_from(TOKENS) | st.binary(max_size=8) | st.just(twice)
        )
    return bytes(data)


def _saved(image: Image.Image, kind: str, **given: Any) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format=kind, **given)
    return buffer.getvalue()


def image_bytes() -> dict[str, bytes]:
    """A small image in every format that people send."""
    pixels = np.random.default_rng(0).integers(0, 255, (40, 48, 3), dtype=np.uint8)
    image, exif = Image.fromarray(pixels), Image.Exif()
    kinds = ("PNG", "JPEG", "BMP", "TIFF", "GIF", "WEBP", "PPM", "TGA")
    exif[0x0112] = 6
    exif.get_ifd(0x8769).update({0xA405: 28, 0x920A: 4.2, 0xA002: 48, 0xA003: 40, 0xA20E: 9000.0})
    return {
        **{kind.lower(): _saved(image, kind) for kind in kinds},
        "exif.jpeg": _saved(image, "JPEG", exif=exif),
        "grey16.png": _saved(Image.fromarray(pixels[..., 0].astype(np.uint16) * 200), "PNG"),
    }


def _compressed_pcd(table: np.ndarray) -> bytes:
    """PCL's compressed form, in which a run of literal bytes stands for itself."""
    body = b"".join(table[:, axis].astype("<f4").tobytes() for axis in range(3))
    runs = [body[start : start + 32] for start in range(0, len(body), 32)]
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
    head = (
        b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 12\nDATA binary_compressed\n"
    )
    return head + np.array([len(packed), len(body)], "<u4").tobytes() + packed


def point_files() -> dict[str, bytes]:
    """A whole file of known depths of every kind, by suffix."""
    table = np.random.default_rng(0).uniform(0.5, 5, (12, 3))
    buffer = io.BytesIO()
    np.save(buffer, table)
    head = "ply\nformat {} 1.0\nelement vertex 12\nproperty double x\nproperty double y\nproperty double z\n"
    text = "\n".join(" ".join(f"{v:.3f}" for v in row) for row in table)
    return {
        ".npy": buffer.getvalue(),
        ".txt": text.encode(),
        ".csv": ("x,y,z\n" + text.replace(" ", ",")).encode(),
        ".ply": (head.format("binary_little_endian") + "end_header\n").encode() + table.tobytes(),
        ".PLY": (head.format("ascii") + "end_header\n" + text + "\n").encode(),
        ".pcd": (
            b"VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 12\nDATA binary\n"
            + table.tobytes()
        ),
        ".PCD": _compressed_pcd(table),
        ".dpt": b"PIEH" + np.array([3, 4], "<i4").tobytes() + table[:, 0].astype("<f4").tobytes(),
        ".pfm": b"Pf\n4 3\n-1.0\n" + table[:, 0].astype("<f4").tobytes(),
        ".png": image_bytes()["grey16.png"],
    }


def file_names() -> st.SearchStrategy[str]:
    """Names as a file system may have them, and longer ones."""
    text = st.text(st.characters(blacklist_characters="\0"), min_size=1, max_size=300)
    return text | st.sampled_from(["x" * 300, "a/" * 2500, "~", "-", "..", "/dev/null", "/dev/zero"])


def _array(shape: tuple[int, ...], kind: str, fill: float) -> np.ndarray:
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        finite = fill if kind[0] in "fcO" else float(np.nan_to_num(fill, posinf=9.0))
        return np.full(shape, finite).astype(kind)


def junk() -> st.SearchStrategy[Any]:
    """Values of every kind that an argument may be given accidentally."""
    numbers = st.one_of(st.floats(), st.integers(), st.integers(-(10**40), 10**40), st.booleans())
    few = st.one_of(st.none(), numbers, st.text(max_size=5), st.binary(max_size=3), st.just(Path("x")))
    shapes = [(3, 3), (4, 4), (3, 4), (40, 48, 3), (40, 48), (5, 3), (2, 2), (0,), (1, 3, 40, 48)]
    kinds = ["f4", "f8", "u1", "u2", "i8", "?", "c8", "O", "U3"]
    fills = [0.0, 1.0, -1.0, 0.5, 300.0, np.nan, np.inf]
    arrays = st.builds(_array, *map(st.sampled_from, (shapes, kinds, fills)))

    def nested(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
        several = st.lists(inner, max_size=3)
        return several | several.map(tuple) | st.dictionaries(st.text(max_size=4), inner, max_size=2)

    return st.recursive(st.one_of(few, arrays, st.just(object())), nested, max_leaves=4)


def _too_long(*_: Any) -> None:
    raise AssertionError("it took more than 20 seconds")


def is_recoverable(call: Callable[[], Any]) -> bool:
    """Whether the call understood its input; an error that is not one of our sentences is the test's."""
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(20)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            call()
    except InputError as error:
        assert "\n" not in str(error).strip() and len(str(error)) < 2000, str(error)
        return False
    finally:
        signal.alarm(0)
    return True


RIGHT = np.random.default_rng(0).integers(0, 255, (40, 48, 3), dtype=np.uint8)
K = np.array([[60.0, 0, 23.5], [0, 60.0, 19.5], [0, 0, 1]])
E = np.eye(4)
E[0, 3] = 0.12
GOOD = {"right": RIGHT, "K": K, "E": E}
IMAGES, POINT_FILES = image_bytes(), point_files()
WRITERS = (*captures.WRITERS, *captures_of_fields.WRITERS, *captures_of_sfm.WRITERS)
pytestmark = pytest.mark.parametrize(
    "size", [pytest.param(EXAMPLES, id="few"), pytest.param(MANY, id="many", marks=pytest.mark.slow)]
)


def survives_damage(size: Any, path: Path, whole: bytes, read: Callable[[Any], Any], others: Any) -> None:
    """The whole file is understood; damaged ones, with another argument drawn from ``others``, survive."""
    path.write_bytes(whole)
    assert is_recoverable(lambda: read(None)), "the whole file must be understood"

    @size
    @given(data=damaged(whole), other=others)
    def check(data, other):
        path.write_bytes(data)
        is_recoverable(lambda: read(other))

    check()


@pytest.mark.parametrize("sample", SAMPLES)
def test_calibrations(tmp_path, sample, size):
    """Of formats with two files the second one is damaged."""
    paths, given_too = written(tmp_path, SAMPLES[sample]), {"distorted": True} | choice(sample)
    last = sorted(tmp_path.iterdir())[-1]
    cameras = st.sampled_from([None, None, (0, 1), (2, 3), (7, 7)])

    def read(chosen):
        return read_calibration(paths, cameras=chosen, **given_too)

    survives_damage(size, last, SAMPLES[sample][-1].encode(), read, cameras)


@pytest.mark.parametrize("write", WRITERS, ids=lambda write: write.__name__)
def test_captures(tmp_path, write, size):
    """Damage in one file leaves a capture of the other frames, or a sentence."""
    twin = write(tmp_path / "scan")

    def read(fov):
        read_capture(twin.path, K=twin.typed, fov=fov)

    path = twin.path / twin.file
    survives_damage(size, path, path.read_bytes(), read, st.sampled_from([None, None, 60.0]))


@pytest.mark.parametrize(
    "file", ["transforms.json", *(f"sparse/0/{n}.txt" for n in ("cameras", "images", "points3D"))]
)
def test_transforms_and_colmap(tmp_path, file, size):
    folder = (transforms if "json" in file else colmap_text)(tmp_path / "scan")
    survives_damage(
        size, folder / file, (folder / file).read_bytes(), lambda _: read_capture(folder), st.none()
    )


@pytest.mark.parametrize("suffix", POINT_FILES)
def test_points(tmp_path, suffix, size):
    path = tmp_path / f"points{suffix}"

    def read(scale):
        read_points(path, scale=scale)

    survives_damage(size, path, POINT_FILES[suffix], read, st.sampled_from([None, 256.0, 1e-9, 1e9]))


@pytest.mark.parametrize("kind", IMAGES)
def test_images(tmp_path, kind, size):
    path = tmp_path / f"image.{kind}"

    def read(_):
        read_image(path)
        warn_of_other_lens(path, K, "left")

    survives_damage(size, path, IMAGES[kind], read, st.none())


def test_matrices(tmp_path, size):
    path = tmp_path / "E.txt"

    def read(_):
        GeometryGuidance(RIGHT, K, read_matrix(path, "--E"))

    survives_damage(size, path, b"1 0 0 0.12\n0 1 0 0\n0 0 1 0\n", read, st.none())


def test_arguments_of_the_guidance(size):
    names = st.sampled_from(["right", "K", "E", "points", "left_size", "weights"])
    some = st.sampled_from([name for name in PARAMETERS if name != "weights"])

    @size
    @given(st.dictionaries(names, junk(), min_size=1, max_size=3), st.dictionaries(some, junk(), max_size=2))
    def check(given_, parameters):
        is_recoverable(lambda: GeometryGuidance(**GOOD | given_, **parameters))

    check()


def test_what_stands_for_an_image(size):
    @size
    @given(value=junk(), dtype=st.sampled_from([torch.float32, torch.bfloat16, torch.uint8, torch.bool]))
    def check(value, dtype):
        is_recoverable(lambda: as_image_01(value, "right"))
        if isinstance(value, np.ndarray) and value.dtype.kind in "fui":
            is_recoverable(lambda: as_image_01(torch.from_numpy(value.astype("f4")).to(dtype), "right"))

    check()


def test_names_of_files_and_folders(tmp_path, monkeypatch, size):
    monkeypatch.chdir(tmp_path)
    readers = [read_image, read_calibration, read_points, read_matrix, lambda name: is_many(Path(name))]

    @size
    @given(name=file_names(), reader=st.sampled_from(readers), out=st.text(min_size=1, max_size=300))
    def check(name, reader, out):
        is_recoverable(lambda: reader(name))
        is_recoverable(lambda: check_out(tmp_path / out.replace("\0", "0")))

    check()
