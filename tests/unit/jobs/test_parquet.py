"""Results as Parquet files, read back by pyarrow itself: what counts as done, and what a run removes."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("pyarrow", reason="pyarrow is in the extra ray")
pytest.importorskip("fsspec")

import pyarrow as pa
import pyarrow.parquet as pq

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.parquet import SCHEMA, Store
from geodiff_plugin.jobs.rows import COLUMNS

BASE = DepthOptions(left=Path("left"), out=Path("out"), seed=5)


def table(*rows: dict):
    """Rows with a column more than a result has."""
    given = [{"city": "Mainz"} | row for row in rows]
    return pa.Table.from_pylist(given, schema=SCHEMA.append(pa.field("city", pa.string())))


@pytest.fixture
def store(tmp_path) -> Store:
    return Store(str(tmp_path / "new/out"))


def names(store: Store) -> list[str]:
    return sorted(path.name for path in Path(store.uri).iterdir())


def test_results_and_errors_are_files_of_their_own_with_the_columns_of_a_result(store):
    assert store.begin(BASE) == set() and names(store) == ["job.json"]
    rows = ({"key": "a", "near_m": 1.5, "verdict": "trusted"}, {"key": "b", "error": "torn"}, {"key": "c"})
    reported = store.put(table(*rows)).to_pylist()
    assert reported == [
        {"key": "a", "verdict": "trusted", "error": None},
        {"key": "b", "verdict": None, "error": "torn"},
        {"key": "c", "verdict": None, "error": None},
    ]
    errors, job, results = names(store)
    assert errors.startswith("errors-") and results.startswith("part-") and job == "job.json"
    written = pq.read_table(Path(store.uri) / results)
    assert written.column_names == ["key", *COLUMNS] and written["key"].to_pylist() == ["a", "c"]
    assert (
        written["near_m"].to_pylist() == [1.5, None] and str(written.schema.field("height").type) == "int32"
    )
    assert pq.read_table(Path(store.uri) / errors)["error"].to_pylist() == ["torn"]
    assert store.keys() == {"a", "c"}
    store.put(table({"key": "d"}))
    assert len(names(store)) == 4 and store.keys() == {"a", "c", "d"}
    store.put(table({"key": "d", "near_m": 2.0}))
    assert len(names(store)) == 4, "the same keys are the same file"


def test_the_next_run_goes_on_unless_its_options_differ_or_all_is_to_be_repeated(store):
    store.begin(BASE)
    store.put(table({"key": "a"}, {"key": "b", "error": "torn"}))
    (Path(store.uri) / ".part-x.parquet.12ab").write_bytes(b"cut off")
    (Path(store.uri) / "folder").mkdir()
    assert store.begin(replace(BASE, workers=3)) == {"a"}
    assert [name.partition("-")[0] for name in names(store)] == ["folder", "job.json", "part"]
    with pytest.raises(InputError, match="made with --seed 5 instead of 6") as caught:
        store.begin(replace(BASE, seed=6))
    assert "--overwrite" in str(caught.value) and len(names(store)) == 3
    assert store.begin(replace(BASE, seed=6, overwrite=True)) == set()
    assert names(store) == ["folder", "job.json"]
    assert json.loads((Path(store.uri) / "job.json").read_text())["seed"] == 6
    (Path(store.uri) / "job.json").unlink()
    (Path(store.uri) / "letter").write_text("dear")
    with pytest.raises(InputError, match="a new or empty folder"):
        store.begin(BASE)


@pytest.mark.parametrize(
    ("typed", "uri"),
    [
        ("s3:/bucket/a", "s3://bucket/a"),
        ("s3:///bucket/a", "s3://bucket/a"),
        ("file:/data/a", "/data/a"),
        ("gs+x.y-1:/b", "gs+x.y-1://b"),
        ("C:/data", "C:/data"),
        ("a/b", "a/b"),
    ],
)
def test_a_uri_has_two_slashes_again(typed, uri):
    assert Store.of(replace(BASE, out=Path(typed))).uri == uri


def test_a_file_system_of_fsspec_is_opened_by_its_uri(tmp_path):
    store = Store(f"memory://{tmp_path.name}")
    assert store.begin(BASE) == set()
    store.put(table({"key": "a"}))
    assert store.begin(BASE) == {"a"} and store.keys() == {"a"}


def test_a_disk_that_is_full_keeps_no_part_of_a_file(store, monkeypatch):
    store.begin(BASE)
    system, folder = store.open()

    class Full:
        def __getattr__(self, name):
            return getattr(system, name)

        def open_output_stream(self, path):
            class Stream:
                def __enter__(self):
                    Path(path).write_bytes(b"half")
                    return self

                def __exit__(self, *_):
                    pass

                def write(self, content):
                    raise OSError(28, "No space left on device")

            return Stream()

    monkeypatch.setattr(Store, "open", lambda self: (Full(), folder))
    with pytest.raises(OSError, match="No space left"):
        store.put(table({"key": "a"}))
    assert names(store) == ["job.json"]
