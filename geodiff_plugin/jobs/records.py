"""Records of a pair on its way from its files to its folder."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from geodiff_plugin._checks import noted
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import PairInputs
from geodiff_plugin.messages import Message, distinct
from geodiff_plugin.result.output import MetricDepthOutput


@dataclass
class JobLog:
    """Wall-clock seconds of the stages of a job, in their order, and every message that they warned of."""

    seconds: dict[str, float] = field(default_factory=dict)
    warnings: list[Message] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is inside, and note what it warns of."""
        started = time.perf_counter()
        with noted() as warned:
            yield
        self.seconds[name] = time.perf_counter() - started
        self.add(warned)

    def add(self, messages: Iterable[Message]) -> None:
        """Note messages beside those of the stages, each sentence once."""
        self.warnings = list(distinct(self.warnings, messages))


@dataclass(frozen=True, eq=False)
class PairRun:
    """A pair that has been read and guided.

    ``prior`` says what ran: the pipeline's name, class, scheduler, device and dtype.
    """

    options: DepthOptions
    inputs: PairInputs
    output: MetricDepthOutput
    prior: dict[str, str]
    log: JobLog


@dataclass(frozen=True, eq=False)
class PairResult:
    """A pair whose results lie in ``folder``, with the content of its ``report.json``."""

    run: PairRun
    folder: Path
    report: dict[str, Any]
