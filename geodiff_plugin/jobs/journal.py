"""Journal of a long job: an append-only file of records per item, or one file per shard of the job."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

from geodiff_plugin._internal.checks import bad_value, raise_input_error
from geodiff_plugin.formats import file_digest, lock_file, raise_unwritable

Record = dict[str, Any]
T = TypeVar("T")

#: Status of a failed item, which the next run retries.
BROKEN = "broken"


def fingerprint(*parts: Any) -> str:
    """Return 20 hexadecimal digits that identify inputs: JSON values, arrays, and files by their content."""
    text = json.dumps([_readable(part) for part in parts], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _readable(part: Any) -> Any:
    if isinstance(part, Path):
        try:
            return file_digest(part)
        except OSError:  # a folder, or a file whose reader will report the error
            return None
    if isinstance(part, dict):
        return {name: _readable(value) for name, value in part.items()}
    if hasattr(part, "tobytes"):  # written in full, because ``str`` abbreviates long arrays
        return [str(part.dtype), part.shape, hashlib.sha256(part.tobytes()).hexdigest()]
    return [_readable(value) for value in part] if isinstance(part, (list, tuple)) else part


@dataclass(frozen=True)
class Shard:
    """One of ``count`` processes that share a job; takes every ``count``-th item, starting at ``index``."""

    index: int = 0
    count: int = 1

    @classmethod
    def of(cls, typed: str | None) -> Self:
        """Parse ``"I/N"``; by default, use ``RANK`` and ``WORLD_SIZE`` as set by ``torchrun`` or ``srun``."""
        if typed is None:
            return cls(int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)))
        match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", typed)
        if match is None or not int(match[1]) < int(match[2]):
            bad_value("--shard", "I/N, with I from 0 to N-1, such as 0/8", repr(typed))
        return cls(int(match[1]), int(match[2]))

    @property
    def whole(self) -> bool:
        """Whether this is the whole job."""
        return self.count == 1

    @property
    def local(self) -> int:
        """Index on this machine, which selects a GPU."""
        return int(os.environ.get("LOCAL_RANK", self.index))

    def processes_here(self, gpus: int) -> int:
        """Return the number of processes of the job that share this machine and its cores, >= 1.

        ``torchrun`` sets ``LOCAL_WORLD_SIZE``. Otherwise each process is assumed to use one of the ``gpus``
        that it sees, so there are at most that many processes.
        """
        return int(os.environ.get("LOCAL_WORLD_SIZE", max(1, min(self.count, gpus))))

    def part(self, items: Sequence[T]) -> list[T]:
        """Return the items of this shard."""
        return list(items[self.index :: self.count])

    def path(self, path: Path) -> Path:
        """Return this shard's file for a file of the whole job: ``pairs.csv`` -> ``pairs.3-of-8.csv``."""
        return path if self.whole else path.with_name(f"{path.stem}.{self}{path.suffix}")

    def __str__(self) -> str:
        return f"{self.index}-of-{self.count}"


def shard_files(path: Path) -> dict[Shard, Path]:
    """Find the files of shards in the folder of a file of the whole job."""
    pattern = re.compile(rf"{re.escape(path.stem)}\.(\d+)-of-(\d+){re.escape(path.suffix)}")
    found = {}
    for file in path.parent.iterdir() if path.parent.is_dir() else ():
        if match := pattern.fullmatch(file.name):
            found[Shard(int(match[1]), int(match[2]))] = file
    return dict(sorted(found.items(), key=lambda each: (each[0].count, each[0].index)))


@dataclass(frozen=True, eq=False)
class Item:
    """One unit of work; a record with the same ``key`` and ``inputs`` (a fingerprint) marks it as done.

    The first stage works on ``payload``. ``head`` starts its record, also if it fails. ``words`` are strings
    specific to this item, such as paths, which are removed from the cause of a failure (default: its label).
    """

    key: str
    payload: Any = None
    inputs: str = ""
    name: str = ""
    words: tuple[str, ...] = ()
    head: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name in messages."""
        return self.name or self.key


class Done(NamedTuple):
    """Outcome of an item processed by an engine: its record, or its error."""

    key: str
    record: Record | None
    error: str | None


class Journal:
    """Stores the records of a job, one line of JSON each; ignores failures of earlier runs.

    Every shard appends to its own file and reads all shards' files; so does the whole job. A journal locks
    its file until it is closed, so a concurrent run on it raises an error.
    """

    def __init__(self, path: Path, shard: Shard = Shard()) -> None:
        self.path = shard.path(path)
        self._all = path
        self._records: dict[tuple[str, str], Record] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self.path, "a+b", buffering=0)
        except OSError as error:
            raise_unwritable(path.parent, error)
        self._lock()
        self._records = {key: r for key, r in self.read().items() if r.get("status") != BROKEN}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close and unlock the file."""
        self._file.close()

    def _lock(self) -> None:
        """Lock the file until it is closed or the process ends."""
        if not lock_file(self._file):
            self.close()
            raise_input_error(
                f"Another run is using {self.path.parent}. Wait for it, or give each run its own --shard."
            )

    def read(self) -> dict[tuple[str, str], Record]:
        """Read the records of all shards by key and inputs: the last one of each that did not fail.

        Skips incomplete lines left by a killed process.
        """
        records: dict[tuple[str, str], Record] = {}
        for path in dict.fromkeys([self._all, *shard_files(self._all).values(), self.path]):
            lines = path.read_bytes().split(b"\n") if path.is_file() else []
            for line in lines:
                with suppress(ValueError, TypeError, KeyError, AttributeError):
                    record = json.loads(line)
                    key = record["key"], record.get("inputs", "")
                    if record.get("status") != BROKEN or key not in records:
                        records[key] = record
        return records

    def get(self, item: Item) -> Record | None:
        """Return the record of an item, or ``None`` if it is not done."""
        return self._records.get((item.key, item.inputs))

    def forget(self, item: Item) -> None:
        """Drop the record of an item, so that it is processed again."""
        self._records.pop((item.key, item.inputs), None)

    def put(self, item: Item, record: Record) -> None:
        """Append the record of an item, and flush it to disk."""
        named = {"key": item.key, "inputs": item.inputs} if item.inputs else {"key": item.key}
        record = named | {**item.head} | record
        line = (json.dumps(record) + "\n").encode()
        if self._file.seek(0, os.SEEK_END) > 0:
            self._file.seek(-1, os.SEEK_END)
            line = line if self._file.read(1) == b"\n" else b"\n" + line  # after an incomplete line
        if self._file.write(line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        os.fsync(self._file.fileno())
        self._records[item.key, item.inputs] = record
