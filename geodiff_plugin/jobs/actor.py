"""The prior of a job, as an actor of Ray holds it. Nothing here imports Ray."""

from __future__ import annotations

from dataclasses import replace

from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pair import run_pair
from geodiff_plugin.jobs.prior import graphs_for_many, prior_of_options
from geodiff_plugin.jobs.rows import GuidedPair, ReadPair
from geodiff_plugin.runtime.machine import pick_device


class PriorOfJob:
    """The prior that the options of a job name, for one guided call after the other."""

    def __init__(self, options: DepthOptions) -> None:
        device = pick_device(options.device)
        options = replace(options, graphs=graphs_for_many(options, device))
        self._pipe = prior_of_options(options, device)

    def guide(self, pair: ReadPair) -> GuidedPair:
        """The guided call of a pair."""
        return GuidedPair(run_pair(self._pipe, pair.options, pair.inputs, pair.log), pair.entries)
