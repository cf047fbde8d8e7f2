"""When a finished pair is that of other options: every option changes its key, or is listed with a reason."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs import many
from geodiff_plugin.jobs.finished import changed_options, file_digests, finished_row, row_of
from geodiff_plugin.jobs.notices import silent
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.settings import Affects, names_affecting, settings_of

#: Options that do not change a result, and why.
NO_DIFFERENCE = {
    "out": "the folder of the result itself",
    "overwrite": "what becomes of earlier results",
    "quiet": "what is printed",
    "json": "what is printed",
    "strict": "what a finished result is worth, judged again by each run",
    "temporal_smoothing": "added to finished results by the run that asks for it",
    "shard": "which process makes it",
    "engine": "which process makes it",
    "format": "another kind of folder",
    "workers": "which process makes it",
    "gpus": "which process makes it",
    "device": "equal within rounding",
    "cuda_graphs": "equal within rounding",
    "no_triton": "equal within rounding",
    "encoding": "of the bag that is written from the results",
}
FIELDS = {field.name: field for field in fields(DepthOptions)}
BASE = DepthOptions(left=Path("left.png"), right=Path("right.png"))


def another(field) -> object:
    """A value that the option does not have in ``BASE``."""
    value, kind = getattr(BASE, field.name), str(field.type)
    if isinstance(value, bool):
        return not value
    for word, changed in (("Path", Path("another")), ("int", 3), ("float", 2.5), ("str", "another")):
        if word in kind:
            return (changed,) if "tuple" in kind else changed
    raise AssertionError(f"no value for {field.name}: {kind}")


@pytest.mark.parametrize("name", FIELDS)
def test_every_option_makes_another_result_or_is_listed_with_a_reason(name):
    other = another(FIELDS[name])
    assert other != getattr(BASE, name)
    there, back = replace(BASE, **{name: other}), BASE.as_json()
    for made, wanted in ((back, there), (there.as_json(), BASE)):
        changes = changed_options(wanted, made)
        if name in NO_DIFFERENCE:
            assert not changes
        else:
            assert changes and settings_of(DepthOptions)[name].flag in " ".join(changes)


def test_the_list_of_options_without_a_difference_is_that_of_the_package():
    assert set(NO_DIFFERENCE) == set(names_affecting(DepthOptions, Affects.NOTHING))


FILES = {
    "left": (),
    "right": (),
    "k": (),
    "e": (),
    "k_right": (),
    "mask": (),
    "right_mask": (),
    "prior_map": (),
    "points": (),
    "disparity": (),
    "points_confidence": (),
    "reproject": (),
    "calib": ("one", "two"),
    "view": ("one", "two"),
    "view_k": ("one", "two"),
    "view_e": ("one", "two"),
}


def test_every_file_that_is_read_counts_by_its_content(tmp_path):
    """All options that hold paths, but for the folder that is written."""
    assert set(FILES) == {name for name, field in FIELDS.items() if "Path" in str(field.type)} - {"out"}
    paths = {name: [tmp_path / f"{name}{part}" for part in parts or ("",)] for name, parts in FILES.items()}
    for path in [path for each in paths.values() for path in each]:
        path.write_text(path.name)
    given = {name: tuple(each) if FILES[name] else each[0] for name, each in paths.items()}
    options = DepthOptions(**given)
    before = file_digests(options)
    assert set(before) == {str(path) for each in paths.values() for path in each}
    for path in [path for each in paths.values() for path in each]:
        path.write_text("changed")
        after = file_digests(options)
        assert {name for name in after if after[name] != before[name]} == {str(path)}
        path.write_text(path.name)
    paths["right"][0].unlink()
    assert set(before) - set(file_digests(options)) == {str(paths["right"][0])}


@pytest.mark.parametrize(
    ("names", "read"),
    [
        (("cameras.txt", "images.txt", "cameras.bin", "images.bin"), ("cameras.txt", "images.txt")),
        (("cameras.bin", "images.bin", "points3D.bin"), ("cameras.bin", "images.bin")),
        (("cameras.txt", "cameras.bin", "images.bin"), ("cameras.bin", "images.bin")),
        (("M1.npy", "M2.npy", "readme.md"), ("M1.npy", "M2.npy")),
    ],
)
def test_a_calibration_that_is_a_folder_counts_by_the_files_that_are_read(names, read, tmp_path):
    for name in names:
        (tmp_path / name).write_text(name)
    options = replace(BASE, calib=(tmp_path,))
    assert {Path(name).name for name in file_digests(options)} == set(read)
    assert all(tmp_path / name in options.read_files() for name in read)


def test_a_folder_of_arrays_is_a_calibration(tmp_path):
    from geodiff_plugin.jobs.options import check_files

    for name, value in {"M1": np.eye(3), "M2": np.eye(3), "R": np.eye(3), "T": np.ones(3)}.items():
        np.save(tmp_path / f"{name}.npy", value)
    check_files(DepthOptions(left=Path("a"), calib=(tmp_path,)), images=False)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="the folder"):
        check_files(DepthOptions(left=Path("a"), calib=(tmp_path / "empty",)), images=False)


REPORT = {
    "depth": {"min_m": 1.25, "median_m": 2.5, "max_m": 3.75},
    "verdict": {"status": "trusted", "facts": {"matched_fraction": {"confidence": 0.875}}, "reasons": []},
    "seconds": {"calibration": 0.25, "guided call": 1.5, "write": 0.0625},
    "findings": [
        {"code": "pose.refined", "severity": "warning", "text": "One."},
        {"code": "points.few", "severity": "remark", "text": "Two."},
        {"code": "camera.assumed-intrinsics", "severity": "assumption", "text": "Three."},
    ],
}


def test_the_row_of_a_pair_matches_its_report():
    assert row_of(REPORT) == {
        "near_m": 1.25,
        "median_m": 2.5,
        "far_m": 3.75,
        "verdict": "trusted",
        "confidence": 0.875,
        "seconds": 1.812,  # to the millisecond
        "message": "One. Two.",
        "reasons": "",
        "codes": "pose.refined points.few camera.assumed-intrinsics",
    }
    smoothed = row_of(REPORT | {"temporal_smoothing": {"confidence_mean": 0.9375}})
    assert smoothed == row_of(REPORT) | {"confidence": 0.9375}
    unknown = REPORT["verdict"] | {"facts": {}}
    row = row_of(REPORT | {"verdict": unknown, "temporal_smoothing": {"confidence_mean": 0.5}})
    assert row["confidence"] is None, "of a preset without confidence"
    doubted = REPORT["verdict"] | {"status": "not trusted", "reasons": ["E is wrong.", "So is K."]}
    row = row_of(REPORT | {"verdict": doubted, "findings": [], "temporal_smoothing": {"confidence_mean": 1}})
    assert row["confidence"] is row["message"] is row["codes"] is None
    assert (row["verdict"], row["reasons"]) == ("not trusted", "E is wrong. So is K.")
    assert row_of({name: REPORT[name] for name in REPORT if name != "findings"})["codes"] is None


def test_every_difference_of_options_and_files_is_named_at_once(tmp_path):
    import json

    for name in ("left", "right", "K", "E"):
        (tmp_path / name).write_text(name)
    paths = {name: tmp_path / name for name in ("left", "right", "out")}
    options = DepthOptions(**paths, k=tmp_path / "K", e=tmp_path / "E", steps=4)
    options.out.mkdir()
    report = REPORT | {
        "arguments": options.as_json(),
        "files": {"names": ["report.json"]},
        "pair": {"sha256": file_digests(options)},
    }
    (options.out / "report.json").write_text(json.dumps(report))
    assert finished_row(options) == row_of(report)
    (tmp_path / "E").write_text("another")
    (tmp_path / "left").write_text("another")
    with pytest.raises(InputError) as caught:
        finished_row(replace(options, steps=None, ensemble=5))
    said = str(caught.value)
    for words in (
        f"got {options.out}, made with",
        "made with --steps 4 instead of the default",
        "made with --ensemble 1 instead of 5",
        f"made before {tmp_path / 'E'} changed",
        f"made before {tmp_path / 'left'} changed",
        "--overwrite",
    ):
        assert words in said
    assert str(tmp_path / "right") not in said and "seed" not in said


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
        "verdict": {"status": "trusted", "facts": {"matched_fraction": {"confidence": 0.8}}, "reasons": []},
        "seconds": {"calibration": 0.25, "guided": 1.5},
        "findings": [{"code": "camera.assumed-intrinsics", "severity": "assumption", "text": "fy is fx."}],
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
        "camera.assumed-intrinsics",
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


def test_other_options_and_other_contents_are_rejected_with_what_differs(options):
    with pytest.raises(InputError, match="made with --seed 0 instead of 7"):
        finished_row(replace(options, seed=7))
    Path(options.right).write_text("another")
    with pytest.raises(InputError, match=r"made before \S*right changed"):
        finished_row(options)


def test_a_folder_takes_precedence_over_the_journal(options):
    there = row_of(report_for(options))
    row = many._final({"key": "a", "near_m": 9.0, "verdict": "not trusted"}, there, options, silent)
    assert (row["pair"], row["result"], row["near_m"], row["verdict"]) == ("a", "kept", 1.0, "trusted")
    row = many._final({"key": "a", **there}, None, options, silent)
    assert (row["result"], row["near_m"]) == ("done", 1.0)
