"""A function in the place of a method of one instance, for a while.

Data flow: instance, method, function -> the instance with it -> as it was.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

__all__ = ["hide_method"]


def hide_method(owner: Any, name: str, function: Callable[..., Any]) -> Callable[[], None]:
    """Hide a method by an attribute of the instance.

    Args:
        owner: the instance.
        name: of the method.
        function: what takes its place.

    Returns:
        What puts back the method, or what the user or another hook had put there.
    """
    before = vars(owner).get(name)
    setattr(owner, name, function)

    def restore() -> None:
        if before is None:
            delattr(owner, name)
        else:
            setattr(owner, name, before)

    return restore
