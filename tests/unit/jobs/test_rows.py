"""Rows of a dataset: how their columns become a pair, and the columns of a result against its maps."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.formats.depth import depth_mm
from geodiff_plugin.jobs import reading, rows
from geodiff_plugin.jobs.finished import changed_options
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pair import run_read_pair
from geodiff_plugin.jobs.pairs import PairRef
from geodiff_plugin.jobs.prior import load_guided_prior
from geodiff_plugin.jobs.reading import read_pair
from geodiff_plugin.jobs.records import PairRun
from geodiff_plugin.jobs.report import single_map
from geodiff_plugin.jobs.rows import COLUMNS, check_names, read_columns, read_ref, result_columns
from geodiff_plugin.runtime.machine import pick_device
from tests.unit.jobs import made_runs

BASE = DepthOptions(left=Path(), seed=4, out=Path("out"))


def one_map(values) -> np.ndarray:
    return np.asarray(values)[0, :, :, 0]


def test_the_columns_of_a_result_are_its_maps_camera_and_numbers():
    run = made_runs.run()
    row, output = result_columns(run), run.output
    assert set(row) == set(COLUMNS) and row["error"] is None
    depth_m, confidence = one_map(output.prediction), one_map(output.confidence)
    valid = (depth_m > 0) & (confidence > 0)
    millimetres = np.asarray(Image.open(io.BytesIO(row["depth_mm"])))
    np.testing.assert_array_equal(millimetres, np.rint(np.where(valid, depth_m, 0) * 1000.0))
    fractions = np.asarray(Image.open(io.BytesIO(row["confidence"])))
    np.testing.assert_array_equal(fractions, np.rint(confidence * 255))
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
    row = result_columns(bare)
    assert row["confidence"] is None and row["unit"] is None


def test_removed_depths_are_0_in_all_maps_of_a_row():
    run = made_runs.run()
    depth_m, sigma_m = one_map(run.output.prediction), one_map(run.output.sigma)
    most = float(np.nanquantile(sigma_m, 0.4))
    row = result_columns(replace(run, output=run.output.with_holes(0.5, most)))
    kept = (one_map(run.output.confidence) >= 0.5) & (sigma_m <= most)
    assert 0.05 < kept.mean() < 0.6
    for name in ("depth_mm", "confidence", "sigma_mm"):
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(row[name]))) > 0, kept)
    assert row["far_m"] == pytest.approx(float(depth_m[kept].max()))


@pytest.fixture
def read(monkeypatch):
    """The options with which a pair is read, and its files at that time."""
    asked = []

    def read_pair(options, views, packing=None, overlays=None):
        files = {
            path: path.read_bytes() for path in (options.left, options.right, options.k, options.e) if path
        }
        asked.append((options, views, files))
        return "inputs"

    monkeypatch.setattr(reading, "read_pair", read_pair)
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
    assert views is None and (pair.options, pair.inputs, pair.origin) == (options, "inputs", None)
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
    rows._reader.cache_clear()
    monkeypatch.setattr(reading.PairReader, "_overlays_of", lambda *_: None)
    base = replace(BASE, fx=50.0, baseline=0.1)
    ref = PairRef("a", images / "left.png", images / "right.png")
    pair = read_ref(base, ref)
    assert pair.options == replace(base, left=ref.left, right=ref.right, out=Path("out/a"))
    assert (pair.origin.name, pair.origin.frame) == ("a", None)
    assert set(pair.origin.sha256) == {str(ref.left), str(ref.right)}
    assert pair.origin.sha256[str(ref.left)] != pair.origin.sha256[str(ref.right)]
    with pytest.raises(InputError, match="The cameras are missing"):
        read_ref(BASE, ref)
    with pytest.raises(InputError, match="none.png"):
        read_ref(base, replace(ref, left=images / "none.png"))

    def frames_of(reader, ref):
        return f"{ref.name} of {reader._options.seed}"

    monkeypatch.setattr(reading.PairReader, "frames_of", frames_of)
    rows._reader.cache_clear()
    video = PairRef("000003", images / "left.png", None, frame=3)
    assert read_ref(BASE, video).origin.frame == 3, "its options are checked once"
    assert read[-1][1] == "000003 of 4"
    rows._reader.cache_clear()


def test_names_that_are_no_options_are_rejected():
    check_names({"steps": 1, "prior": "a"})
    with pytest.raises(InputError, match="got another, tempo"):
        check_names({"tempo": 1, "steps": 1, "another": 2})


BASE_ROWS = DepthOptions(left=Path(), steps=1, preset="paper", device="cpu")
FILES = {side: DEMO_PAIR_FOLDER / f"{side}.png" for side in ("left", "right")}
CALIB = DEMO_PAIR_FOLDER / "calib.txt"


def bytes_of_images() -> dict[str, bytes]:
    return {side: path.read_bytes() for side, path in FILES.items()}


def test_a_row_of_paths_and_one_of_bytes_and_matrices_are_the_pair_of_the_command():
    reported = read_pair(replace(BASE_ROWS, **FILES, calib=(CALIB,)))
    inputs = reported.guidance.inputs[0]
    view = inputs.views[0]
    by_path = read_columns(
        BASE_ROWS, {name: str(path) for name, path in FILES.items()} | {"calib": str(CALIB)}
    )
    matrices = {
        "K_left": inputs.left.K.ravel().tolist(),
        "K_right": view.camera.K.ravel().tolist(),
        "E": np.linalg.inv(view.T_right_from_left).ravel().tolist(),
    }
    by_bytes = read_columns(BASE_ROWS, bytes_of_images() | matrices | {"city": "Mainz", "calib": None})
    for pair in (by_path, by_bytes):
        np.testing.assert_array_equal(np.asarray(pair.inputs.left), np.asarray(reported.left))
        got = pair.inputs.guidance.inputs[0]
        np.testing.assert_allclose(got.left.K, inputs.left.K)
        np.testing.assert_allclose(got.views[0].T_right_from_left, view.T_right_from_left, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"left": b"no image"}, "LEFT must be"),
        ({"left": "nowhere.png"}, "nowhere.png"),
        ({"calib": None}, "The cameras are missing"),
        ({"calib": None, "K_left": [1.0] * 9, "E": np.eye(4).ravel().tolist()}, "--K must"),
        ({"seed": -1}, "--seed"),
    ],
)
def test_a_row_that_cannot_be_read_states_the_reason(changes, message):
    with pytest.raises(InputError, match=message):
        read_columns(BASE_ROWS, bytes_of_images() | {"calib": str(CALIB)} | changes)


def test_options_that_do_not_exist_are_named():
    check_names({"steps": 1})
    with pytest.raises(InputError, match="got tempo"):
        check_names({"steps": 1, "tempo": 3})


@pytest.fixture(scope="module")
def guided() -> PairRun:
    pair = read_columns(replace(BASE_ROWS, preset="default"), bytes_of_images() | {"calib": str(CALIB)})
    pipe = load_guided_prior("bundled", pick_device("cpu"))
    return run_read_pair(pipe, pair)


def test_columns_of_a_result_decode_to_its_maps(guided):
    row, output = result_columns(guided), guided.output
    assert set(row) == set(COLUMNS) and row["error"] is None
    depth = np.asarray(Image.open(io.BytesIO(row["depth_mm"])))
    np.testing.assert_array_equal(depth, depth_mm(single_map(output.prediction)))
    assert depth.dtype == np.uint16 and depth.shape == (row["height"], row["width"])
    confidence = np.asarray(Image.open(io.BytesIO(row["confidence"]))) / 255
    np.testing.assert_allclose(confidence, single_map(output.confidence), atol=0.5 / 255 + 1e-6)
    assert row["near_m"] <= row["median_m"] <= row["far_m"] and row["unit"] == output.unit
    assert row["verdict"] == output.verdict.status


def result_depth(guided: PairRun) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(result_columns(guided)["depth_mm"])))


def test_depth_out_of_reach_is_unknown_in_its_column(guided):
    """As of a sky, whose confidence is 0."""
    confidence = np.array(guided.output.confidence)
    assert result_depth(guided)[60:70, 80:90].all()
    single_map(confidence)[60:70, 80:90] = 0.0  # a view
    run = replace(guided, output=replace(guided.output, confidence=confidence))
    assert not result_depth(run)[60:70, 80:90].any()


def test_a_run_with_other_options_is_reported_with_the_names_of_options():
    made = replace(BASE_ROWS, out=Path("a")).as_json()
    assert changed_options(replace(BASE_ROWS, out=Path("b"), engine="ray", workers=3), made) == []
    assert changed_options(replace(BASE_ROWS, seed=3), made) == ["made with --seed 0 instead of 3"]
    large = replace(BASE_ROWS, resolution=512)
    assert changed_options(large, made) == ["made with the default of --resolution instead of 512"]
    assert changed_options(BASE_ROWS, large.as_json()) == [
        "made with --resolution 512 instead of the default"
    ]
    del made["seed"]
    assert changed_options(replace(BASE_ROWS, seed=3), made) == [], (
        "of an option that is newer nothing is known"
    )


class TestStore:
    """Files on a disk, and on a file system of fsspec."""

    @pytest.fixture(params=["disk", "memory"])
    def store(self, request, tmp_path):
        parquet = pytest.importorskip("geodiff_plugin.jobs.parquet", reason="pyarrow is in the extra ray")
        if request.param == "disk":
            return parquet.Store(str(tmp_path / "out"))
        return parquet.Store(f"memory://{tmp_path.name}/out")

    @staticmethod
    def table(*rows: dict):
        pa = pytest.importorskip("pyarrow")
        from geodiff_plugin.jobs.parquet import SCHEMA

        return pa.Table.from_pylist(list(rows), schema=SCHEMA)

    def test_what_was_done_is_there_and_what_failed_is_not(self, store):
        assert store.begin(BASE_ROWS) == set()
        reported = store.put(self.table({"key": "a", "verdict": "trusted"}, {"key": "b", "error": "torn"}))
        assert reported.to_pylist() == [
            {"key": "a", "verdict": "trusted", "error": None},
            {"key": "b", "verdict": None, "error": "torn"},
        ]
        assert [name.partition("-")[0] for name in store._names()] == ["errors", "job.json", "part"]
        assert store.begin(BASE_ROWS) == {"a"}
        assert [name.partition("-")[0] for name in store._names()] == ["job.json", "part"]
        assert store.begin(replace(BASE_ROWS, overwrite=True)) == set()

    def test_a_task_that_is_done_again_writes_the_same_file(self, store):
        store.begin(BASE_ROWS)
        for _ in range(2):
            store.put(self.table({"key": "a"}, {"key": "b"}))
        assert len(store._names()) == 2 and store.keys() == {"a", "b"}

    def test_other_options_and_other_files_are_rejected(self, store):
        store.begin(BASE_ROWS)
        with pytest.raises(InputError, match="made with --seed 0 instead of 3"):
            store.begin(replace(BASE_ROWS, seed=3))
        assert store.begin(replace(BASE_ROWS, seed=3, overwrite=True)) == set()
        other = replace(store, uri=f"{store.uri}-other")
        other.open()[0].create_dir(other.open()[1], recursive=True)
        other._write("letter.txt", b"dear")
        with pytest.raises(InputError, match="a new or empty folder"):
            other.begin(BASE_ROWS)

    @pytest.mark.parametrize(
        ("typed", "uri"),
        [
            ("s3://bucket/depth", "s3://bucket/depth"),
            ("gs://bucket/a/b", "gs://bucket/a/b"),
            ("file:///data/out", "/data/out"),
            ("/data/out", "/data/out"),
            ("out", "out"),
        ],
    )
    def test_a_uri_passes_through_the_path_of_an_option(self, typed, uri):
        parquet = pytest.importorskip("geodiff_plugin.jobs.parquet", reason="pyarrow is in the extra ray")
        assert parquet.Store.of(replace(BASE_ROWS, out=Path(typed))).uri == uri

    def test_the_job_file_is_readable(self, store):
        store.begin(replace(BASE_ROWS, seed=7))
        system, folder = store.open()
        with system.open_input_stream(f"{folder}/job.json") as file:
            assert json.loads(file.read())["seed"] == 7
