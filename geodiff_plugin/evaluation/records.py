"""Records of a resumable run: one JSON line per sample and method.

Data flow: record -> line of ``samples.jsonl`` -> records of a later run.
Paper: none.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from geodiff_plugin.evaluation.datasets.sample import SampleRef
from geodiff_plugin.formats import atomic_path
from geodiff_plugin.formats.files import file_digest

__all__ = ["append_record", "clean_records", "read_records", "record_key"]


def _content(path: Path) -> str | None:
    """A fingerprint of a file; ``None`` for a folder, or a file that cannot be read: its loader says why."""
    try:
        return file_digest(path)
    except OSError:
        return None


def record_key(ref: SampleRef, method: str, configuration: dict[str, Any], prior: str, version: str) -> str:
    """Name of a result: the same inputs give the same key, anything else another.

    Args:
        ref: the sample; not where its files lie but what is in them counts, and its other entries (cameras,
            views). A folder counts by the files of it that the sample names as well.
        method: its name.
        configuration: everything that changes the method's result beside the prior, JSON values.
        prior: name and fingerprint of the prior, empty for a method without one.
        version: of this package.

    Returns:
        20 hexadecimal digits.
    """
    read = {name: _content(v) if isinstance(v, Path) else v for name, v in ref.files.items()}
    choices = {name: value for name, value in read.items() if value is not None}
    named = [method, configuration, prior, version, ref.dataset, ref.name, choices]
    return hashlib.sha256(json.dumps(named, sort_keys=True, default=str).encode()).hexdigest()[:20]


def read_records(path: Path) -> list[dict[str, Any]]:
    """Every whole line of ``path``, in order; a line that a killed run left torn is left out."""
    records = []
    if path.is_file():
        for line in path.read_bytes().split(b"\n"):
            try:
                record = json.loads(line)
            except ValueError:
                continue
            if isinstance(record, dict):
                records.append(record)
    return records


def clean_records(path: Path) -> None:
    """Rewrite ``path`` without torn lines and without samples that were broken: they are tried again.

    A file that needs no cleaning stays as it is.
    """
    if not path.is_file():
        return
    kept = [record for record in read_records(path) if record.get("status") != "broken"]
    clean = "".join(json.dumps(record) + "\n" for record in kept).encode()
    if clean != path.read_bytes():
        with atomic_path(path) as temporary:
            temporary.write_bytes(clean)


def append_record(path: Path, record: dict[str, Any]) -> None:
    """Append one line and force it to the disk.

    The line goes out in one write to a file opened for appending, so that the lines of several processes do
    not mix.
    """
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(handle, (json.dumps(record) + "\n").encode())
        os.fsync(handle)
    finally:
        os.close(handle)
