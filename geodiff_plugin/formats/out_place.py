"""Choice of an output folder: whether it exists, is in use by another run, and the next free name.

Data flow: ``--out`` as typed -> a path that ``OutFolder`` can take, or one clear error.
Paper: none.

Nothing here imports torch: what is wrong with a folder is said at once.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO

from geodiff_plugin._checks import bad_value

try:
    import fcntl
except ImportError:  # where there is no flock, two runs with one folder are not detected
    CAN_LOCK = False
else:
    CAN_LOCK = True

__all__ = [
    "CAN_LOCK",
    "LOCK",
    "PARTIAL",
    "check_out",
    "free_folder",
    "held_by_another",
    "hidden_path",
    "holds_files",
    "reason_of",
    "take_lock",
]

LOCK, PARTIAL = ".geodiff-lock", ".geodiff-partial"
MOST_NUMBERED = 10_000


def hidden_path(target: Path, kind: str) -> Path:
    """Where the lock or the unfinished files of a folder lie: inside it, or beside it until it is there."""
    return target / kind if target.is_dir() else target.with_name(f".{target.name}{kind}")


def reason_of(error: OSError) -> str:
    """The system's words for what went wrong, without the path."""
    return error.strerror or str(error)


def _absolute(path: Path, name: str) -> Path:
    try:
        return path.absolute()
    except FileNotFoundError:
        cure = "Change to one that is there."
        bad_value(name, "below a working folder that exists", f"{path}, and that folder was removed", cure)


def check_out(path: Path, name: str = "--out") -> Path:
    """The place that an output folder has or will have, links followed.

    Args:
        path: as typed.
        name: the option, for messages.

    Raises:
        ValueError: a file, a link to nothing, below a file, or a name that the file system refuses.
    """
    try:
        if path.is_symlink() and not path.exists():
            cure = "Make that folder, or remove the link."
            bad_value(name, "a folder", f"{path}, a link to {os.readlink(path)}, which does not exist", cure)
        target = _absolute(path, name) if not path.exists() else path.resolve()
        if target.exists() and not target.is_dir():
            bad_value(name, "a folder", f"the file {path}", "Name a folder.")
        if not target.name:
            bad_value(name, "a folder below the root", str(path), "Name a folder.")
        os.stat(target.with_name(f".{target.name}{PARTIAL}"))  # the longest name that will be needed
    except FileNotFoundError:
        pass
    except NotADirectoryError:
        bad_value(name, "a folder that can be made", f"{path}, which lies below a file")
    except OSError as error:
        bad_value(name, "a folder that can be made", f"{path} ({reason_of(error)})", "Name another.")
    return target


def holds_files(target: Path) -> bool:
    """Whether a folder is there and has more in it than a lock and what an unfinished run left."""
    return target.is_dir() and any(path.name not in (LOCK, PARTIAL) for path in target.iterdir())


def free_folder(default: Path) -> Path:
    """A folder for a run that named none: ``default``, or ``default-2`` and so on where that is taken."""
    for number in range(1, MOST_NUMBERED):
        path = default if number == 1 else default.with_name(f"{default.name}-{number}")
        taken = os.path.lexists(path) and (not path.is_dir() or holds_files(path))
        if not taken and not held_by_another(hidden_path(_absolute(path, "--out"), LOCK)):
            return path
    bad_value("--out", "given, as a new folder", f"{MOST_NUMBERED} folders {default}-N that hold files")


def take_lock(file: IO[bytes]) -> bool:
    """Lock an open file until it is closed; ``False`` where another process has it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def held_by_another(lock: Path) -> bool:
    """Whether a process that writes to the folder of this lock is alive."""
    if not (CAN_LOCK and lock.is_file()):
        return False
    with open(lock, "rb") as file:
        try:
            return not take_lock(file)
        except OSError:  # a file system that knows no locks
            return True
