"""The output folder of a run: checked before the work, locked during it, filled whole or not at all.

Data flow: ``--out`` as typed -> ``OutFolder``, held by a lock -> files in a hidden folder -> the folder.
Paper: none.

Nothing here imports torch: what is wrong with a folder is said at once.
"""

from __future__ import annotations

import errno
import json
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
#: Lists what a run wrote, and is written last.
REPORT = "report.json"
#: How long a run on a terminal waits before it tries again to write a result that fits nowhere.
RETRY_S = 10.0

Result = TypeVar("Result")


def _own_files(folder: Path) -> set[str]:
    """Names of the files that an earlier run wrote there, as its report lists them."""
    try:
        names = json.loads((folder / REPORT).read_text(encoding="utf-8"))["files"]["names"]
        return {name for name in names if Path(name).name == name} if isinstance(names, list) else set()
    except (OSError, ValueError, KeyError, TypeError, RecursionError):  # none, or of something else
        return set()


def _say(line: str) -> None:
    tqdm.write(line, file=sys.stderr)  # above a progress bar, if there is one
    sys.stderr.flush()


class OutFolder:
    """A folder that this process alone writes to, from before the work until the result is in it.

    Args:
        path: as typed; it need not exist.
        names: every file that the run may write.
        inputs: files that the run reads, none of which it may replace or delete.
        overwrite: take a folder that holds files. Those that its report lists as an earlier run's own go
            where the new run does not write them; all others stay.
        resume: the folder is written to directly, file by file, and may hold an earlier part of the same.
        option: what ``path`` was given as, for messages.

    Attributes:
        path: where the result is in the end, as typed unless it had to be written elsewhere.
        elsewhere: the sentence that says so, or ``None``.

    Raises:
        ValueError: on entry: what ``check_out`` refuses; files in it, or an input that the run would replace
            or delete; it cannot be written to; another run has it.
    """

    def __init__(
        self,
        path: Path,
        names: Collection[str] = (),
        *,
        inputs: Collection[Path] = (),
        overwrite: bool = False,
        resume: bool = False,
        option: str = "--out",
    ) -> None:
        self.path = Path(path)
        self.elsewhere: str | None = None
        self._names, self._inputs = set(names), inputs
        self._overwrite, self._resume, self._option = overwrite, resume, option
        self._earlier: set[str] = set()
        self._made: list[Path] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._target = check_out(self.path, self._option)
        if holds_files(self._target) and not (self._overwrite or self._resume):
            cure = "Name another, or add --overwrite."
            bad_value(self._option, "a new or empty folder", f"{self.path}, which holds files", cure)
        if self._overwrite:
            self._earlier = _own_files(self._target)
            self._refuse_inputs()
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

    def _refuse_inputs(self) -> None:
        """Refuse a folder with an input of this run among the files that it replaces or deletes."""
        own = [self._target / name for name in sorted(self._names | self._earlier)]
        own = [path for path in own if path.exists()]
        for path in self._inputs:
            if any(path.exists() and path.samefile(other) for other in own):
                got = f"{self.path}, where the run would replace or delete {path}, which it reads"
                bad_value(self._option, "a folder that holds no input of the run", got, "Name another.")

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

        A new folder appears by one rename. In one that exists each file is replaced by one rename, then what
        only an earlier run wrote goes, and the report is replaced last. Where that fails the result is
        written elsewhere, ``elsewhere`` says where; on a terminal a result that fits nowhere is kept and
        tried again until it fits or Ctrl-C.

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
        written = {path.name for path in self._staging.iterdir()}
        for name in sorted(written - {REPORT}):
            _move(self._staging / name, self._target / name)
        for path in (self._target / name for name in self._earlier - written):
            if path.is_file():
                path.unlink()
        if REPORT in written:  # last: until then the old one lists what is still to go
            _move(self._staging / REPORT, self._target / REPORT)
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
