"""Output files and folders: complete or absent, with errors reported before the work."""

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
from typing import IO, Any, NoReturn, Self, TypeVar

from geodiff_plugin._internal.checks import InputFileError, MissingFileError, bad_value
from geodiff_plugin._internal.signals import defer_signals

try:
    import fcntl
except ImportError:  # Windows: two runs in one folder are not detected
    fcntl = None  # type: ignore[assignment]

#: Temporary folder for results until they are complete.
PARTIAL = ".geodiff-partial"
#: Name of the lock file in it.
LOCK = "lock"
#: Subfolder with the files written so far.
FILES = "files"
#: Lock file in a folder used for a long run, visible to other runs.
FOLDER_LOCK = ".geodiff-lock"
REPORT = "report.json"
MIN_FREE_BYTES = 8 << 20

Result = TypeVar("Result")


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Return a temporary path next to ``path``, renamed to it if the block succeeds, otherwise deleted."""
    target = Path(path)
    if os.path.isdir(target):
        bad_value("The output", "a file", f"the folder {target}", "Pass a file in it.", InputFileError)
    if not os.path.isdir(target.parent):
        hint = f"Create the folder {target.parent} first."
        bad_value("The output", "in an existing folder", target, hint, MissingFileError)
    temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a file completely or not at all; creates its folder if missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def reason_of(error: OSError) -> str:
    """Return the system's message of an error, without the path."""
    return error.strerror or str(error)


def raise_unwritable(path: Path, error: OSError) -> NoReturn:
    """Raise an error for an output folder that is not writable."""
    hint = "Choose a different --out, or free disk space and check its permissions."
    bad_value("--out", "a writable folder", f"{path} ({reason_of(error)})", hint)


def _sibling(target: Path) -> Path:
    return target.parent / f".{target.name}{PARTIAL}"


def _hidden(target: Path) -> Path:
    """Return the hidden folder of unfinished files and lock; inside an existing target (may be a mount)."""
    return target / PARTIAL if target.is_dir() else _sibling(target)


def check_out(path: Path) -> Path:
    """Return the absolute path of an output folder, with links resolved."""
    try:
        target = Path(os.path.realpath(path))  # Path.resolve raises RuntimeError for a link to itself
        for place in (target, _sibling(target)):  # the latter has the longest name that will be used
            with suppress(FileNotFoundError):
                os.stat(place)
    except OSError as error:
        raise_unwritable(path, error)
    if target.exists() and not target.is_dir():
        bad_value("--out", "a folder", f"the file {path}", "Pass a folder.")
    return target


def _holds_files(target: Path) -> bool:
    """Whether a folder exists and contains more than leftovers of an unfinished run."""
    left = (PARTIAL, FOLDER_LOCK)
    return target.is_dir() and any(path.name not in left for path in target.iterdir())


def check_new(path: Path, overwrite: bool) -> Path:
    """Call ``check_out`` for a folder that must be new or empty, unless it may be overwritten."""
    target = check_out(path)
    if _holds_files(target) and not overwrite:
        hint = "Choose a different one, or add --overwrite."
        bad_value("--out", "a new or empty folder", f"{path}, which contains files", hint)
    return target


def check_new_file(path: Path, overwrite: bool) -> None:
    """Raise an error if an output file exists and may not be overwritten."""
    if path.exists() and not overwrite:
        bad_value(
            "--out", "a new file", f"{path}, which exists", "Choose a different one, or add --overwrite."
        )


def free_folder(default: Path) -> Path:
    """Return a default output folder: ``default``, or ``default-2`` etc. if it exists."""
    path = default
    for number in itertools.count(2):
        taken = os.path.lexists(path) and (not path.is_dir() or _holds_files(path))
        if not taken and not _held(_hidden(path)):
            break
        path = default.with_name(f"{default.name}-{number}")
    return path


def lock_file(file: IO[bytes], shared: bool = False) -> bool:
    """Lock an open file until it is closed or the process ends, exclusively or ``shared``.

    Returns ``False`` if another process has locked it. On Windows and file systems without locks always
    succeeds.
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


def _lock(path: Path, stack: ExitStack, shared: bool = False) -> IO[bytes] | None:
    """Create and lock ``path`` until ``stack`` is closed or the process ends; ``None`` if it is locked."""
    while True:
        file = stack.enter_context(open(path, "ab"))
        if not lock_file(file, shared):
            return None
        if os.fstat(file.fileno()).st_nlink:
            return file  # otherwise its owner deleted it after it was opened here; try again


@contextmanager
def created_folder(folder: Path) -> Iterator[None]:
    """Create a folder and its missing parents; when the block ends, delete the empty ones."""
    with ExitStack() as stack:
        for path in reversed([path for path in (folder, *folder.parents) if not path.exists()]):
            path.mkdir(exist_ok=True)
            stack.callback(_remove_empty, path)
        yield


@contextmanager
def locked_folder(folder: Path, *, shared: bool = False) -> Iterator[None]:
    """Lock a folder until the block ends, exclusively or ``shared``; raise ``InputError`` if it is locked."""
    path = folder / FOLDER_LOCK
    with ExitStack() as stack:
        with defer_signals():
            try:
                file = _lock(path, stack, shared)
            except OSError as error:
                raise_unwritable(folder, error)
            if file is None:
                got = f"{folder}, which another run is using"
                hint = "Wait for it, or choose a different one."
                bad_value("--out", "a folder that no other run uses", got, hint)
            stack.callback(_unlock, path, file)
        yield


def _unlock(path: Path, file: IO[bytes]) -> None:
    """Delete a lock file, unless another run shares it."""
    with defer_signals(), suppress(OSError):  # Windows does not delete open files
        if lock_file(file):
            path.unlink()


def _held(hidden: Path) -> bool:
    """Whether the process that writes there is alive."""
    with ExitStack() as stack, suppress(FileNotFoundError):  # the folder of a run that ends at this moment
        return (hidden / LOCK).is_file() and _lock(hidden / LOCK, stack) is None
    return False


def read_report(folder: Path) -> dict[str, Any]:
    """Read the report of a result; empty if it is missing or unreadable."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}


