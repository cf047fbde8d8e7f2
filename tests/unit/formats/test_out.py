"""Output folders: what they may hold before, who may write to them, and what is left afterwards."""

import json
import os
import shutil
import threading
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError, InputFileError, MissingFileError
from geodiff_plugin.formats import Cloud, out, write_colmap, write_depth_npy, write_pfm, write_ply
from geodiff_plugin.formats.out import (
    FOLDER_LOCK,
    PARTIAL,
    OutFolder,
    atomic_path,
    check_new,
    check_new_file,
    check_out,
    files_of_report,
    free_folder,
    lock_file,
    locked_folder,
    reason_of,
    write_text,
)
from tests.unit.error_sentences import check_error


def names(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_temporary_path_has_the_name_and_the_suffix_and_is_another_one_each_time(tmp_path):
    seen = set()
    for _ in range(3):
        with atomic_path(tmp_path / "map.v2.npy") as temporary:
            temporary.write_text("x")
            assert temporary.name.startswith(".map.v2.") and temporary.suffix == ".npy"
            seen.add(temporary)
    assert len(seen) == 3 and names(tmp_path) == ["map.v2.npy"]
    with (
        pytest.raises(InputFileError, match="The output must be a file; got the folder"),
        atomic_path(tmp_path),
    ):
        pass
    with (
        pytest.raises(MissingFileError, match=r"in an existing folder; .*Create the folder .*none first"),
        atomic_path(tmp_path / "none" / "a"),
    ):
        pass
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "b.npy"):
        raise RuntimeError("before anything was written")


def test_a_text_makes_its_folders_and_is_utf_8(tmp_path):
    for text in ("grün", "±2"):
        write_text(tmp_path / "a" / "b" / "c.txt", text)
        assert (tmp_path / "a" / "b" / "c.txt").read_bytes() == text.encode("utf-8")
    assert names(tmp_path / "a" / "b") == ["c.txt"]


def test_the_reason_of_an_error_is_the_systems_words(tmp_path):
    assert reason_of(FileNotFoundError(2, "No such file", "/a/b")) == "No such file"
    assert reason_of(OSError("encoder error -2")) == "encoder error -2"


def test_an_output_folder_is_new_or_empty_unless_it_may_be_overwritten(tmp_path):
    for overwrite in (False, True):
        assert check_new(tmp_path / "new", overwrite) == tmp_path / "new"
    target = tmp_path / "out"
    target.mkdir()
    (tmp_path / "link").symlink_to(target)
    for left in (None, PARTIAL, FOLDER_LOCK):
        if left is not None:
            (target / left).touch()
        assert check_new(tmp_path / "link", False) == target, "what an unfinished run left does not count"
    (target / "depth.npy").touch()
    with pytest.raises(
        InputError, match="a new or empty folder; got .*link, which contains files.*--overwrite"
    ):
        check_new(tmp_path / "link", False)
    assert check_new(target, True) == target
    (tmp_path / "file").touch()
    for overwrite in (False, True):
        with pytest.raises(InputError, match="--out must be a folder; got the file"):
            check_new(tmp_path / "file", overwrite)
    (tmp_path / "loop").symlink_to("loop")
    for path in (tmp_path / "loop", tmp_path / "loop" / "a", tmp_path / "file" / "a", tmp_path / ("n" * 250)):
        with pytest.raises(InputError, match=r"--out must be a writable folder; got .*\(.*\)"):
            check_out(path)
    assert check_out(tmp_path / ("n" * 200)).name == "n" * 200


def test_an_output_file_is_new_unless_it_may_be_overwritten(tmp_path):
    check_new_file(tmp_path / "a", False)
    (tmp_path / "a").touch()
    check_new_file(tmp_path / "a", True)
    with pytest.raises(InputError, match="--out must be a new file; got .*, which exists"):
        check_new_file(tmp_path / "a", False)


def test_locks_are_held_by_one_or_shared_by_many(tmp_path):
    path = tmp_path / "lock"
    with open(path, "ab") as first, open(path, "ab") as second, open(path, "ab") as third:
        assert lock_file(first) and not lock_file(second) and not lock_file(second, shared=True)
        first.close()
        assert lock_file(second, shared=True) and lock_file(third, shared=True)
        with open(path, "ab") as fourth:
            assert not lock_file(fourth)


def test_systems_without_locks_notice_nobody(tmp_path, monkeypatch):
    with open(tmp_path / "lock", "ab") as first, open(tmp_path / "lock", "ab") as second:
        assert lock_file(first)
        monkeypatch.setattr(out.fcntl, "flock", lambda *_: raising(OSError(37, "No locks available")))
        assert lock_file(second)
        monkeypatch.setattr(out, "fcntl", None)  # Windows
        assert lock_file(second) and lock_file(second, shared=True)


def raising(error):
    raise error


