"""The table of a job from those of its shards: all rows in the order of the whole job, numbers as numbers."""

import csv

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs.journal import Shard
from geodiff_plugin.jobs.pairs import COLUMNS, SUMMARY
from geodiff_plugin.jobs.tables import merge_shards, write_table


def row(number: int) -> dict:
    if number == 4:
        return dict.fromkeys(COLUMNS) | {"pair": "p4", "result": "failed", "message": "torn, it is"}
    numbers = {"near_m": 1.5, "median_m": 2.5, "far_m": 3.25, "confidence": 0.5, "seconds": 7.5}
    row = {name: value + number for name, value in numbers.items()}
    return row | {
        "pair": f"p{number}",
        "result": "done",
        "verdict": "trusted",
        "message": None,
        "codes": "pose.refined",
    }


def write_shards(folder, total: int, count: int) -> list[dict]:
    rows = [row(number) for number in range(total)]
    for index in range(count):
        shard = Shard(index, count)
        write_table(shard.path(folder / SUMMARY), shard.part(rows))
    return rows


@pytest.mark.parametrize(("total", "count"), [(8, 3), (6, 3), (2, 3), (5, 1 + 1)])
def test_rows_are_joined_in_the_order_of_the_job(tmp_path, total, count):
    rows = write_shards(tmp_path, total, count)
    assert merge_shards(tmp_path) == rows
    with open(tmp_path / SUMMARY, newline="") as file:
        written = list(csv.DictReader(file))
    assert [each["pair"] for each in written] == [each["pair"] for each in rows]
    assert list(written[0]) == list(COLUMNS)
    assert written[0]["near_m"] == "1.5" and written[0]["message"] == ""


def test_shards_that_are_missing_or_of_another_job_are_named(tmp_path):
    with pytest.raises(InputError, match="has no table of a shard"):
        merge_shards(tmp_path)
    write_shards(tmp_path, 8, 4)
    for index in (1, 3):
        Shard(index, 4).path(tmp_path / SUMMARY).unlink()
    with pytest.raises(InputError, match="Run --shard 1/4, --shard 3/4."):
        merge_shards(tmp_path)
    write_shards(tmp_path, 8, 4)
    write_table(Shard(0, 2).path(tmp_path / SUMMARY), [])
    with pytest.raises(InputError, match="tables of 2 and of 4 shards"):
        merge_shards(tmp_path)


def test_a_table_that_cannot_be_written_is_reported_and_no_error(tmp_path):
    reported = []
    (tmp_path / "file").write_text("")
    write_table(tmp_path / "file/pairs.csv", [row(1)], reported.append)
    assert len(reported) == 1 and "pairs.csv could not be written" in reported[0]
