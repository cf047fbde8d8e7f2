"""Rows of a dataset: how their columns become a pair, and the columns of a result against its maps."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._checks import InputError
from geodiff_plugin.jobs import rows
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef
from geodiff_plugin.jobs.rows import COLUMNS, GuidedPair, check_names, read_columns, read_ref, result_columns
from tests.unit.jobs import made_runs

BASE = DepthOptions(left=Path(), seed=4, out=Path("out"))


def one_map(values) -> np.ndarray:
    return np.asarray(values)[0, :, :, 0]


def test_the_columns_of_a_result_are_its_maps_camera_and_numbers():
    run = made_runs.run()
    row, output = result_columns(GuidedPair(run, {})), run.output
    assert set(row) == set(COLUMNS) and row["error"] is None
    depth_m, confidence = one_map(output.prediction), one_map(output.confidence)
    valid = (depth_m > 0) & (confidence > 0)
    millimetres = np.asarray(Image.open(io.BytesIO(row["depth_mm"])))
    np.testing.assert_array_equal(millimetres, np.rint(np.where(valid, depth_m, 0) * 1000.0))
    shares = np.asarray(Image.open(io.BytesIO(row["confidence"])))
    np.testing.assert_array_equal(shares, np.rint(confidence * 255))
    assert (row["width"], row["height"]) == made_runs.SIZES[0]
    K = made_runs.K_LEFT
    assert (row["fx"], row["fy"], row["cx"], row["cy"]) == (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    kept = depth_m[valid].astype(float)
    found = (row["near_m"], row["median_m"], row["far_m"])
    assert found == pytest.approx((kept.min(), np.median(kept), kept.max()))
    assert (row["unit"], row["verdict"]) == ("m", "not trusted")
    assert row["seconds"] == pytest.approx(0.1251 + 2.5004, abs=1e-3)
    codes = [message.code for message in (made_runs.REASON, made_runs.REMARK, made_runs.OF_CALL)]
    assert row["codes"].split()[:3] == codes
    bare = replace(run, output=made_runs.output(confidence=None, unit=None))
    row = result_columns(GuidedPair(bare, {}))
    assert row["confidence"] is None and row["unit"] is None


@pytest.fixture
def read(monkeypatch):
    """The options with which a pair is read, and its files at that time."""
    asked = []

    def read_pair(options, views):
        files = {
            path: path.read_bytes() for path in (options.left, options.right, options.k, options.e) if path
        }
        asked.append((options, views, files))
        return "inputs"

    monkeypatch.setattr(rows, "read_pair", read_pair)
    return asked


@pytest.fixture
def images(tmp_path):
    for side, colour in (("left", 40), ("right", 90)):
        Image.new("RGB", (40, 36), (colour, 0, 0)).save(tmp_path / f"{side}.png")
    return tmp_path


def test_paths_numbers_and_other_options_of_a_row_replace_those_of_all(read, images):
    row = {"left": str(images / "left.png"), "right": str(images / "right.png"), "fx": 50.0, "baseline": 0.1}
    pair = read_columns(BASE, row | {"steps": 3, "city": "Mainz", "cx": None})
    ((options, views, _),) = read
    assert options == replace(
        BASE, left=images / "left.png", right=images / "right.png", fx=50.0, baseline=0.1, steps=3
    )
    assert views is None and (pair.options, pair.inputs, pair.entries) == (options, "inputs", {})
    assert list(pair.log.seconds) == ["calibration"]


def test_bytes_and_matrices_are_files_while_the_pair_is_read(read, images):
    K, K_right, E = np.diag([50.0, 51.0, 1.0]), np.diag([60.0, 61.0, 1.0]), np.eye(4)
    E[:3, 3] = 0.1, 0.2, 0.3
    row = {side: (images / f"{side}.png").read_bytes() for side in ("left", "right")}
    row |= {"K_left": K.ravel().tolist(), "K_right": K_right.ravel().tolist(), "E": E.ravel().tolist()}
    read_columns(BASE, row)
    ((options, _, files),) = read
    assert files[options.left] == row["left"] and files[options.right] == row["right"]
    for path, matrix in ((options.k, K), (options.e, E)):
        np.testing.assert_array_equal(np.load(io.BytesIO(files[path])), matrix)
        assert not path.exists(), "the folder is temporary"
    assert options.k_right not in (None, options.k)
    calibrated = {side: str(images / f"{side}.png") for side in ("left", "right")}
    (images / "calib.txt").write_text("text")
    for value in (str(images / "calib.txt"), [str(images / "calib.txt")]):
        read_columns(BASE, calibrated | {"calib": value})
        assert read[-1][0].calib == (images / "calib.txt",)
    with pytest.raises(InputError, match="The cameras are missing"):
        read_columns(BASE, calibrated)
    with pytest.raises(InputError, match="--seed"):
        read_columns(BASE, calibrated | {"calib": str(images / "calib.txt"), "seed": -1})
    with pytest.raises(InputError, match="RIGHT must be"):
        read_columns(BASE, calibrated | {"calib": str(images / "calib.txt"), "right": b"none"})


def test_a_pair_of_a_command_is_read_with_its_options_and_digests(read, images, monkeypatch):
    rows._views.cache_clear()
    base = replace(BASE, fx=50.0, baseline=0.1)
    ref = PairRef("a", images / "left.png", images / "right.png")
    pair = read_ref(base, ref)
    assert pair.options == replace(base, left=ref.left, right=ref.right, out=Path("out/a"))
    entries = pair.entries["pair"]
    assert (entries["name"], entries["frame"]) == ("a", None)
    assert set(entries["sha256"]) == {str(ref.left), str(ref.right)}
    assert entries["sha256"][str(ref.left)] != entries["sha256"][str(ref.right)]
    with pytest.raises(InputError, match="The cameras are missing"):
        read_ref(BASE, ref)
    with pytest.raises(InputError, match="none.png"):
        read_ref(base, replace(ref, left=images / "none.png"))

    class Views:
        def __init__(self, options):
            self.options = options

        def of(self, ref):
            return f"{ref.name} of {self.options.seed}"

    monkeypatch.setattr(rows, "Views", Views)
    rows._views.cache_clear()
    video = PairRef("000003", images / "left.png", None, frame=3)
    assert read_ref(BASE, video).entries["pair"]["frame"] == 3, "its options are checked once"
    assert read[-1][1] == "000003 of 4"
    rows._views.cache_clear()


def test_names_that_are_no_options_are_refused():
    check_names({"steps": 1, "prior": "a"})
    with pytest.raises(InputError, match="got another, tempo"):
        check_names({"tempo": 1, "steps": 1, "another": 2})
