"""What became of the items of a long job: a journal that is appended to, or one of each shard of the job."""

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
from typing import Any, Self, TypeVar

from geodiff_plugin._checks import bad_value, refuse
from geodiff_plugin.formats.files import file_digest
from geodiff_plugin.formats.out import lock_file, unwritable

Record = dict[str, Any]
T = TypeVar("T")

#: Status of an item that failed, which the next run tries again.
BROKEN = "broken"


def fingerprint(*parts: Any) -> str:
    """20 hexadecimal digits that name inputs: JSON values, arrays, and paths by what their files hold."""
    text = json.dumps([_readable(part) for part in parts], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _readable(part: Any) -> Any:
    if isinstance(part, Path):
        try:
            return file_digest(part)
        except OSError:  # a folder, or what whoever reads it will complain of
            return None
    if isinstance(part, dict):
        return {name: _readable(value) for name, value in part.items()}
    if hasattr(part, "tobytes"):  # an array: written out, a long one would be cut
        return [str(part.dtype), part.shape, hashlib.sha256(part.tobytes()).hexdigest()]
    return [_readable(value) for value in part] if isinstance(part, (list, tuple)) else part


@dataclass(frozen=True)
class Shard:
    """One of ``count`` processes that do a job together: every ``count``-th item from ``index``, from 0."""

    index: int = 0
    count: int = 1

    @classmethod
    def of(cls, typed: str | None) -> Self:
        """``"I/N"``; without it what ``torchrun`` or ``srun`` put into ``RANK`` and ``WORLD_SIZE``."""
        if typed is None:
            return cls(int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)))
        match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", typed)
        if match is None or not int(match[1]) < int(match[2]):
            bad_value("--shard", "I/N, with I from 0 to N-1, such as 0/8", repr(typed))
        return cls(int(match[1]), int(match[2]))

    @property
    def whole(self) -> bool:
        """Whether it is the whole job."""
        return self.count == 1

    @property
    def local(self) -> int:
        """Its index on its own machine, by which it takes a GPU."""
        return int(os.environ.get("LOCAL_RANK", self.index))

    def processes_here(self, gpus: int) -> int:
        """How many processes of the job share this machine and its cores, >= 1.

        ``torchrun`` says it in ``LOCAL_WORLD_SIZE``. Otherwise each is taken to have one of the ``gpus`` that
        it sees to itself, so that there are no more processes than these.
        """
        return int(os.environ.get("LOCAL_WORLD_SIZE", max(1, min(self.count, gpus))))

    def part(self, items: Sequence[T]) -> list[T]:
        """The items of this shard."""
        return list(items[self.index :: self.count])

    def path(self, path: Path) -> Path:
        """A file of this shard beside one of the whole job: ``pairs.csv`` -> ``pairs.3-of-8.csv``."""
        return path if self.whole else path.with_name(f"{path.stem}.{self}{path.suffix}")

    def __str__(self) -> str:
        return f"{self.index}-of-{self.count}"


def shards_beside(path: Path) -> dict[Shard, Path]:
    """The files of shards that lie beside one of the whole job."""
    pattern = re.compile(rf"{re.escape(path.stem)}\.(\d+)-of-(\d+){re.escape(path.suffix)}")
    found = {}
    for file in path.parent.iterdir() if path.parent.is_dir() else ():
        if match := pattern.fullmatch(file.name):
            found[Shard(int(match[1]), int(match[2]))] = file
    return dict(sorted(found.items(), key=lambda each: (each[0].count, each[0].index)))


@dataclass(frozen=True, eq=False)
class Item:
    """One piece of work; a record of the same ``key`` and ``inputs`` (a fingerprint) says that it is done.

    The first stage works on ``payload``. ``head`` begins its record, also where it fails. ``words`` are texts
    of this item alone, such as its paths, which are no part of the cause of a failure; else its label.
    """

    key: str
    payload: Any = None
    inputs: str = ""
    name: str = ""
    words: tuple[str, ...] = ()
    head: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Its name in messages."""
        return self.name or self.key


class Journal:
    """Records of a job, a line of JSON each; failures of earlier runs do not count.

    Every shard appends to a file of its own and reads those of all, and so does the whole job. A journal has
    its file alone until it is closed: another run with it is refused.
    """

    def __init__(self, path: Path, shard: Shard = Shard()) -> None:
        self.path, self._all = shard.path(path), path
        self._records: dict[tuple[str, str], Record] = {}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self.path, "a+b", buffering=0)
        except OSError as error:
            unwritable(path.parent, error)
        self._lock()
        self._records = {key: r for key, r in self.read().items() if r.get("status") != BROKEN}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let another run have the file."""
        self._file.close()

    def _lock(self) -> None:
        """Have the file alone until it is closed, or the process ends, however it ends."""
        if not lock_file(self._file):
            self.close()
            refuse(
                f"Another run works in {self.path.parent}: wait for it, or give each a --shard of its own."
            )

    def read(self) -> dict[tuple[str, str], Record]:
        """Every record in the files of all shards by its key and inputs, the last of each that did not fail.

        Lines that a killed process left torn are skipped.
        """
        records: dict[tuple[str, str], Record] = {}
        for path in dict.fromkeys([self._all, *shards_beside(self._all).values(), self.path]):
            lines = path.read_bytes().split(b"\n") if path.is_file() else []
            for line in lines:
                with suppress(ValueError, TypeError, KeyError, AttributeError):
                    record = json.loads(line)
                    key = record["key"], record.get("inputs", "")
                    if record.get("status") != BROKEN or key not in records:
                        records[key] = record
        return records

    def get(self, item: Item) -> Record | None:
        """The record of an item; ``None`` where it is still to be made."""
        return self._records.get((item.key, item.inputs))

    def forget(self, item: Item) -> None:
        """Let the record of an item not count, so that it is made again."""
        self._records.pop((item.key, item.inputs), None)

    def put(self, item: Item, record: Record) -> None:
        """Append the record of an item, forced to the disk."""
        named = {"key": item.key, "inputs": item.inputs} if item.inputs else {"key": item.key}
        record = named | {**item.head} | record
        line = (json.dumps(record) + "\n").encode()
        if self._file.seek(0, os.SEEK_END) > 0:
            self._file.seek(-1, os.SEEK_END)
            line = line if self._file.read(1) == b"\n" else b"\n" + line  # after a torn one
        if self._file.write(line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        os.fsync(self._file.fileno())
        self._records[item.key, item.inputs] = record
