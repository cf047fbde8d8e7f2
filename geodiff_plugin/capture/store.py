"""Solved poses on disk, for a run that goes on and for the processes that share it."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin.formats.out import atomic_path
from geodiff_plugin.pose.capture import Observations, SolvedCapture

__all__ = ["load_solved", "save_solved"]


def save_solved(path: Path, solved: SolvedCapture, key: str) -> None:
    """Write everything as ``.npz``.

    Args:
        path: the file to appear.
        solved: poses and points.
        key: of the frames and settings that they are of.
    """
    arrays = {f.name: getattr(solved, f.name) for f in fields(solved) if f.name not in ("seen", "notes")}
    arrays["E_given"] = np.zeros(0) if solved.E_given is None else solved.E_given
    arrays["px"] = np.concatenate([seen.px for seen in solved.seen])
    arrays["point"] = np.concatenate([seen.point for seen in solved.seen])
    arrays["counts"] = np.array([len(seen.point) for seen in solved.seen])
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, key=np.array(key), notes=np.array(solved.notes, np.str_), **arrays)


def load_solved(path: Path, key: str) -> SolvedCapture | None:
    """What ``save_solved`` wrote; ``None`` where there is none of that key."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        if str(arrays.pop("key")) != key:
            return None
        cuts = np.cumsum(arrays.pop("counts"))[:-1]
        px, point = np.split(arrays.pop("px"), cuts), np.split(arrays.pop("point"), cuts)
        values: dict[str, Any] = {n: a.item() if a.ndim == 0 else a for n, a in arrays.items()}
        values["E_given"] = values["E_given"] if values["E_given"].size else None
        values["notes"] = tuple(str(note) for note in values["notes"])
        return SolvedCapture(seen=tuple(map(Observations, px, point)), **values)
    except (OSError, ValueError, KeyError, TypeError):
        return None
