"""Stores results of many pairs as Parquet files, on a local disk or an object store (extra ``ray``).

A file appears complete or not at all. Its name is derived from its keys, so a repeated task overwrites the
same file. There is no lock against two runs on one folder: an object store has no locks.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
from contextlib import suppress
from dataclasses import dataclass
from typing import Self

import fsspec
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as pds
import pyarrow.parquet as pq
from pyarrow import fs

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.jobs.finished import changed_options
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.rows import COLUMNS

#: File with the options of the run.
JOB = "job.json"
#: Prefix of files with results.
RESULTS = "part-"
#: Prefix of files with errors, whose pairs the next run retries.
ERRORS = "errors-"
KEY = pa.field("key", pa.string())
SCHEMA = pa.schema([KEY, *(pa.field(name, pa.type_for_alias(alias)) for name, alias in COLUMNS.items())])
#: Matches a URI in a ``Path``, which merges two slashes into one; a Windows drive has a single letter.
URI = re.compile(r"([a-z][a-z0-9+.-]+):/+(.*)")


@dataclass(frozen=True)
class Store:
    """A folder given by path or URI: on a local disk, or any file system of pyarrow or fsspec."""

    uri: str

    @classmethod
    def of(cls, options: DepthOptions) -> Self:
        """Return the store of ``--out``."""
        match = URI.fullmatch(str(options.out))
        if match is None:
            return cls(str(options.out))
        return cls(f"/{match[2]}" if match[1] == "file" else f"{match[1]}://{match[2]}")

    def open(self) -> tuple[fs.FileSystem, str]:
        """Return the file system and the folder in it."""
        if "://" not in self.uri:
            return fs.LocalFileSystem(), self.uri
        try:
            system, folder = fs.FileSystem.from_uri(self.uri)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError):
            opened, folder = fsspec.core.url_to_fs(self.uri)
            system = fs.PyFileSystem(fs.FSSpecHandler(opened))
        return system, folder

    def _write(self, name: str, content: bytes) -> None:
        """Write a file; on a disk by renaming, because an object appears only when complete."""
        system, folder = self.open()
        is_disk = isinstance(system, fs.LocalFileSystem)
        path = f"{folder}/{name}"
        temporary = f"{folder}/.{name}.{secrets.token_hex(4)}" if is_disk else path
        try:
            with system.open_output_stream(temporary) as file:
                file.write(content)
        except OSError:
            with suppress(OSError):
                system.delete_file(temporary)  # partial content on a full disk
            raise
        if is_disk:
            system.move(temporary, path)

    def _names(self) -> list[str]:
        system, folder = self.open()
        found = system.get_file_info(fs.FileSelector(folder, allow_not_found=True))
        return sorted(info.base_name for info in found if info.type == fs.FileType.File)

    def begin(self, options: DepthOptions) -> set[str]:
        """Create the folder, or resume the job in it; return the keys that have results.

        Raises:
            InputError: the folder has other files, or a job with other options.
        """
        system, folder = self.open()
        names = self._names()
        if names and JOB not in names:
            bad_value(
                "--out",
                "a new or empty folder, or one of an earlier run",
                self.uri,
                "Choose a different one.",
            )
        if JOB in names and not options.overwrite:
            with system.open_input_stream(f"{folder}/{JOB}") as file:
                made = json.loads(file.read())
            if changes := changed_options(options, made):
                hint = "Choose a different --out, or add --overwrite to repeat all pairs."
                bad_value("--out", "a folder of a run with the same options", ", ".join(changes), hint)
        system.create_dir(folder, recursive=True)
        for name in names:
            if name.startswith((".", ERRORS)) or (options.overwrite and name.startswith(RESULTS)):
                system.delete_file(f"{folder}/{name}")
        self._write(JOB, json.dumps(options.as_json(), indent=1).encode())
        return set() if options.overwrite else self.keys()

    def keys(self) -> set[str]:
        """Return the keys of all results."""
        system, folder = self.open()
        files = [f"{folder}/{name}" for name in self._names() if name.startswith(RESULTS)]
        found = pds.dataset(files, schema=pa.schema([KEY]), format="parquet", filesystem=system)
        return set(found.to_table()["key"].to_pylist())

    def put(self, rows: pa.Table) -> pa.Table:
        """Write rows with the columns of ``SCHEMA``; return key, verdict and error of each."""
        table = rows.select(SCHEMA.names)
        failed = pc.is_valid(table["error"])
        parts = {RESULTS: table.filter(pc.invert(failed)), ERRORS: table.filter(failed)}
        for begins, part in parts.items():
            if part.num_rows:
                keys = "\n".join(part["key"].to_pylist())
                sink = pa.BufferOutputStream()
                pq.write_table(part, sink)
                name = f"{begins}{hashlib.sha256(keys.encode()).hexdigest()[:16]}.parquet"
                self._write(name, sink.getvalue().to_pybytes())
        return table.select(["key", "verdict", "error"])