def test_a_folder_is_worked_in_alone_or_shared_and_its_lock_goes_with_the_last(tmp_path):
    with locked_folder(tmp_path):
        assert names(tmp_path) == [FOLDER_LOCK]
        for shared in (True, False):
            with (
                pytest.raises(
                    InputError, match="a folder that no other run uses; got .*another run is using"
                ),
                locked_folder(tmp_path, shared=shared),
            ):
                pass
        assert names(tmp_path) == [FOLDER_LOCK], "who was refused removes nothing"
    assert names(tmp_path) == []
    with locked_folder(tmp_path, shared=True):
        with (
            locked_folder(tmp_path, shared=True),
            pytest.raises(InputError, match="no other run"),
            locked_folder(tmp_path),
        ):
            pass
        assert names(tmp_path) == [FOLDER_LOCK], "the other one still works"
    assert names(tmp_path) == []
    with pytest.raises(InputError, match="a writable folder"), locked_folder(tmp_path / "none"):
        pass


def test_a_lock_that_its_holder_removed_meanwhile_is_taken_again(tmp_path, monkeypatch):
    real, taken = out.lock_file, []

    def lock(file, shared=False):
        if not taken:
            os.unlink(tmp_path / FOLDER_LOCK)  # whoever had it ends at this moment
        taken.append(file)
        return real(file, shared)

    monkeypatch.setattr(out, "lock_file", lock)
    with locked_folder(tmp_path):
        assert len(taken) == 2 and names(tmp_path) == [FOLDER_LOCK]
        with pytest.raises(InputError, match="no other run"), locked_folder(tmp_path):
            pass
    assert names(tmp_path) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('{"files": {"names": ["a", "b"]}}', {"a", "b"}),
        ('{"files": {"names": ["../a", "b/c", "d"]}}', {"d"}),
        ('{"files": {"names": "abc"}}', set()),
        ('{"files": []}', set()),
        ('{"file": {}}', set()),
        ('{"files": {"names": [3]}}', set()),
        ("{", set()),
        (None, set()),
    ],
)
def test_the_files_of_an_earlier_run_are_names_in_its_folder(text, expected, tmp_path):
    if text is not None:
        (tmp_path / "report.json").write_text(text)
    assert files_of_report(tmp_path) == expected


def fill(folder):
    assert folder.is_dir() and names(folder) == []
    (folder / "a.npy").write_text("new")
    (folder / "report.json").write_text(json.dumps({"files": {"names": ["a.npy"]}}))
    return "result"


@pytest.mark.parametrize("exists", [True, False])
def test_an_output_folder_is_made_with_those_above_it_and_may_be_written_twice(exists, tmp_path):
    path = tmp_path / "a" / "b" / "out"
    if exists:
        path.mkdir(parents=True)
    with OutFolder(path) as held:
        place = held.place
        assert (place.path, place.target) == (path, path)
        assert place.staging.is_dir() and place.staging.parent == (path if exists else path.parent)
        assert held.write(fill) == "result"
        assert held.write(fill) == "result"
    assert names(path) == ["a.npy", "report.json"] and names(path.parent) == ["out"]
    with pytest.raises(TypeError):
        OutFolder(tmp_path / "c", [])  # settings are given by name
    with pytest.raises(TypeError), locked_folder(tmp_path, True):
        pass
    with OutFolder(tmp_path / "c" / "d"):
        assert (tmp_path / "c").is_dir()
    assert names(tmp_path) == ["a"], "a run without a result leaves no folder"


def test_an_output_folder_with_an_input_in_it_is_rejected(tmp_path):
    folder = tmp_path / "out"
    (folder / "deep").mkdir(parents=True)
    (folder / "left.png").touch()
    (folder / "deep" / "right.png").touch()
    (tmp_path / "link.png").symlink_to(folder / "left.png")
    for inputs in ([folder / "left.png"], [tmp_path / "none.png", tmp_path / "link.png"]):
        with (
            pytest.raises(InputError, match="a folder without inputs of the run; got .*, which holds"),
            OutFolder(folder, inputs=inputs, overwrite=True),
        ):
            pass
    with OutFolder(
        folder, inputs=[folder / "deep" / "right.png", tmp_path / "none.png"], overwrite=True
    ) as held:
        held.write(fill)
    assert names(folder) == ["a.npy", "deep", "left.png", "report.json"]


def test_a_disk_must_have_eight_megabytes(tmp_path, monkeypatch):
    for free, fits in ((8 << 20, True), ((8 << 20) - 1, False)):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: SimpleNamespace(free=free))
        if fits:
            with OutFolder(tmp_path / "out"):
                pass
        else:
            with pytest.raises(InputError, match="No space left"), OutFolder(tmp_path / "out"):
                pass
    assert names(tmp_path) == []


def test_an_error_of_the_system_is_a_sentence_and_one_that_names_its_file_stays(tmp_path):
    def broken(error):
        def fill(folder):
            (folder / "half").touch()
            raise error

        return fill

    named = InputFileError("the video must be a file")
    for error, said in (
        (OSError(28, "No space left"), r"out could not be written \(No space left\)"),
        (named, "video"),
    ):
        with pytest.raises(InputFileError, match=said), OutFolder(tmp_path / "out") as held:
            held.write(broken(error))
    assert names(tmp_path) == []


