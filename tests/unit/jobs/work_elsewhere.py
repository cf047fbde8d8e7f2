"""What tests of runners have other processes do, in a module whose imports let a process start at once."""

import os
import time

from geodiff_plugin.jobs.journal import Item
from geodiff_plugin.jobs.separate import ProcessEnded


def by_process(item: Item) -> dict:
    """Do what the payload says."""
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
