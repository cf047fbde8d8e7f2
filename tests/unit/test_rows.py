"""Pairs as rows, without Ray: what is read of the columns, what a result holds, and its Parquet files."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin import InputError
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.formats.depth import depth_mm
from geodiff_plugin.jobs.finished import changed_options
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pair import run_pair
from geodiff_plugin.jobs.prior import load_guided_prior
from geodiff_plugin.jobs.reading import read_pair
from geodiff_plugin.jobs.report import single_map
from geodiff_plugin.jobs.rows import COLUMNS, GuidedPair, check_names, read_columns, result_columns
from geodiff_plugin.runtime.machine import pick_device

BASE = DepthOptions(left=Path(), steps=1, preset="paper", device="cpu")
FILES = {side: DEMO_PAIR_FOLDER / f"{side}.png" for side in ("left", "right")}
CALIB = DEMO_PAIR_FOLDER / "calib.txt"


def bytes_of_images() -> dict[str, bytes]:
    return {side: path.read_bytes() for side, path in FILES.items()}


def test_a_row_of_paths_and_one_of_bytes_and_matrices_are_the_pair_of_the_command():
    told = read_pair(replace(BASE, **FILES, calib=(CALIB,)))
    inputs = told.guidance.inputs[0]
    view = inputs.views[0]
    by_path = read_columns(BASE, {name: str(path) for name, path in FILES.items()} | {"calib": str(CALIB)})
    matrices = {
        "K_left": np.asarray(inputs.K_left).ravel().tolist(),
        "K_right": np.asarray(view.K).ravel().tolist(),
        "E": np.linalg.inv(np.asarray(view.T_right_from_left)).ravel().tolist(),
    }
    by_bytes = read_columns(BASE, bytes_of_images() | matrices | {"city": "Mainz", "calib": None})
    for pair in (by_path, by_bytes):
        np.testing.assert_array_equal(np.asarray(pair.inputs.left), np.asarray(told.left))
        got = pair.inputs.guidance.inputs[0]
        np.testing.assert_allclose(np.asarray(got.K_left), np.asarray(inputs.K_left))
        np.testing.assert_allclose(
            np.asarray(got.views[0].T_right_from_left), np.asarray(view.T_right_from_left), atol=1e-12
        )


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
def test_a_row_that_cannot_be_read_says_why(changes, message):
    with pytest.raises(InputError, match=message):
        read_columns(BASE, bytes_of_images() | {"calib": str(CALIB)} | changes)


def test_options_that_do_not_exist_are_named():
    check_names({"steps": 1})
    with pytest.raises(InputError, match="got tempo"):
        check_names({"steps": 1, "tempo": 3})


@pytest.fixture(scope="module")
def guided() -> GuidedPair:
    pair = read_columns(replace(BASE, preset="default"), bytes_of_images() | {"calib": str(CALIB)})
    pipe = load_guided_prior("bundled", pick_device("cpu"))
    return GuidedPair(run_pair(pipe, pair.options, pair.inputs, pair.log), {})


def test_columns_of_a_result_decode_to_its_maps(guided):
    row, output = result_columns(guided), guided.run.output
    assert set(row) == set(COLUMNS) and row["error"] is None
    depth = np.asarray(Image.open(io.BytesIO(row["depth_mm"])))
    np.testing.assert_array_equal(depth, depth_mm(single_map(output.prediction)))
    assert depth.dtype == np.uint16 and depth.shape == (row["height"], row["width"])
    confidence = np.asarray(Image.open(io.BytesIO(row["confidence"]))) / 255
    np.testing.assert_allclose(confidence, single_map(output.confidence), atol=0.5 / 255 + 1e-6)
    assert row["near_m"] <= row["median_m"] <= row["far_m"] and row["unit"] == output.unit
    assert row["verdict"] == output.verdict.status


def result_depth(guided: GuidedPair) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(result_columns(guided)["depth_mm"])))


def test_depth_out_of_reach_is_unknown_in_its_column(guided):
    """As of a sky, whose confidence is 0."""
    confidence = np.array(guided.run.output.confidence)
    assert result_depth(guided)[60:70, 80:90].all()
    single_map(confidence)[60:70, 80:90] = 0.0  # a view
    run = replace(guided.run, output=replace(guided.run.output, confidence=confidence))
    assert not result_depth(GuidedPair(run, {}))[60:70, 80:90].any()


def test_a_run_of_other_options_is_told_in_the_words_of_the_command():
    made = replace(BASE, out=Path("a")).as_json()
    assert changed_options(replace(BASE, out=Path("b"), engine="ray", workers=3), made) == []
    assert changed_options(replace(BASE, seed=3), made) == ["made with --seed 0 instead of 3"]
    large = replace(BASE, resolution=512)
    assert changed_options(large, made) == ["made with the default of --resolution instead of 512"]
    assert changed_options(BASE, large.as_json()) == ["made with --resolution 512 instead of the default"]
    del made["seed"]
    assert changed_options(replace(BASE, seed=3), made) == [], "of an option that is newer nothing is known"


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
        assert store.begin(BASE) == set()
        told = store.put(self.table({"key": "a", "verdict": "trusted"}, {"key": "b", "error": "torn"}))
        assert told.to_pylist() == [
            {"key": "a", "verdict": "trusted", "error": None},
            {"key": "b", "verdict": None, "error": "torn"},
        ]
        assert [name.partition("-")[0] for name in store._names()] == ["errors", "job.json", "part"]
        assert store.begin(BASE) == {"a"}
        assert [name.partition("-")[0] for name in store._names()] == ["job.json", "part"]
        assert store.begin(replace(BASE, overwrite=True)) == set()

    def test_a_task_that_is_done_again_writes_the_same_file(self, store):
        store.begin(BASE)
        for _ in range(2):
            store.put(self.table({"key": "a"}, {"key": "b"}))
        assert len(store._names()) == 2 and store.keys() == {"a", "b"}

    def test_other_options_and_other_files_are_refused(self, store):
        store.begin(BASE)
        with pytest.raises(InputError, match="made with --seed 0 instead of 3"):
            store.begin(replace(BASE, seed=3))
        assert store.begin(replace(BASE, seed=3, overwrite=True)) == set()
        other = replace(store, uri=f"{store.uri}-other")
        other.open()[0].create_dir(other.open()[1], recursive=True)
        other._write("letter.txt", b"dear")
        with pytest.raises(InputError, match="a new or empty folder"):
            other.begin(BASE)

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
        assert parquet.Store.of(replace(BASE, out=Path(typed))).uri == uri

    def test_the_job_file_is_readable(self, store):
        store.begin(replace(BASE, seed=7))
        system, folder = store.open()
        with system.open_input_stream(f"{folder}/job.json") as file:
            assert json.loads(file.read())["seed"] == 7
