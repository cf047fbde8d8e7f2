"""Pairs that an earlier run has finished: what counts as finished, and what as made from something else."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from geodiff_plugin import InputError
from geodiff_plugin.jobs import many
from geodiff_plugin.jobs.finished import file_digests, finished_row, row_of
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.telling import silent


@pytest.fixture
def options(tmp_path) -> DepthOptions:
    """Of a pair of files, whose result with its report lies in ``out``."""
    for name in ("left", "right", "K", "E"):
        (tmp_path / name).write_text(name)
    paths = {name: tmp_path / name for name in ("left", "right", "out")}
    options = DepthOptions(**paths, k=tmp_path / "K", e=tmp_path / "E")
    options.out.mkdir()
    (options.out / "depth.npy").write_text("depth")
    write_report(options)
    return options


def report_for(options: DepthOptions) -> dict:
    return {
        "arguments": options.as_json(),
        "depth": {"min_m": 1.0, "median_m": 2.0, "max_m": 3.0},
        "verdict": {"status": "trusted", "indicators": {"confidence": 0.8}, "reasons": []},
        "seconds": {"calibration": 0.25, "guided": 1.5},
        "warnings": ["A warning."],
        "messages": [{"code": "camera.filled-in"}],
        "files": {"names": ["depth.npy", "report.json"]},
        "pair": {"sha256": file_digests(options)},
    }


def write_report(options: DepthOptions, **changes) -> None:
    (options.out / "report.json").write_text(json.dumps(report_for(options) | changes))


def test_a_whole_folder_of_the_same_options_and_files_is_finished(options):
    row = finished_row(options)
    assert row == row_of(report_for(options))
    assert (row["near_m"], row["confidence"], row["seconds"], row["codes"]) == (
        1.0,
        0.8,
        1.75,
        "camera.filled-in",
    )
    assert finished_row(replace(options, quiet=True, strict=True, device="cpu")) == row
    write_report(options, pair={})  # by a version that did not know them
    assert finished_row(options) == row


@pytest.mark.parametrize("name", ["depth.npy", "report.json"])
@pytest.mark.parametrize("way", [lambda path: path.unlink(), lambda path: path.write_text("")])
def test_a_folder_without_one_of_its_files_or_with_an_empty_one_is_not(name, way, options):
    way(options.out / name)
    assert finished_row(options) is None


def test_a_report_of_something_else_is_none(options):
    for text in ("{}", "[1]", '{"arguments": {}}', json.dumps(report_for(options) | {"files": None})):
        (options.out / "report.json").write_text(text)
        assert finished_row(options) is None


def test_other_options_and_other_contents_are_refused_with_what_differs(options):
    with pytest.raises(InputError, match="made with --seed 0 instead of 7"):
        finished_row(replace(options, seed=7))
    Path(options.right).write_text("another")
    with pytest.raises(InputError, match=r"made before \S*right changed"):
        finished_row(options)


def test_what_a_folder_says_goes_before_what_the_journal_says(options):
    there = row_of(report_for(options))
    row = many._final({"key": "a", "near_m": 9.0, "verdict": "not trusted"}, there, options, silent)
    assert (row["pair"], row["result"], row["near_m"], row["verdict"]) == ("a", "there", 1.0, "trusted")
    row = many._final({"key": "a", **there}, None, options, silent)
    assert (row["result"], row["near_m"]) == ("done", 1.0)
