"""No file and no argument, however damaged, ends in a traceback."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.cli.pairs import is_many
from geodiff_plugin.config import KNOBS
from geodiff_plugin.formats import as_image_01, read_calibration, read_image, read_matrix, read_points
from geodiff_plugin.formats.exif import warn_of_other_lens
from geodiff_plugin.formats.out import check_out
from tests.contracts.calibrations import SAMPLES, choice, written
from tests.fuzz.strategies import (
    EXAMPLES,
    MANY,
    damaged,
    file_names,
    image_bytes,
    junk,
    point_files,
    survives,
)

SIZES = [pytest.param(EXAMPLES, id="few"), pytest.param(MANY, id="many", marks=pytest.mark.slow)]
RIGHT = np.random.default_rng(0).integers(0, 255, (40, 48, 3), dtype=np.uint8)
K = np.array([[60.0, 0, 23.5], [0, 60.0, 19.5], [0, 0, 1]])
E = np.eye(4)
E[0, 3] = 0.12
GOOD = {"right": RIGHT, "K": K, "E": E}
IMAGES, POINT_FILES = image_bytes(), point_files()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("sample", SAMPLES)
def test_calibrations(tmp_path, sample, size):
    """Of formats with two files the second one is damaged."""
    texts, given_too = SAMPLES[sample], {"distorted": True} | choice(sample)
    paths = written(tmp_path, texts)
    assert survives(lambda: read_calibration(paths, **given_too)), "the whole file must be understood"

    @size
    @given(data=damaged(texts[-1].encode()), cameras=st.sampled_from([None, None, (0, 1), (2, 3), (7, 7)]))
    def check(data, cameras):
        (paths[-1] if isinstance(paths, tuple) else paths).write_bytes(data)
        survives(lambda: read_calibration(paths, cameras=cameras, **given_too))

    check()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("suffix", POINT_FILES)
def test_points(tmp_path, suffix, size):
    path, calib = tmp_path / f"points{suffix}", tmp_path / "calib.txt"
    eye = "1 0 0 0 1 0 0 0 1"
    calib.write_text(f"P2: 700 0 320 0 0 700 240 0 0 0 1 0\nR0_rect: {eye}\nTr_velo_to_cam: {eye} 0 0 0\n")
    given_too = {"calibration": (calib,)} if suffix == ".bin" else {}
    path.write_bytes(POINT_FILES[suffix])
    assert survives(lambda: read_points(path, **given_too)), "the whole file must be understood"

    @size
    @given(data=damaged(POINT_FILES[suffix]), scale=st.sampled_from([None, 256.0, 1e-9, 1e9]))
    def check(data, scale):
        path.write_bytes(data)
        survives(lambda: read_points(path, scale=scale, **given_too))

    check()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", IMAGES)
def test_images(tmp_path, kind, size):
    path = tmp_path / f"image.{kind}"
    path.write_bytes(IMAGES[kind])
    assert survives(lambda: read_image(path)), "the whole file must be understood"

    @size
    @given(data=damaged(IMAGES[kind]))
    def check(data):
        path.write_bytes(data)
        if survives(lambda: read_image(path)):
            survives(lambda: warn_of_other_lens(path, K, "left"))

    check()


@pytest.mark.parametrize("size", SIZES)
def test_matrices(tmp_path, size):
    path = tmp_path / "E.txt"

    @size
    @given(data=damaged(b"1 0 0 0.12\n0 1 0 0\n0 0 1 0\n"))
    def check(data):
        path.write_bytes(data)
        survives(lambda: GeometryGuidance(RIGHT, K, read_matrix(path, "--E")))

    check()


@pytest.mark.parametrize("size", SIZES)
def test_arguments_of_the_guidance(size):
    knobs = [name for name in KNOBS if name != "weights"]

    @size
    @given(
        given_=st.dictionaries(
            st.sampled_from(["right", "K", "E", "points", "left_size", "weights"]),
            junk(),
            min_size=1,
            max_size=3,
        ),
        knobs=st.dictionaries(st.sampled_from(knobs), junk(), max_size=2),
    )
    def check(given_, knobs):
        survives(lambda: GeometryGuidance(**GOOD | given_, **knobs))

    check()


@pytest.mark.parametrize("size", SIZES)
def test_what_stands_for_an_image(size):
    @size
    @given(value=junk(), dtype=st.sampled_from([torch.float32, torch.bfloat16, torch.uint8, torch.bool]))
    def check(value, dtype):
        survives(lambda: as_image_01(value, "right"))
        if isinstance(value, np.ndarray) and value.dtype.kind in "fui":
            survives(lambda: as_image_01(torch.from_numpy(value.astype("f4")).to(dtype), "right"))

    check()


@pytest.mark.parametrize("size", SIZES)
def test_names_of_files(tmp_path, monkeypatch, size):
    monkeypatch.chdir(tmp_path)
    readers = [read_image, read_calibration, read_points, read_matrix, lambda name: is_many(Path(name))]

    @size
    @given(name=file_names(), reader=st.sampled_from(readers))
    def check(name, reader):
        survives(lambda: reader(name))

    check()


@pytest.mark.parametrize("size", SIZES)
def test_names_of_folders(tmp_path, monkeypatch, size):
    monkeypatch.chdir(tmp_path)

    @size
    @given(name=st.text(min_size=1, max_size=300))
    def check(name):
        survives(lambda: check_out(tmp_path / name.replace("\0", "0")))

    check()
