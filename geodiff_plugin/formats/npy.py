"""Arrays of numbers from ``.npy`` files, never unpickled.

Data flow: path -> array.
Paper: none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value

__all__ = ["read_npy"]


def read_npy(path: Path, name: str, expected: str) -> np.ndarray:
    """The array of a file.

    Args:
        path: an existing file.
        name: the argument that it came in, for messages.
        expected: what it should hold, for messages.

    Returns:
        Of real numbers, in the file's own type.

    Raises:
        ValueError: numpy cannot load it, or it holds something else.
    """
    reason: str | None = None
    try:
        value = np.load(path, allow_pickle=False)
    except Exception as error:  # a damaged head is parsed as Python, which may fail in any way
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        if "pickle" in reason:  # numpy's own words tell how to run what is in there
            reason = "pickled objects, which are never loaded"
    if reason is not None:
        bad_value(name, expected, f"{path}, which numpy cannot load ({reason})", "Save it with numpy.save.")
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        cure = "Save one array with numpy.save."
        bad_value(name, expected, f"{path} without an array of real numbers", cure)
    return value
