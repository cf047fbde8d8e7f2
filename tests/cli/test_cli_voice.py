"""The command's one voice: what counts as bad input, warnings, and folders that appear whole."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._checks import bad_value
from geodiff_plugin.commands.outputs import OUTPUT_FILES, staged_folder
from geodiff_plugin.commands.report import depth_summary, summary_line
from geodiff_plugin.commands.voice import collected_warnings, is_bad_input
from geodiff_plugin.formats import read_image


def caught(function, *arguments):
    try:
        function(*arguments)
    except Exception as error:
        return error
    raise AssertionError("nothing was raised")


def stop(*_):
    raise KeyboardInterrupt


def test_bad_input_is_what_the_package_raises_on_purpose():
    assert is_bad_input(caught(bad_value, "tide", "high", "low"))
    assert is_bad_input(caught(read_image, "nothing.png"))  # FileNotFoundError of our own


def test_a_defect_is_not_bad_input():
    assert not is_bad_input(caught(int, "x"))
    assert not is_bad_input(caught(np.zeros(3).reshape, (2, 2)))
    assert not is_bad_input(caught(depth_summary, None, None))  # an expression of ours that goes wrong
    assert not is_bad_input(KeyError("x"))

    def raised_by_another_package():
        raise ValueError("not ours")

    assert not is_bad_input(caught(raised_by_another_package))


def test_a_defect_keeps_its_traceback(monkeypatch, geodiff, pair_files):
    def broken(*_):
        raise ValueError("a defect")

    monkeypatch.setattr("geodiff_plugin.commands.depth.load_guided_prior", broken)
    with pytest.raises(ValueError, match="a defect"):
        geodiff(*pair_files.command)
    assert not Path("geodiff-out").exists()


def test_ctrl_c(monkeypatch, geodiff, pair_files):
    monkeypatch.setattr("geodiff_plugin.commands.depth.load_guided_prior", stop)
    before = sorted(pair_files.folder.iterdir())
    answer = geodiff(*pair_files.command)
    assert (answer.code, answer.out, answer.err) == (130, "", "geodiff: interrupted\n")
    assert sorted(pair_files.folder.iterdir()) == before


def test_warnings_are_sentences(monkeypatch, geodiff, pair_files):
    """Baseline in millimetres, alpha, an EXIF turn: each is one line before any weights load."""
    monkeypatch.setattr("geodiff_plugin.commands.depth.load_guided_prior", stop)
    Image.open(pair_files.left).convert("RGBA").save(pair_files.left)
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.open(pair_files.right).save(pair_files.right, exif=exif)
    camera = ["--fx", 60, "--fy", 60, "--cx", 31.5, "--cy", 23.5, "--baseline", 120]
    lines = geodiff(*pair_files.images, *camera).err.splitlines()
    assert len(lines) == 4 and lines[-1] == "geodiff: interrupted"
    assert all(line.startswith("warning: ") for line in lines[:-1])
    assert [word in line for word, line in zip(("LEFT", "RIGHT", "millimetres"), lines, strict=False)] == [
        True
    ] * 3
    assert "alpha" in lines[0] and "EXIF" in lines[1]


def test_other_packages_warn_as_ever():
    with pytest.warns(UserWarning, match="of another package"), collected_warnings([]):
        warnings.warn("of another package", stacklevel=1)


def test_new_folder_appears_whole(tmp_path):
    out = tmp_path / "deep" / "out"
    with staged_folder(out) as folder:
        (folder / "depth.npy").write_text("x")
        assert not out.exists()
    assert [path.name for path in tmp_path.rglob("*")] == ["deep", "out", "depth.npy"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_nothing_half_written(tmp_path, error):
    out = tmp_path / "out"
    with pytest.raises(error), staged_folder(out) as folder:
        (folder / "depth.npy").write_text("x")
        raise error
    assert list(tmp_path.iterdir()) == []


def test_overwriting_replaces_own_files_and_keeps_others(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for name in OUTPUT_FILES:
        (tmp_path / name).write_text("old")
    with staged_folder(tmp_path) as folder:
        (folder / "depth.npy").write_text("new")
        assert (tmp_path / "depth.npy").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["depth.npy", "notes.txt"]
    assert (tmp_path / "depth.npy").read_text() == "new"
    assert not list(tmp_path.parent.glob(f".{tmp_path.name}*"))


def test_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="--out"), staged_folder(tmp_path / "file" / "out"):
        pass


def test_summary():
    depth = np.array([[1.0, 2.0], [4.0, np.nan]], dtype=np.float32)
    summary = depth_summary(depth, np.array([[True, True], [True, False]]))
    assert summary["invalid_pixels"] == 1 and summary["median_m"] == 2.0
    line = summary_line({"depth": summary, "seconds": {"load": 1.0, "write": 0.5}}, "out/")
    assert line == "1.00 m to 4.00 m, median 2.00 m; 75 % visible; 1.5 s -> out/"
