"""The output folder of a run: checked before the work, locked during it, filled whole or not at all.

Data flow: ``--out`` as typed -> ``OutFolder``, held by a lock -> files in a hidden folder -> the folder.
Paper: none.

Nothing here imports torch: what is wrong with a folder is said at once.
"""

from __future__ import annotations

import errno
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Collection
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from tqdm import tqdm

from geodiff_plugin._checks import InputFileError, bad_value
from geodiff_plugin.formats.out_place import (
    CAN_LOCK,
    LOCK,
    PARTIAL,
    check_out,
    held_by_another,
    hidden_path,
    holds_files,
    reason_of,
    take_lock,
)

__all__ = ["EXIT_ELSEWHERE", "OutFolder"]

#: Exit code of a run whose result could not be written where it was asked for, and was written elsewhere.
EXIT_ELSEWHERE = 3
#: How long a run on a terminal waits before it tries again to write a result that fits nowhere.
RETRY_S = 10.0

Result = TypeVar("Result")


def _say(line: str) -> None:
    tqdm.write(line, file=sys.stderr)  # above a progress bar, if there is one
    sys.stderr.flush()


class OutFolder:
    """A folder that this process alone writes to, from before the work until the result is in it.

    Args:
        path: as typed; it need not exist.
        names: every file that a run may write; those of an earlier run that a new one does not write go.
        overwrite: take a folder that holds files; files that are not among ``names`` stay.
        resume: the folder is written to directly, file by file, and may hold an earlier part of the same.
        option: what ``path`` was given as, for messages.

    Attributes:
        path: where the result is in the end, as typed unless it had to be written elsewhere.
        elsewhere: the sentence that says so, or ``None``.

    Raises:
        ValueError: on entry: what ``check_out`` refuses; files in it; it cannot be written to; another run
            has it.
    """

    def __init__(
        self,
        path: Path,
        names: Collection[str] = (),
        *,
        overwrite: bool = False,
        resume: bool = False,
        option: str = "--out",
    ) -> None:
        self.path = Path(path)
        self.elsewhere: str | None = None
        self._names, self._overwrite, self._resume, self._option = set(names), overwrite, resume, option
        self._made: list[Path] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._target = check_out(self.path, self._option)
        if holds_files(self._target) and not (self._overwrite or self._resume):
            cure = "Name another, or add --overwrite."
            bad_value(self._option, "a new or empty folder", f"{self.path}, which holds files", cure)
        with ExitStack() as stack:
            stack.callback(self._remove_made)
            try:
                self._make(self._target if self._resume else self._target.parent)
                self._lock(stack)
                self._staging = hidden_path(self._target, PARTIAL)
                self._clear_leftovers()
            except OSError as error:
                cure = "Name another with --out, or free disk space and check its permissions."
                bad_value(
                    self._option, "a folder that can be written to", f"{self.path} ({reason_of(error)})", cure
                )
            stack.callback(shutil.rmtree, self._staging, ignore_errors=True)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _make(self, folder: Path) -> None:
        """Make a folder and those above it, and remember which were new."""
        missing = [folder, *folder.parents]
        self._made = [path for path in missing if not path.exists()]
        folder.mkdir(parents=True, exist_ok=True)

    def _remove_made(self) -> None:
        for path in self._made:
            try:
                path.rmdir()
            except OSError:  # not empty: the result is in it
                return

    def _lock(self, stack: ExitStack) -> None:
        """Take the folder's lock; the kernel gives it back when the process ends, however it ends."""
        beside = self._target.with_name(f".{self._target.name}{LOCK}")
        lock = hidden_path(self._target, LOCK)
        if lock != beside and held_by_another(beside):  # a run that began before the folder was there
            self._refuse_held(beside)
        while True:
            file = stack.enter_context(open(lock, "a+b", buffering=0))
            if not CAN_LOCK:
                break
            if not take_lock(file):
                self._refuse_held(lock)
            # A run that ended meanwhile has taken the file away: what we hold is then nobody's lock.
            if lock.exists() and os.path.samestat(os.fstat(file.fileno()), lock.stat()):
                break
        stack.callback(lock.unlink, missing_ok=True)
        file.truncate(0)
        file.write(f"{os.getpid()}\n".encode())  # says who, and finds out whether the disk takes a byte

    def _refuse_held(self, lock: Path) -> None:
        process = lock.read_text(encoding="ascii", errors="replace").strip() or "unknown"
        got = f"{self.path}, which process {process} is writing to"
        bad_value(self._option, "a folder that no other run has", got, "Wait for it, or name another.")

    def _clear_leftovers(self) -> None:
        if self._staging.exists():  # we have the lock, so whoever made it is gone
            shutil.rmtree(self._staging)
            _say(f"geodiff: removed what a run that was killed had left in {self._staging}")

    def write(self, fill: Callable[[Path], Result]) -> Result:
        """Let ``fill`` write into an empty folder, whose files then are this folder's.

        A new folder appears by one rename. In one that exists each file is replaced by one rename, the
        report last. Where that fails the result is written elsewhere, ``elsewhere`` says where; on a terminal
        a result that fits nowhere is kept and tried again until it fits or Ctrl-C.

        Args:
            fill: writes all files into the folder that it is given; it is called again for every attempt.

        Returns:
            What ``fill`` returned.

        Raises:
            OSError: it could be written nowhere.
        """
        while True:
            try:
                return self._fill_and_move(fill)
            except OSError as error:
                shutil.rmtree(self._staging, ignore_errors=True)
                reason = f"{self.path} could not be written ({reason_of(error)})"
            for base_of in (Path.cwd, tempfile.gettempdir, Path.home):
                # On a full disk no folder for temporary files is found; a working folder may be gone.
                with suppress(OSError, RuntimeError):
                    result = self._fill_in(Path(base_of()), fill)
                    self.elsewhere = f"{reason}; the result is in {self.path}."
                    return result
            if not sys.stderr.isatty():
                raise InputFileError(f"{reason}, nor a folder here, among temporary ones or at home.")
            _say(f"geodiff: {reason}, nor any other folder; make room. Trying again in {RETRY_S:g} s.")
            time.sleep(RETRY_S)

    def _fill_in(self, base: Path, fill: Callable[[Path], Result]) -> Result:
        folder = Path(tempfile.mkdtemp(prefix=f"{self._target.name[:64]}-", dir=base))
        try:
            result = fill(folder)
        except OSError:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        self.path = folder
        return result

    def _fill_and_move(self, fill: Callable[[Path], Result]) -> Result:
        self._staging.mkdir()
        result = fill(self._staging)
        if not self._target.exists():
            try:
                os.rename(self._staging, self._target)
                return result
            except OSError as error:
                if error.errno not in (errno.EXDEV, errno.ENOTEMPTY, errno.EEXIST):
                    raise
            self._target.mkdir(exist_ok=True)
        written = sorted(self._staging.iterdir(), key=lambda path: path.name == "report.json")
        for path in written:
            _move(path, self._target / path.name)
        for name in self._names - {path.name for path in written}:
            (self._target / name).unlink(missing_ok=True)
        return result


def _move(source: Path, target: Path) -> None:
    """Rename a file, or copy it where that crosses file systems; the target is whole at every moment."""
    try:
        os.replace(source, target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        beside = target.with_name(f"{PARTIAL}-{target.name}")
        try:
            shutil.copyfile(source, beside)
            os.replace(beside, target)
        finally:
            beside.unlink(missing_ok=True)
        source.unlink()
