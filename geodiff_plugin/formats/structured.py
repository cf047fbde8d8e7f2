"""Numbers from the JSON and YAML of calibration files.

Data flow: text -> nested dicts and lists -> checked float64 arrays.
Paper: none.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from geodiff_plugin._checks import bad_value

__all__ = ["array_of", "entry", "parse_json", "parse_yaml"]

CUT_OFF = "Is the file cut off?"
#: OpenCV's head of a YAML file, which YAML itself does not know; files written by hand copy it.
OPENCV_HEAD = re.compile(r"\A\s*%YAML:[^\n]*")


def parse_json(text: str, path: Path) -> Any:
    """What a JSON text holds.

    Raises:
        ValueError: not JSON, naming the line.
    """
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        bad_value(f"{path}", "JSON", f"{error.msg} in line {error.lineno}", CUT_OFF)
    except RecursionError:
        bad_value(f"{path}", "a JSON object of numbers", "lists within lists without end")
    except ValueError:
        bad_value(f"{path}", "a JSON object of numbers", "a whole number of thousands of digits")


def parse_yaml(text: str, path: Path) -> dict[str, Any]:
    """The mapping that the first YAML document holds; later documents (``rostopic echo``) are left out.

    Raises:
        ValueError: not YAML, or no mapping.
    """
    try:
        content = next(yaml.safe_load_all(OPENCV_HEAD.sub("", text)), None)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = "" if mark is None else f" in line {mark.line + 1}"
        bad_value(f"{path}", "YAML", f"{getattr(error, 'problem', None) or 'something else'}{where}", CUT_OFF)
    if not isinstance(content, dict):
        bad_value(f"{path}", "a YAML file of named entries", type(content).__name__, CUT_OFF)
    return content


def entry(mapping: Any, key: Any, where: str) -> Any:
    """``mapping[key]``, or one sentence about what is missing.

    Raises:
        ValueError: no mapping, or no such key.
    """
    if not isinstance(mapping, dict) or key not in mapping:
        bad_value(where, f"an entry {key!r}", "none", CUT_OFF)
    return mapping[key]


def array_of(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Finite numbers as a float64 array; flat lists are brought to ``shape``.

    Args:
        value: numbers in (nested) lists.
        shape: of the result; ``(-1,)`` takes any count.
        name: for the message.

    Raises:
        ValueError: other things than finite numbers, or another count of them.
    """
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = None
    expected = "numbers" if shape == (-1,) else f"{int(np.prod(shape))} numbers"
    if numbers is None or not np.isfinite(numbers).all():
        bad_value(name, f"{expected}, all finite", repr(value)[:80], CUT_OFF)
    if shape != (-1,) and numbers.size != int(np.prod(shape)):
        bad_value(name, expected, f"{numbers.size}", CUT_OFF)
    return numbers.reshape(shape)
