"""Output: a file or a folder appears whole or not at all, and what cannot be written is said before the work.

Nothing here imports torch: what is wrong with a folder is said at once.
"""

from __future__ import annotations

import errno
import itertools
import json
import os
import secrets
import shutil
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Self, TypeVar

from geodiff_plugin._checks import FolderError, InputFileError, MissingFileError, bad_value

try:
    import fcntl
except ImportError:  # where there is no flock, two runs with one folder are not detected
    CAN_LOCK = False
else:
    CAN_LOCK = True

__all__ = ["PARTIAL", "OutFolder", "atomic_path", "check_out", "free_folder", "reason_of", "write_text"]

#: The hidden folder of a run that is under way, with its lock and its files.
PARTIAL, LOCK, FILES = ".geodiff-partial", "process", "files"
#: Lists what a run wrote, and is written last.
REPORT = "report.json"
#: A disk with less room takes no result, however small its picture.
LEAST_FREE_BYTES = 8 << 20

Result = TypeVar("Result")


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside ``path``, of its suffix; rename it to ``path`` when the block ends well.

    On any error, Ctrl-C included, it is removed, and an older file at ``path`` stays as it was.

    Raises:
        FileNotFoundError, IsADirectoryError: no folder to write into, or ``path`` is one.
    """
    target = Path(path)
    if os.path.isdir(target):
        raise FolderError(f"The output must be a file; got the folder {target}. Name a file inside of it.")
    if not os.path.isdir(target.parent):
        raise MissingFileError(
            f"The output must be in an existing folder; got {target}. Make the folder {target.parent} first."
        )
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all, making its folder where missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def reason_of(error: OSError) -> str:
    """The system's words for what went wrong, without the path."""
    return error.strerror or str(error)


def _beside(target: Path) -> Path:
    return target.parent / f".{target.name}{PARTIAL}"


def _hidden(target: Path) -> Path:
    """The folder of unfinished files and of the lock: inside a folder, or beside it until it is there.

    A folder that exists may be a disk of its own, below one that nobody may write to.
    """
    return target / PARTIAL if target.is_dir() else _beside(target)


def check_out(path: Path, name: str = "--out") -> Path:
    """The place that an output folder has or will have, links followed; messages call it ``name``.

    Raises:
        ValueError: a file, or a name that the file system refuses.
    """
    try:
        target = path.resolve()
        with suppress(FileNotFoundError):
            os.stat(_beside(target))  # the longest name that will be needed
    except OSError as error:
        bad_value(name, "a folder that can be made", f"{path} ({reason_of(error)})", "Name another.")
    if target.exists() and not target.is_dir():
        bad_value(name, "a folder", f"the file {path}", "Name a folder.")
    return target


def _holds_files(target: Path) -> bool:
    """Whether a folder is there and has more in it than what an unfinished run left."""
    return target.is_dir() and any(path.name != PARTIAL for path in target.iterdir())


def free_folder(default: Path) -> Path:
    """A folder for a run that named none: ``default``, or ``default-2`` and so on where that is taken."""
    for number in itertools.count(1):
        path = default if number == 1 else default.with_name(f"{default.name}-{number}")
        taken = os.path.lexists(path) and (not path.is_dir() or _holds_files(path))
        if not taken and not _held(_hidden(path)):
            break
    return path


def _take_lock(file: IO[bytes]) -> bool:
    """Lock an open file until it is closed; ``False`` where another process has it."""
    if CAN_LOCK:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


def _held(hidden: Path) -> bool:
    """Whether the process that writes there is alive."""
    if not (hidden / LOCK).is_file():
        return False
    with open(hidden / LOCK, "rb") as file:
        return not _take_lock(file)


def _files_of_report(folder: Path) -> set[str]:
    """Names of the files that an earlier run wrote there, as its report lists them."""
    try:
        names = json.loads((folder / REPORT).read_text(encoding="utf-8"))["files"]["names"]
        return {name for name in names if Path(name).name == name} if isinstance(names, list) else set()
    except (OSError, ValueError, KeyError, TypeError, RecursionError):  # none, or of something else
        return set()


