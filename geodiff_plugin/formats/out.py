"""Output: a file or a folder appears whole or not at all; what cannot be written is said before the work."""

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
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NoReturn, Self, TypeVar

from geodiff_plugin._checks import InputFileError, MissingFileError, bad_value
from geodiff_plugin._signals import undisturbed

try:
    import fcntl
except ImportError:  # Windows: two runs with one folder are not detected
    fcntl = None  # type: ignore[assignment]

#: Folder in which results are written before they take their place, as a whole.
PARTIAL = ".geodiff-partial"
#: Its file that a run locks, so that no other takes the folder.
LOCK = "lock"
#: Its folder of what has been written so far.
FILES = "files"
#: The lock of a folder that a run works in for long, in full view of other runs.
FOLDER_LOCK = ".geodiff-lock"
REPORT = "report.json"
LEAST_FREE_BYTES = 8 << 20

Result = TypeVar("Result")


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside ``path``, renamed to it when the block ends well, else removed."""
    target = Path(path)
    if os.path.isdir(target):
        bad_value("The output", "a file", f"the folder {target}", "Name a file inside of it.", InputFileError)
    if not os.path.isdir(target.parent):
        cure = f"Make the folder {target.parent} first."
        bad_value("The output", "in an existing folder", target, cure, MissingFileError)
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


def unwritable(path: Path, error: OSError) -> NoReturn:
    """Refuse an output folder that takes no file."""
    cure = "Name another with --out, or free disk space and check its permissions."
    bad_value("--out", "a folder that can be written to", f"{path} ({reason_of(error)})", cure)


def _beside(target: Path) -> Path:
    return target.parent / f".{target.name}{PARTIAL}"


def _hidden(target: Path) -> Path:
    """The folder of unfinished files and of the lock: inside of one that exists, which may be a disk."""
    return target / PARTIAL if target.is_dir() else _beside(target)


def check_out(path: Path) -> Path:
    """The place that an output folder has or will have, links followed."""
    try:
        target = Path(os.path.realpath(path))  # Path.resolve raises RuntimeError for a link to itself
        for place in (target, _beside(target)):  # the latter has the longest name that will be needed
            with suppress(FileNotFoundError):
                os.stat(place)
    except OSError as error:
        unwritable(path, error)
    if target.exists() and not target.is_dir():
        bad_value("--out", "a folder", f"the file {path}", "Name a folder.")
    return target


def _holds_files(target: Path) -> bool:
    """Whether a folder is there and has more in it than what an unfinished run left."""
    left = (PARTIAL, FOLDER_LOCK)
    return target.is_dir() and any(path.name not in left for path in target.iterdir())


def check_new(path: Path, overwrite: bool) -> Path:
    """``check_out`` of a folder that is new or empty, unless it may be overwritten."""
    target = check_out(path)
    if _holds_files(target) and not overwrite:
        cure = "Name another, or add --overwrite."
        bad_value("--out", "a new or empty folder", f"{path}, which holds files", cure)
    return target


def check_new_file(path: Path, overwrite: bool) -> None:
    """Refuse to replace an output file that nobody allowed to."""
    if path.exists() and not overwrite:
        bad_value("--out", "a new file", f"{path}, which exists", "Name another, or add --overwrite.")


def free_folder(default: Path) -> Path:
    """A folder for a run that named none: ``default``, or ``default-2`` and so on where that is taken."""
    path = default
    for number in itertools.count(2):
        taken = os.path.lexists(path) and (not path.is_dir() or _holds_files(path))
        if not taken and not _held(_hidden(path)):
            break
        path = default.with_name(f"{default.name}-{number}")
    return path


def lock_file(file: IO[bytes], shared: bool = False) -> bool:
    """Lock an open file until it is closed or the process ends, alone or with others that share it.

    ``False`` where another has it. Windows and file systems without locks notice nobody.
    """
    if not fcntl:
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


@contextmanager
def working_in(folder: Path, *, shared: bool = False) -> Iterator[None]:
    """Have a folder alone, or with others that share it, until the block ends; else ``InputError``."""
    path = folder / FOLDER_LOCK
    with ExitStack() as stack:
        with undisturbed():
            try:
                file = stack.enter_context(open(path, "ab"))
            except OSError as error:
                unwritable(folder, error)
            while (taken := lock_file(file, shared)) and os.fstat(file.fileno()).st_nlink == 0:
                file = stack.enter_context(open(path, "ab"))  # whoever had it has just removed it
            if not taken:
                got, cure = f"{folder}, which one is working in", "Wait for it, or name another."
                bad_value("--out", "a folder that no other run has", got, cure)
            stack.callback(_remove_lock, path, file)
        yield


def _remove_lock(path: Path, file: IO[bytes]) -> None:
    with undisturbed(), suppress(OSError):  # Windows removes no open file
        if lock_file(file):  # the last of those that shared it
            path.unlink()


def _take(hidden: Path, stack: ExitStack) -> bool:
    """Lock a hidden folder until ``stack`` is closed, or the process ends; ``False`` where another has it."""
    file = stack.enter_context(open(hidden / LOCK, "ab"))
    # A run that ended meanwhile has removed the file: nobody's lock.
    return lock_file(file) and os.fstat(file.fileno()).st_nlink > 0


def _held(hidden: Path) -> bool:
    """Whether the process that writes there is alive."""
    with ExitStack() as stack:
        return (hidden / LOCK).is_file() and not _take(hidden, stack)


def files_of_report(folder: Path) -> set[str]:
    """Names of the files that an earlier run wrote there, as its report lists them."""
    try:
        names = json.loads((folder / REPORT).read_text(encoding="utf-8"))["files"]["names"]
        return {name for name in names if Path(name).name == name} if isinstance(names, list) else set()
    except (OSError, ValueError, KeyError, TypeError, RecursionError):  # none, or of something else
        return set()


@dataclass(frozen=True)
class HeldPlace:
    """Where the files of a held ``OutFolder`` go; another process may write them while this one holds it."""

    path: Path  # as the user named it
    target: Path  # the same, absolute, links followed
    staging: Path  # the hidden folder, locked

    def write(self, fill: Callable[[Path], Result]) -> Result:
        """Let ``fill`` write into an empty folder, whose files are then moved; returns what ``fill`` does."""
        files = self.staging / FILES
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
        """Let a new folder appear by one rename; in one that exists replace each file, the report last."""
        if not self.target.is_dir():
            os.rename(files, self.target)
            return
        written, earlier = {path.name for path in files.iterdir()}, files_of_report(self.target)
        for name in sorted(written - {REPORT}):
            os.replace(files / name, self.target / name)
        for path in (self.target / name for name in earlier - written):
            if path.is_file():
                path.unlink()
        if REPORT in written:  # last: until then the old one lists what is still to go
            os.replace(files / REPORT, self.target / REPORT)


class OutFolder:
    """A folder that this process alone writes to, from before the work until the result is in it.

    Whatever speaks against it is said on entry, also that it holds one of ``inputs``. With ``overwrite`` it
    may hold files: an earlier run's, by its report, go; all others stay.
    """

    def __init__(self, path: Path, *, inputs: Collection[Path] = (), overwrite: bool = False) -> None:
        self.path, self._inputs, self._overwrite = Path(path), inputs, overwrite
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._target = check_new(self.path, self._overwrite)
        for path in self._inputs if self._target.is_dir() else ():
            if any(path.exists() and path.samefile(e) for e in self._target.iterdir() if e.is_file()):
                got = f"{self.path}, which holds {path}"  # and which the run may replace or delete
                bad_value("--out", "a folder that holds no input of the run", got, "Name another.")
        self._staging = _hidden(self._target)
        try:
            with undisturbed():
                self._begin(self._stack)
            return self
        except OSError as error:
            self.__exit__()
            unwritable(self.path, error)
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        with undisturbed():
            self._stack.close()

    def _begin(self, stack: ExitStack) -> None:
        """Make the hidden folder, take its lock, and clear what a killed run has left in it."""
        staging, beside = self._staging, _beside(self._target)
        for path in reversed([path for path in (staging, *staging.parents) if not path.exists()]):
            path.mkdir(exist_ok=True)
            stack.callback(_remove_empty, path)
        # Beside it writes a run that began before the folder was there.
        if (staging != beside and _held(beside)) or not _take(staging, stack):
            got = f"{self.path}, which another process is writing to"
            bad_value("--out", "a folder that no other run has", got, "Wait for it, or name another.")
        stack.callback(shutil.rmtree, staging, ignore_errors=True)
        if shutil.disk_usage(staging).free < LEAST_FREE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if (staging / FILES).exists():  # we have the lock, so whoever made them is gone
            shutil.rmtree(staging / FILES)
            print(f"geodiff: removed what a killed run had left in {staging}", file=sys.stderr, flush=True)

    @property
    def place(self) -> HeldPlace:
        """Where its files go, while it is held."""
        return HeldPlace(self.path, self._target, self._staging)

    def write(self, fill: Callable[[Path], Result]) -> Result:
        """Write into its place, as ``HeldPlace.write`` does."""
        return self.place.write(fill)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # not empty: the result is in it
        folder.rmdir()
