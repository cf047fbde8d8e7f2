"""Processes that share the pairs, when started by ``accelerate launch`` or ``torchrun``.

Data flow: all pairs -> those of this process; what each process found -> all of it, in order.
Paper: none.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

import torch

__all__ = ["Processes", "join_processes"]

Entry = TypeVar("Entry")
#: The first process to be done waits for the last one.
LONGEST_WAIT = timedelta(days=30)


@dataclass(frozen=True)
class Processes:
    """Which of how many this one is.

    Attributes:
        index: of this process, from 0.
        count: of all, on all machines.
        local: index on its own machine.
    """

    index: int = 0
    count: int = 1
    local: int = 0

    def share(self, entries: Sequence[Entry]) -> Sequence[Entry]:
        """The part of this process: neighbours stay together, since a sequence is gone through in order."""
        bounds = [len(entries) * i // self.count for i in (self.index, self.index + 1)]
        return entries[bounds[0] : bounds[1]]

    def device(self, device: torch.device) -> torch.device:
        """A GPU of its own where the device names no number."""
        if device.type != "cuda" or device.index is not None:
            return device
        return torch.device("cuda", self.local % torch.cuda.device_count())

    def gather(self, entries: Sequence[Entry]) -> list[Entry]:
        """What every process gives, that of the first one first; waits for the slowest."""
        if self.count == 1:
            return list(entries)
        from accelerate.utils import gather_object

        return list(gather_object(list(entries)))


def join_processes(device: torch.device) -> Processes:
    """Meet the other processes, where there are any.

    They share nothing but the list of what became of the pairs, so gloo does for every device, and its
    patience has to last for the slowest share.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        return Processes()
    from accelerate import PartialState

    if not torch.distributed.is_initialized():
        torch.distributed.init_process_group("gloo", timeout=LONGEST_WAIT)
    state = PartialState(cpu=device.type == "cpu")
    return Processes(state.process_index, state.num_processes, state.local_process_index)
