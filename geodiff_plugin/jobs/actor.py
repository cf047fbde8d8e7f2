"""Holds the prior of a job in a Ray actor. Nothing here imports Ray."""

from __future__ import annotations

from dataclasses import replace

from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pair import run_read_pair
from geodiff_plugin.jobs.prior import graphs_for_many, prior_of_options
from geodiff_plugin.jobs.records import PairRun, ReadPair
from geodiff_plugin.runtime.machine import pick_device


class PriorOfJob:
    """The prior named by the options of a job, used for many guided calls."""

    def __init__(self, options: DepthOptions) -> None:
        device = pick_device(options.device)
        options = replace(options, cuda_graphs=graphs_for_many(options, device))
        self._pipe = prior_of_options(options, device)

    def guide(self, pair: ReadPair) -> PairRun:
        """Make the guided call of a pair."""
        return run_read_pair(self._pipe, pair)
