"""What a command does with one pair, many pairs or a capture, as functions: read, run, write.

>>> options = DepthOptions(left=Path("left.png"), right=Path("right.png"), calib=(Path("calib.txt"),))
>>> depth_pair(options).report["depth"]["median_m"]

The command line and the page are thin layers on these. Names are imported on first use: options and what is
wrong with them are there without torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from geodiff_plugin._lazy import importer, modules_of

if TYPE_CHECKING:
    from geodiff_plugin.jobs.capture import depth_capture as depth_capture
    from geodiff_plugin.jobs.many import depth_pairs as depth_pairs
    from geodiff_plugin.jobs.merge import merge_shards as merge_shards
    from geodiff_plugin.jobs.options import CaptureOptions as CaptureOptions
    from geodiff_plugin.jobs.options import DepthOptions as DepthOptions
    from geodiff_plugin.jobs.pair import depth_pair as depth_pair
    from geodiff_plugin.jobs.pair import run_pair as run_pair
    from geodiff_plugin.jobs.pairs import PairRef as PairRef
    from geodiff_plugin.jobs.pairs import start_many as start_many
    from geodiff_plugin.jobs.prior import load_guided_prior as load_guided_prior
    from geodiff_plugin.jobs.reading import PairInputs as PairInputs
    from geodiff_plugin.jobs.reading import read_pair as read_pair
    from geodiff_plugin.jobs.records import JobLog as JobLog
    from geodiff_plugin.jobs.records import PairResult as PairResult
    from geodiff_plugin.jobs.records import PairRun as PairRun
    from geodiff_plugin.jobs.writing import write_pair as write_pair

_NAMES_OF = {
    "capture": ("depth_capture",),
    "many": ("depth_pairs",),
    "merge": ("merge_shards",),
    "options": ("CaptureOptions", "DepthOptions"),
    "pair": ("depth_pair", "run_pair"),
    "pairs": ("PairRef", "start_many"),
    "prior": ("load_guided_prior",),
    "reading": ("PairInputs", "read_pair"),
    "records": ("JobLog", "PairResult", "PairRun"),
    "writing": ("write_pair",),
}
_MODULE_OF = modules_of(__name__, _NAMES_OF)
__all__ = sorted(_MODULE_OF)
__getattr__ = importer(__name__, _MODULE_OF)


def __dir__() -> list[str]:
    return sorted(__all__)