def test_a_folder_for_a_run_that_named_none_is_free_of_files_links_and_other_runs(tmp_path):
    default = tmp_path / "out"
    with OutFolder(default):
        with OutFolder(free_folder(default)) as second:
            assert second.path == tmp_path / "out-2"
            assert free_folder(default) == tmp_path / "out-3"
        assert free_folder(default) == tmp_path / "out-2"
    (tmp_path / "out-2").mkdir()
    default.symlink_to("nothing")
    assert free_folder(default) == tmp_path / "out-2", "an empty folder may be taken"
    (tmp_path / "out-2" / PARTIAL).mkdir()
    (tmp_path / "out-2" / PARTIAL / "lock").touch()
    assert free_folder(default) == tmp_path / "out-2", "nobody holds that lock"


def test_another_thread_finds_the_folder_taken_until_it_is_given_back(tmp_path):
    said = []

    def other():
        try:
            with OutFolder(tmp_path / "out") as held:
                held.write(fill)
        except InputError as error:
            said.append(str(error))

    def run():
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()

    with OutFolder(tmp_path / "out"):
        run()
    assert len(said) == 1 and "which another process is writing to" in said[0]
    run()
    assert len(said) == 1 and names(tmp_path / "out") == ["a.npy", "report.json"]


def entered(manager):
    with manager:
        return


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (
            lambda p: entered(atomic_path(p / "taken")),
            ("The output", "a file", "the folder {}/taken", "Pass a file"),
        ),
        (
            lambda p: entered(atomic_path(p / "none" / "a")),
            ("The output", "in an existing folder", "{}/none/a", "Create the folder {}/none first"),
        ),
        (
            lambda p: out.raise_unwritable(p, OSError(28, "No space left")),
            ("--out", "a writable folder", "{} (No space left)", "free disk space"),
        ),
        (lambda p: check_out(p / "file"), ("--out", "a folder", "the file {}/file", "Pass a folder")),
        (
            lambda p: check_new(p / "taken", False),
            ("--out", "a new or empty folder", "{}/taken, which contains files", "--overwrite"),
        ),
        (
            lambda p: check_new_file(p / "file", False),
            ("--out", "a new file", "{}/file, which exists", "--overwrite"),
        ),
        (
            lambda p: entered(locked_folder(p / "held")),
            (
                "--out",
                "a folder that no other run uses",
                "{}/held, which another run is using",
                "Wait for it",
            ),
        ),
        (
            lambda p: entered(OutFolder(p / "taken", inputs=[p / "taken" / "a"], overwrite=True)),
            (
                "--out",
                "a folder without inputs of the run",
                "{0}/taken, which holds {0}/taken/a",
                "a different one",
            ),
        ),
        (
            lambda p: entered(OutFolder(p / "written")),
            (
                "--out",
                "a folder that no other run uses",
                "{}/written, which another process is writing",
                "Wait",
            ),
        ),
    ],
)
def test_errors_state_what_was_expected_and_what_was_found(tmp_path, call, parts):
    for name in ("taken", "held"):
        (tmp_path / name).mkdir()
    (tmp_path / "taken" / "a").touch()
    (tmp_path / "file").touch()
    with locked_folder(tmp_path / "held"), OutFolder(tmp_path / "written"):
        check_error(lambda: call(tmp_path), *(part.format(tmp_path) for part in parts))


@pytest.mark.parametrize("error", [None, RuntimeError, KeyboardInterrupt])
def test_atomic_path_appears_whole_as_a_plain_file_or_leaves_the_old_one(tmp_path, error):
    (tmp_path / "a.png").write_text("old")
    mode = (tmp_path / "a.png").stat().st_mode
    with pytest.raises(error) if error else nullcontext(), atomic_path(tmp_path / "a.png") as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".png"
        temporary.write_text("new")
        assert (tmp_path / "a.png").read_text() == "old"
        if error is not None:
            raise error
    assert names(tmp_path) == ["a.png"] and (tmp_path / "a.png").stat().st_mode == mode
    assert (tmp_path / "a.png").read_text() == ("new" if error is None else "old")


EMPTY = Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda f: write_pfm(f / "a.pfm", np.zeros(3)), "shape"),
        (lambda f: write_ply(f / "d.ply", np.ones((3, 4)), np.zeros((4, 3, 3)), np.eye(3)), "image_01"),
        (lambda f: write_ply(f / "d.ply", np.ones((3, 4)), np.zeros((3, 4, 3)), np.zeros((3, 3))), "focal"),
        (lambda f: write_depth_npy(f, np.zeros((2, 3))), "folder"),
        (
            lambda f: write_colmap(f, [("my left.png", np.eye(3), np.eye(4), (64, 48))], EMPTY),
            "without blanks",
        ),
    ],
)
def test_what_cannot_be_written_leaves_nothing(tmp_path, write, said):
    with pytest.raises(ValueError, match=said):
        write(tmp_path)
    assert names(tmp_path) == []
