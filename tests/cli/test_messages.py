"""Messages of the commands: what counts as bad input, warnings, and the summary."""

import io
import os
import re
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._internal import checks as _checks
from geodiff_plugin._internal.checks import InputError, bad_type, bad_value
from geodiff_plugin.cli.app import main
from geodiff_plugin.formats import read_image
from geodiff_plugin.jobs.report import depth_summary, summary_line
from tests.cli.conftest import stop


def test_bad_input_is_an_error_of_its_own_and_what_it_always_was():
    for function, arguments, kind in (
        (bad_value, ("tide", "high", "low"), ValueError),
        (bad_type, ("tide", "a number", "low"), TypeError),
        (read_image, ("nothing.png",), FileNotFoundError),
        (read_image, (".",), OSError),
    ):
        with pytest.raises(InputError) as caught:
            function(*arguments)
        assert isinstance(caught.value, kind) and isinstance(caught.value, ValueError)


def test_nothing_of_the_package_raises_a_plain_error_at_a_user():
    """Else the command would show a traceback for it."""
    plain = re.compile(r"^\s*raise (ValueError|TypeError|OSError|FileNotFoundError|PermissionError)\(", re.M)
    files = Path(_checks.__file__).parents[1].rglob("*.py")
    # Caught next to it, or about a decorated function and not its input.
    allowed = {"config.py": 1, "out.py": 1, "journal.py": 1, "kernels.py": 1, "spatial.py": 7}
    found = Counter(path.name for path in files for _ in plain.findall(path.read_text(encoding="utf-8")))
    assert found == allowed


def test_a_defect_keeps_its_traceback_and_ctrl_c_is_a_line(monkeypatch, geodiff, pair_files):
    def broken(*_, **__):
        raise ValueError("a defect")

    before = sorted(pair_files.folder.iterdir())
    monkeypatch.setattr("geodiff_plugin.jobs.prior.load_quiet_prior", broken)
    with pytest.raises(ValueError, match="a defect"):
        geodiff(*pair_files.command)
    monkeypatch.setattr("geodiff_plugin.jobs.prior.load_quiet_prior", stop)
    answer = geodiff(*pair_files.command)
    assert (answer.code, answer.out) == (130, "")
    assert answer.err == "geodiff: interrupted. Run the same command again to resume or restart.\n"
    assert sorted(pair_files.folder.iterdir()) == before


def test_warnings_are_sentences(monkeypatch, geodiff, pair_files):
    """Each one line before any weights load: alpha, an EXIF turn, a baseline in millimetres."""
    monkeypatch.setattr("geodiff_plugin.jobs.prior.load_quiet_prior", stop)
    Image.open(pair_files.left).convert("RGBA").save(pair_files.left)
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.open(pair_files.right).save(pair_files.right, exif=exif)
    camera = ["--fx", 60, "--fy", 60, "--cx", 31.5, "--cy", 23.5, "--baseline", 120]
    *warned, assumed, last = geodiff(*pair_files.images, *camera).err.splitlines()
    assert assumed.startswith("assumed: The right camera's cx") and last.endswith(
        "Run the same command again to resume or restart."
    )
    words = [("LEFT", "alpha"), ("RIGHT", "EXIF"), ("millimetres", "")]
    for line, reported in zip(warned, words, strict=True):
        assert line.startswith("warning: ") and all(word in line for word in reported)


def test_names_beyond_the_terminals_encoding(monkeypatch, tmp_path):
    """As on Windows, or into a file there: the output escapes them, after the work as before."""
    np.save(tmp_path / "depth.npy", np.ones((40, 48), np.float32))
    narrow = {name: io.TextIOWrapper(io.BytesIO(), encoding="ascii") for name in ("stdout", "stderr")}
    for name, stream in narrow.items():
        monkeypatch.setattr(sys, name, stream)
    for out in ("größe.webp", os.fsdecode(b"gr\xf6.webp")):
        with pytest.raises(SystemExit) as leaving:
            main(["video", str(tmp_path / "depth.npy"), "--out", str(tmp_path / out)])
        assert not leaving.value.code and (tmp_path / out).exists()
    with pytest.raises(SystemExit) as leaving:
        main(["video", "größe.npy"])
    assert leaving.value.code == 2
    for stream, words in ((narrow["stdout"], rb"gr\xf6\xdfe.webp"), (narrow["stderr"], rb"gr\xf6\xdfe.npy")):
        stream.flush()
        assert words in stream.buffer.getvalue()


def test_the_summary_states_the_verdict_first():
    depth = np.array([[1.0, 2.0], [4.0, np.nan]], dtype=np.float32)
    summary = depth_summary(depth, depth > 0)
    facts = {"matched_fraction": {"confidence": 0.876, "matched": 0.7}}
    assert summary["invalid_pixels"] == 1 and summary["median_m"] == 2.0
    verdict, metres = (
        {"status": "trusted", "reasons": [], "facts": facts},
        "1.00 m to 4.00 m, median 2.00 m",
    )
    report = {"depth": summary, "verdict": verdict, "seconds": {"load": 1}, "unit": "m", "prior_scale": None}
    assert summary_line(report, "out/") == f"{metres}; trusted, confidence 0.88, 70 % matched; 1.0 s -> out/"
    assert "in the calibration's lengths (no unit)" in summary_line(report | {"unit": None}, "out/")
    verdict |= {"status": "not trusted", "reasons": ["E is wrong."]}
    assert summary_line(report, "out/") == f"NOT TRUSTED: E is wrong. (Unreliable: {metres}; 1.0 s -> out/)"
