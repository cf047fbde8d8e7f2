"""Records of a job: keys of inputs, shards, what a journal reads back, and what it appends after."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Shard, fingerprint, shard_files


def test_a_fingerprint_changes_with_every_part_and_with_nothing_else(tmp_path):
    file, other = tmp_path / "a", tmp_path / "b"
    file.write_text("one")
    other.write_text("two")
    array = np.arange(6.0).reshape(2, 3)
    long = np.zeros(5000)
    changed = long.copy()
    changed[2500] = 1.0
    parts = [
        (1,),
        (2,),
        ("1",),
        (None,),
        (True,),
        (1, 2),
        (2, 1),
        ([1, 2],),
        ({"a": 1},),
        ({"a": 2},),
        ({"b": 1},),
        (array,),
        (array.reshape(3, 2),),
        (array.astype(np.float32),),
        (array + 1e-12,),
        (long,),
        (changed,),
        (file,),
        (other,),
        ([file],),
        ({"a": file},),
        ({"a": [array]},),
        (np.float64(1.5),),
        (np.float32(1.5),),
    ]
    keys = [fingerprint(*each) for each in parts]
    assert len(set(keys)) == len(parts) and keys == [fingerprint(*each) for each in parts]
    assert all(len(key) == 20 and set(key) <= set("0123456789abcdef") for key in keys)
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert fingerprint((1, 2)) == fingerprint([1, 2]) and fingerprint(array) == fingerprint(array.copy())
    other.write_text("one")
    assert fingerprint(file) == fingerprint(other), "files count by what they hold"
    assert fingerprint(tmp_path) == fingerprint(tmp_path / "none") == fingerprint(None)
    text = json.dumps([1, "a"]).encode()
    assert fingerprint(1, "a") == hashlib.sha256(text).hexdigest()[:20]


def test_shards_divide_the_items_evenly_and_in_order(monkeypatch):
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    items = list(range(11))
    parts = [Shard(index, 3).part(items) for index in range(3)]
    assert parts == [[0, 3, 6, 9], [1, 4, 7, 10], [2, 5, 8]]
    assert Shard().part(items) == items and Shard().whole and not Shard(0, 2).whole
    assert str(Shard(2, 8)) == "2-of-8"
    assert Shard(2, 8).path(Path("a/pairs.csv")) == Path("a/pairs.2-of-8.csv")
    assert Shard().path(Path("a/pairs.csv")) == Path("a/pairs.csv")
    assert Shard(5, 8).local == 5
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert Shard(5, 8).local == 1


@pytest.mark.parametrize(
    ("count", "gpus", "said", "processes"),
    [(6, 4, None, 4), (3, 4, None, 3), (3, 0, None, 1), (1, 4, None, 1), (6, 4, "2", 2)],
)
def test_a_machine_has_a_process_per_gpu_unless_torchrun_sets_the_number(
    monkeypatch, count, gpus, said, processes
):
    monkeypatch.delenv("LOCAL_WORLD_SIZE", raising=False)
    if said:
        monkeypatch.setenv("LOCAL_WORLD_SIZE", said)
    assert Shard(0, count).processes_here(gpus) == processes


def test_a_shard_is_set_by_the_launcher_or_given(monkeypatch):
    monkeypatch.setenv("RANK", "3")
    monkeypatch.setenv("WORLD_SIZE", "5")
    assert Shard.of(None) == Shard(3, 5) and Shard.of("1/9") == Shard(1, 9)
    monkeypatch.delenv("RANK")
    monkeypatch.delenv("WORLD_SIZE")
    assert Shard.of(None) == Shard(0, 1)
    for wrong in ("3/3", "4/3", "1/1", "1/2/3", "1 / 2", "1234567890/2345678901", "-1/2"):
        with pytest.raises(InputError, match="--shard must be I/N"):
            Shard.of(wrong)


def test_files_of_shards_are_found_and_sorted_as_numbers(tmp_path):
    names = ["job.10-of-12.jsonl", "job.2-of-12.jsonl", "job.1-of-2.jsonl", "job.jsonl", "job.1-of-2.csv"]
    for name in [*names, "other.0-of-2.jsonl", "xjob.0-of-2.jsonl"]:
        (tmp_path / name).write_text("")
    found = shard_files(tmp_path / "job.jsonl")
    assert list(found) == [Shard(1, 2), Shard(2, 12), Shard(10, 12)]
    assert [path.name for path in found.values()] == [
        "job.1-of-2.jsonl",
        "job.2-of-12.jsonl",
        "job.10-of-12.jsonl",
    ]
    assert shard_files(tmp_path / "none/job.jsonl") == {}


def test_an_item_is_named_by_its_name_or_its_key():
    assert Item("key").label == "key" and Item("key", name="name").label == "name"


def test_a_record_counts_for_its_key_and_inputs_unless_it_failed_or_is_forgotten(tmp_path):
    a, b = Item("a", inputs="1", head={"frame": "a", "n": 0}), Item("b")
    with Journal(tmp_path / "new/job.jsonl") as journal:
        journal.put(a, {"n": 1})
        journal.put(b, {"status": BROKEN, "error": "no"})
        assert journal.get(a) == {"key": "a", "inputs": "1", "frame": "a", "n": 1}
        assert journal.get(b)["status"] == BROKEN and journal.get(Item("a", inputs="2")) is None
    lines = [json.loads(line) for line in (tmp_path / "new/job.jsonl").read_text().splitlines()]
    assert lines == [
        {"key": "a", "inputs": "1", "frame": "a", "n": 1},
        {"key": "b", "status": BROKEN, "error": "no"},
    ]
    with Journal(tmp_path / "new/job.jsonl") as journal:
        assert journal.get(a)["n"] == 1 and journal.get(b) is None, "a failure is tried again"
        assert journal.read()["b", ""]["status"] == BROKEN
        journal.forget(a)
        journal.forget(a)
        assert journal.get(a) is None
        journal.put(a, {"n": 2})
        journal.put(b, {"n": 3})
        journal.put(b, {"status": BROKEN})
    with Journal(tmp_path / "new/job.jsonl") as journal:
        assert journal.get(a)["n"] == 2 and journal.get(b)["n"] == 3, "the last that did not fail"


def test_a_line_after_a_torn_one_begins_a_line_of_its_own(tmp_path):
    path = tmp_path / "job.jsonl"
    path.write_bytes(b'{"key": "a"}\n{"key": "b", "va')
    with Journal(path) as journal:
        assert journal.get(Item("a")) == {"key": "a"} and journal.get(Item("b")) is None
        journal.put(Item("c"), {})
        journal.put(Item("d"), {})
    assert path.read_bytes() == b'{"key": "a"}\n{"key": "b", "va\n{"key": "c"}\n{"key": "d"}\n'
    with Journal(path) as journal:
        assert all(journal.get(Item(key)) is not None for key in "acd")


def test_shards_read_each_others_records_and_write_their_own(tmp_path):
    path = tmp_path / "job.jsonl"
    with Journal(path) as whole, Journal(path, Shard(0, 2)) as first:
        whole.put(Item("w"), {})
        first.put(Item("f"), {})
        with Journal(path, Shard(1, 2)) as second:
            assert second.get(Item("w")) and second.get(Item("f"))
            assert second.path.name == "job.1-of-2.jsonl"
        with pytest.raises(InputError, match=f"Another run is using {tmp_path}"):
            Journal(path, Shard(0, 2))
    with Journal(path) as again:
        assert again.get(Item("f")) and again.path == path


def test_a_folder_that_cannot_be_written_is_an_input_error(tmp_path):
    (tmp_path / "file").write_text("text")
    with pytest.raises(InputError, match="file"):
        Journal(tmp_path / "file/job.jsonl")


def test_a_line_that_the_disk_has_no_room_for_is_an_error(tmp_path):
    with Journal(tmp_path / "job.jsonl") as journal:

        class Full:
            def __getattr__(self, name):
                return getattr(journal_file, name)

            def write(self, line):
                return len(line) - 1

        journal_file, journal._file = journal._file, Full()
        with pytest.raises(OSError, match="No space left"):
            journal.put(Item("a"), {})
        assert journal.get(Item("a")) is None
        journal._file = journal_file