class OutFolder:
    """A folder that this process alone writes to, from before the work until the result is in it.

    Args:
        path: as typed; it need not exist.
        inputs: files that the run reads, none of which may lie in a folder that it overwrites.
        overwrite: take a folder that holds files. Those that its report lists as an earlier run's go where
            the new run does not write them; all others stay.
        option: what ``path`` was given as, for messages.

    Raises:
        ValueError: on entry: what ``check_out`` refuses; files in it, or an input that the run would replace
            or delete; it cannot be written to, or its disk is full; another run has it.
    """

    def __init__(
        self,
        path: Path,
        *,
        inputs: Collection[Path] = (),
        overwrite: bool = False,
        option: str = "--out",
    ) -> None:
        self.path = Path(path)
        self._inputs, self._overwrite, self._option = inputs, overwrite, option
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._target = check_out(self.path, self._option)
        if _holds_files(self._target) and not self._overwrite:
            cure = "Name another, or add --overwrite."
            bad_value(self._option, "a new or empty folder", f"{self.path}, which holds files", cure)
        self._earlier = _files_of_report(self._target)
        self._refuse_inputs()
        self._staging = _hidden(self._target)
        with ExitStack() as stack:
            try:
                self._make_staging(stack)
                self._lock(stack)
                if shutil.disk_usage(self._staging).free < LEAST_FREE_BYTES:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            except OSError as error:
                cure = "Name another with --out, or free disk space and check its permissions."
                got = f"{self.path} ({reason_of(error)})"
                bad_value(self._option, "a folder that can be written to", got, cure)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _refuse_inputs(self) -> None:
        """Refuse a folder with an input of this run among its files, some of which it replaces or deletes."""
        there = [e for e in self._target.iterdir() if e.is_file()] if self._target.is_dir() else []
        for path in self._inputs:
            if any(path.exists() and path.samefile(entry) for entry in there):
                got = f"{self.path}, which holds {path}"
                bad_value(self._option, "a folder that holds no input of the run", got, "Name another.")

    def _make_staging(self, stack: ExitStack) -> None:
        """Make the folders down to it; new ones go in the end if they are still empty."""
        missing = [path for path in (self._staging, *self._staging.parents) if not path.exists()]
        for path in reversed(missing):
            path.mkdir(exist_ok=True)
            stack.callback(_remove_empty, path)

    def _lock(self, stack: ExitStack) -> None:
        """Take the folder's lock; the kernel gives it back when the process ends, however it ends."""
        beside, lock = _beside(self._target), self._staging / LOCK
        if self._staging != beside and _held(beside):  # a run that began before the folder was there
            self._refuse_held(beside)
        file = stack.enter_context(open(lock, "a+b", buffering=0))
        # A run that ended meanwhile may have removed the file: what we hold is then nobody's lock.
        if not _take_lock(file) or os.fstat(file.fileno()).st_nlink == 0:
            self._refuse_held(self._staging)
        stack.callback(shutil.rmtree, self._staging, ignore_errors=True)
        file.truncate(0)
        file.write(f"{os.getpid()}\n".encode())  # says who, and finds out whether the disk takes a byte
        if (self._staging / FILES).exists():  # we have the lock, so whoever made them is gone
            shutil.rmtree(self._staging / FILES)
            line = f"geodiff: removed what a run that was killed had left in {self._staging}"
            print(line, file=sys.stderr, flush=True)

    def _refuse_held(self, hidden: Path) -> None:
        process = (hidden / LOCK).read_text(encoding="ascii", errors="replace").strip() or "unknown"
        got = f"{self.path}, which process {process} is writing to"
        bad_value(self._option, "a folder that no other run has", got, "Wait for it, or name another.")

    def write(self, fill: Callable[[Path], Result]) -> Result:
        """Let ``fill`` write into an empty folder beside the place, whose files are then moved.

        A new folder appears by one rename. In one that exists each file is replaced by one rename, then what
        only an earlier run wrote goes, and the report is replaced last. Returns what ``fill`` does.

        Raises:
            OSError: it could not be written; what was there before is as it was.
        """
        files = self._staging / FILES
        try:
            files.mkdir()
            result = fill(files)
            self._move(files)
        except InputFileError:  # of a file that it names
            raise
        except OSError as error:
            cure = "Free disk space or check its permissions, and run it again."
            raise InputFileError(f"{self.path} could not be written ({reason_of(error)}). {cure}") from error
        finally:
            shutil.rmtree(files, ignore_errors=True)
        return result

    def _move(self, files: Path) -> None:
        if not self._target.is_dir():
            os.rename(files, self._target)
            return
        written = {path.name for path in files.iterdir()}
        for name in sorted(written - {REPORT}):
            os.replace(files / name, self._target / name)
        for path in (self._target / name for name in self._earlier - written):
            if path.is_file():
                path.unlink()
        if REPORT in written:  # last: until then the old one lists what is still to go
            os.replace(files / REPORT, self._target / REPORT)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # not empty: the result is in it
        folder.rmdir()
