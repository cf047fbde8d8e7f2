"""Runs the commands as functions: reads, processes and writes one pair, many pairs or a capture.

>>> options = DepthOptions(left=Path("left.png"), right=Path("right.png"), calib=(Path("calib.txt"),))
>>> depth_pair(options).report["depth"]["median_m"]

What belongs here:
    - Options of the two commands: ``options``, and the sources of cameras (``camera_sources``).
    - One pair: ``pair`` reads it (``reading``, ``cameras``, ``known``, ``rectified``), loads the prior
      (``prior``), makes the guided call and writes the folder (``writing``, ``report``). ``records`` defines
      the records passed on: ``PairInputs``, ``ReadPair``, ``PairRun``, ``PairResult``.
    - Many pairs: ``pairs`` finds them, ``many`` takes them through four stages, ``finished`` recognises
      results of an earlier run, and ``tables`` writes ``pairs.csv``. ``bag`` and ``smoothing`` handle bags
      and videos.
    - Frames of cameras as they arrive: ``live``, based on the package ``streaming``.
    - A capture: ``capture`` is the job, with ``capture_poses``, ``capture_frame`` and ``capture_frames``;
      ``lengths`` has known and measured lengths, ``provenance`` records the inputs of finished frames.
    - The engine: ``runner`` takes items through stages and resumes by a ``journal``; ``failures`` reports
      each cause once; ``processes`` are workers on this machine. ``cluster`` runs jobs on many machines with
      Ray: ``ray`` (with ``actor`` and ``rows``) is the dataset of pairs, ``parquet`` stores its results.
    - Videos and benchmark files from finished results: ``results``.
    - Shared by all commands: messages to the user (``notices``), SIGTERM (``stopping``), out-of-memory errors
      (``memory``).

A job returns records and reports to a ``notify`` callback. It prints nothing and never exits the program.

Layer 10: imports ``capture``, ``streaming`` and below; ``evaluation``, ``app`` and ``cli`` import the names
listed here. Options and their errors need no torch.

To add a job, write its options as a dataclass of settings, a function that takes them, and a ``Runner`` with
a function from an ``Item`` to its ``Record``: it then resumes, shards, reports failures and runs on Ray. To
add a file to the results of a pair, write it in ``writing.write_maps``; the report lists it automatically.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from geodiff_plugin._internal.lazy import declared, importer

if TYPE_CHECKING:  # public names; imported on first use at run time, because some need torch
    from geodiff_plugin.jobs.bag import depth_bag as depth_bag
    from geodiff_plugin.jobs.capture import depth_capture as depth_capture
    from geodiff_plugin.jobs.finished import Row as Row
    from geodiff_plugin.jobs.journal import BROKEN as BROKEN
    from geodiff_plugin.jobs.journal import Item as Item
    from geodiff_plugin.jobs.journal import Journal as Journal
    from geodiff_plugin.jobs.journal import Record as Record
    from geodiff_plugin.jobs.journal import Shard as Shard
    from geodiff_plugin.jobs.journal import fingerprint as fingerprint
    from geodiff_plugin.jobs.lengths import measured_words as measured_words
    from geodiff_plugin.jobs.live import LiveMeter as LiveMeter
    from geodiff_plugin.jobs.live import LiveResult as LiveResult
    from geodiff_plugin.jobs.live import live_results as live_results
    from geodiff_plugin.jobs.many import depth_pairs as depth_pairs
    from geodiff_plugin.jobs.memory import MEMORY_HINT as MEMORY_HINT
    from geodiff_plugin.jobs.memory import is_out_of_memory as is_out_of_memory
    from geodiff_plugin.jobs.notices import Notify as Notify
    from geodiff_plugin.jobs.notices import collected_warnings as collected_warnings
    from geodiff_plugin.jobs.notices import say as say
    from geodiff_plugin.jobs.notices import silent as silent
    from geodiff_plugin.jobs.options import CaptureOptions as CaptureOptions
    from geodiff_plugin.jobs.options import DepthOptions as DepthOptions
    from geodiff_plugin.jobs.options import LiveOptions as LiveOptions
    from geodiff_plugin.jobs.options import start_pair as start_pair
    from geodiff_plugin.jobs.options import with_folder as with_folder
    from geodiff_plugin.jobs.pair import depth_pair as depth_pair
    from geodiff_plugin.jobs.pair import run_pair as run_pair
    from geodiff_plugin.jobs.pairs import PairRef as PairRef
    from geodiff_plugin.jobs.pairs import is_many as is_many
    from geodiff_plugin.jobs.pairs import start_many as start_many
    from geodiff_plugin.jobs.prior import load_guided_prior as load_guided_prior
    from geodiff_plugin.jobs.prior import prior_of_options as prior_of_options
    from geodiff_plugin.jobs.reading import read_pair as read_pair
    from geodiff_plugin.jobs.records import JobLog as JobLog
    from geodiff_plugin.jobs.records import PairInputs as PairInputs
    from geodiff_plugin.jobs.records import PairResult as PairResult
    from geodiff_plugin.jobs.records import PairRun as PairRun
    from geodiff_plugin.jobs.report import depth_range_words as depth_range_words
    from geodiff_plugin.jobs.report import limit_words as limit_words
    from geodiff_plugin.jobs.report import measurable_limit as measurable_limit
    from geodiff_plugin.jobs.report import measured_depth as measured_depth
    from geodiff_plugin.jobs.report import output_summary as output_summary
    from geodiff_plugin.jobs.report import report_text as report_text
    from geodiff_plugin.jobs.report import single_map as single_map
    from geodiff_plugin.jobs.report import summary_line as summary_line
    from geodiff_plugin.jobs.results import BENCHMARKS as BENCHMARKS
    from geodiff_plugin.jobs.results import write_submission as write_submission
    from geodiff_plugin.jobs.results import write_video as write_video
    from geodiff_plugin.jobs.runner import Runner as Runner
    from geodiff_plugin.jobs.runner import on_ray as on_ray
    from geodiff_plugin.jobs.stopping import Terminated as Terminated
    from geodiff_plugin.jobs.stopping import ending_on_sigterm as ending_on_sigterm
    from geodiff_plugin.jobs.tables import merge_shards as merge_shards
    from geodiff_plugin.jobs.writing import cameras_of as cameras_of
    from geodiff_plugin.jobs.writing import figure_range as figure_range
    from geodiff_plugin.jobs.writing import write_pair as write_pair

_MODULE_OF = declared(__name__)
__all__ = sorted(_MODULE_OF)
__getattr__ = importer(__name__, _MODULE_OF)


def __dir__() -> list[str]:
    return sorted(__all__)
