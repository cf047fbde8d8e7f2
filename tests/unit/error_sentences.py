"""Contents of every input error, in order."""

from collections.abc import Callable
from typing import Any

import pytest

from geodiff_plugin import InputError


def check_error(call: Callable[[], Any], name: str, expected: str, found: str, hint: str = "") -> None:
    """A call ends in ``<name> must be <expected>; got <found>. <hint>``; each part may go on."""
    with pytest.raises(InputError) as error:
        call()
    text = str(error.value)
    before, _, after = text.partition("; got ")
    assert before.startswith(f"{name} must be {expected}"), text
    assert after.startswith(found) and hint in after.removeprefix(found), text
