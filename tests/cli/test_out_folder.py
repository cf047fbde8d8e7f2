"""``--out`` is tried before the work, held during it, and no finished result is lost."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from geodiff_plugin._internal.checks import InputFileError
from geodiff_plugin.formats import out as out_module
from geodiff_plugin.formats.out import PARTIAL, OutFolder, free_folder

WRITTEN = ["depth.npy", "report.json"]


def fill(folder: Path) -> str:
    (folder / "depth.npy").write_text("new")
    (folder / "report.json").write_text("{}")
    return "filled"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def report_of(*files: str) -> str:
    return json.dumps({"files": {"names": [*files, "report.json"]}})


def refused(path: Path, **options) -> str:
    with pytest.raises(ValueError, match="--out must be") as caught, OutFolder(path, **options):
        pass
    return str(caught.value)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(errno.ENOSPC, "No space left on device")])
@pytest.mark.parametrize("exists", [True, False])
def test_what_ends_amid_the_writing_loses_nothing_and_strews_nothing(tmp_path, error, exists):
    out = tmp_path / "disk" / "out"
    if exists:
        out.mkdir(parents=True)
        (out / "depth.npy").write_text("finished")
        (out / "report.json").write_text(report_of("depth.npy"))

    def broken(folder):
        (folder / "depth.npy").write_text("half")
        raise error

    kinds = (KeyboardInterrupt, InputFileError)
    with pytest.raises(kinds) as caught, OutFolder(out, overwrite=exists) as held:
        held.write(broken)
    full = f"{out} could not be written (No space left on device). Free disk space"
    assert error is KeyboardInterrupt or full in str(caught.value)
    assert names(out if exists else tmp_path) == (WRITTEN if exists else [])
    assert not exists or (out / "depth.npy").read_text() == "finished"


def test_files_of_an_earlier_run_are_replaced_and_others_stay(tmp_path, monkeypatch):
    """The report lists them and is deleted last, so that an interrupted deletion can continue."""
    for name in ("notes.txt", "depth.npy", "cloud.ply", "cameras.txt"):
        (tmp_path / name).write_text("old")
    (tmp_path / "report.json").write_text(report_of("depth.npy", "cloud.ply", "gone.npy"))
    moved, real = [], os.replace

    def move(source, target):
        moved.append((Path(target).name, (tmp_path / "cloud.ply").exists()))
        real(source, target)

    monkeypatch.setattr(os, "replace", move)
    with OutFolder(tmp_path, overwrite=True) as held:
        held.write(fill)
    assert moved == [("depth.npy", True), ("report.json", False)]
    assert names(tmp_path) == ["cameras.txt", "depth.npy", "notes.txt", "report.json"]
    assert (tmp_path / "depth.npy").read_text() == "new"


@pytest.mark.parametrize("report", ['{"files": {"names": [1]}}', '{"files": {"names": ["../b", ".."]}}'])
def test_a_report_of_something_else_deletes_nothing(tmp_path, report):
    out = tmp_path / "out"
    out.mkdir()
    for path in (tmp_path / "b", out / "cloud.ply", out / "1"):
        path.write_text("mine")
    (out / "report.json").write_text(report)
    with OutFolder(out, overwrite=True) as held:
        held.write(fill)
    assert names(tmp_path) == ["b", "out"] and names(out) == ["1", "cloud.ply", *WRITTEN]


@pytest.mark.parametrize("fault", [errno.EACCES, errno.ENOSPC])
def test_a_folder_that_takes_no_file_is_rejected_before_the_work(tmp_path, monkeypatch, fault):
    """By the first byte: whether a folder is read-only or a disk full shows no sooner to everybody."""

    def no_file(*_, **__):
        raise OSError(fault, os.strerror(fault))

    if fault == errno.ENOSPC:
        monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
    else:
        monkeypatch.setattr(out_module, "open", no_file, raising=False)
    assert os.strerror(fault) in refused(tmp_path / "a" / "out") and names(tmp_path) == []


def test_a_second_run_is_rejected(tmp_path):
    out, process = tmp_path / "out", "another process is writing to"
    with OutFolder(out) as held:
        assert process in refused(out) and process in refused(tmp_path / "." / "out")
        assert free_folder(out) == tmp_path / "out-2"
        out.mkdir()  # somebody makes it meanwhile
        assert process in refused(out)
        held.write(fill)
    assert names(out) == WRITTEN and names(tmp_path) == ["out"]
    with OutFolder(out, overwrite=True):
        assert process in refused(out, overwrite=True)
    assert names(out) == WRITTEN


@pytest.mark.parametrize("exists", [True, False])
def test_what_a_killed_run_left_is_recognised_and_cleared(tmp_path, exists, capsys):
    out = tmp_path / "out"
    if exists:
        out.mkdir()
    code = (
        "import os, sys\nfrom pathlib import Path\nfrom geodiff_plugin.formats.out import OutFolder\n"
        "def fill(folder):\n"
        "    (folder / 'depth.npy').write_text('half')\n"
        f"    os.kill(os.getpid(), {int(signal.SIGKILL)})\n"
        "with OutFolder(Path(sys.argv[1])) as held:\n    held.write(fill)\n"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(out)])
    assert killed.returncode == -signal.SIGKILL
    left = names(out if exists else tmp_path)
    assert len(left) == 1 and PARTIAL in left[0] and free_folder(out) == out
    with OutFolder(out) as held:
        assert "killed" in capsys.readouterr().err
        held.write(fill)
    assert names(tmp_path) == ["out"] and names(out) == WRITTEN


def test_a_run_that_names_no_folder_takes_the_next_free_one(tmp_path):
    default, second = tmp_path / "out", tmp_path / "out-2"
    assert free_folder(default) == default
    default.mkdir()
    assert free_folder(default) == default  # empty
    (default / "x").write_text("")
    assert free_folder(default) == second
    second.write_text("a file")
    (tmp_path / "out-3").symlink_to("nothing")
    assert free_folder(default) == tmp_path / "out-4"
