"""What tests of runners and processes have others do; its imports let a process start at once."""

import errno
import os
import time

from geodiff_plugin._internal.checks import warn
from geodiff_plugin.findings import Finding
from geodiff_plugin.jobs.failures import full_disk
from geodiff_plugin.jobs.journal import Item
from geodiff_plugin.jobs.processes import ProcessEnded


def by_process(item: Item) -> dict:
    """Execute the payload."""
    if item.payload == "sleeps":
        time.sleep(600)
    if item.payload == "defect":
        raise KeyError(item.key)
    if item.payload == "fails":
        raise ValueError(f"{item.key} has no camera")
    if item.payload == "kills":
        os._exit(7)
    if item.payload == "cannot":
        raise ProcessEnded("It cannot begin.")
    return {"by": os.getpid()}


def fails_in_its_own_way(full: bool) -> None:
    class Odd(Exception):
        def __init__(self, one, two):
            super().__init__(f"{one}{two}")

    if full:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError as error:
            raise full_disk(error) from None
    raise Odd("no", "body")


def warns(where: str) -> str:
    warn(Finding("camera.assumed-intrinsics", f"cy is assumed in {where}."))
    print("a library prints")
    return where


def wait_for(path: str) -> int:
    """The process's number, once another process has made the file."""
    until = time.monotonic() + 60
    while not os.path.exists(path):
        assert time.monotonic() < until
        time.sleep(0.01)
    return os.getpid()


def make_and_wait(made: str, awaited: str) -> int:
    open(made, "w").close()
    return wait_for(awaited)


def clears_away(began: str, cleared: str) -> None:
    open(began, "w").close()
    try:
        time.sleep(600)
    finally:
        open(cleared, "w").close()


def cannot_begin() -> None:
    raise ProcessEnded("It cannot begin.")