def files_of_report(folder: Path) -> set[str]:
    """Return the names of files that an earlier run wrote there, as listed in its report."""
    try:
        names = read_report(folder)["files"]["names"]
        return {name for name in names if Path(name).name == name} if isinstance(names, list) else set()
    except (KeyError, TypeError):  # no report, or of another program
        return set()


@dataclass(frozen=True)
class HeldFolder:
    """Target of a held ``OutFolder``; another process may write files to it while this one holds it."""

    path: Path  # as given by the user
    target: Path  # absolute, with links resolved
    staging: Path  # hidden folder, locked

    def write(self, fill: Callable[[Path], Result]) -> Result:
        """Call ``fill`` with an empty folder, then move its files; returns the result of ``fill``."""
        files = self.staging / FILES
        try:
            files.mkdir()
            result = fill(files)
            self._move(files)
        except InputFileError:  # states the file itself
            raise
        except OSError as error:
            hint = "Free disk space or check its permissions, and run it again."
            raise InputFileError(f"{self.path} could not be written ({reason_of(error)}). {hint}") from error
        finally:
            shutil.rmtree(files, ignore_errors=True)
        return result

    def _move(self, files: Path) -> None:
        """Move a new folder with one rename; in an existing one replace each file, the report last."""
        if not self.target.is_dir():
            os.rename(files, self.target)
            return
        written = {path.name for path in files.iterdir()}
        earlier = files_of_report(self.target)
        for name in sorted(written - {REPORT}):
            os.replace(files / name, self.target / name)
        for path in (self.target / name for name in earlier - written):
            if path.is_file():
                path.unlink()
        if REPORT in written:  # last: until then the old report lists files that still have to be deleted
            os.replace(files / REPORT, self.target / REPORT)


class OutFolder:
    """An output folder locked by this process from before the work until the result is in it.

    Raises errors on entry, also if it contains one of ``inputs``. With ``overwrite`` it may contain files:
    those in an earlier run's report are deleted, all others kept.
    """

    def __init__(self, path: Path, *, inputs: Collection[Path] = (), overwrite: bool = False) -> None:
        self.path = Path(path)
        self._inputs = inputs
        self._overwrite = overwrite
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._target = check_new(self.path, self._overwrite)
        self._check_without_inputs()
        self._staging = _hidden(self._target)
        try:
            with defer_signals():
                self._begin(self._stack)
            return self
        except OSError as error:
            self.__exit__()
            raise_unwritable(self.path, error)
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        with defer_signals():
            self._stack.close()

    def _check_without_inputs(self) -> None:
        """Raise an error if the folder contains an input, which the run might replace or delete."""
        if not self._inputs or not self._target.is_dir():
            return
        files = [file for file in self._target.iterdir() if file.is_file()]
        for path in self._inputs:
            if any(path.exists() and path.samefile(file) for file in files):
                got = f"{self.path}, which holds {path}"
                bad_value("--out", "a folder without inputs of the run", got, "Choose a different one.")

    def _begin(self, stack: ExitStack) -> None:
        """Create and lock the hidden folder, and delete leftovers of a killed run."""
        staging = self._staging
        sibling = _sibling(self._target)
        stack.enter_context(created_folder(staging))
        # A run that started before the folder existed writes next to it.
        if (staging != sibling and _held(sibling)) or _lock(staging / LOCK, stack) is None:
            got = f"{self.path}, which another process is writing to"
            bad_value(
                "--out", "a folder that no other run uses", got, "Wait for it, or choose a different one."
            )
        stack.callback(shutil.rmtree, staging, ignore_errors=True)
        if shutil.disk_usage(staging).free < MIN_FREE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if (staging / FILES).exists():  # it is unlocked, so the process that created them has ended
            shutil.rmtree(staging / FILES)
            print(f"geodiff: removed leftovers of a killed run in {staging}", file=sys.stderr, flush=True)

    @property
    def place(self) -> HeldFolder:
        """Return the target of its files; valid while it is held."""
        return HeldFolder(self.path, self._target, self._staging)

    def write(self, fill: Callable[[Path], Result]) -> Result:
        """Write to its target, like ``HeldFolder.write``."""
        return self.place.write(fill)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):  # not empty: it contains the result
        folder.rmdir()
