"""Runs methods on samples as the commands of the evaluation do."""

from pathlib import Path
from types import SimpleNamespace

from geodiff_plugin.evaluation.experiment import measure_cells, method_cells


def run(refs, methods, settings, out, *, skip_broken=False, **keywords):
    """Records of every method on every sample; keywords as of ``method_cells``."""
    options = SimpleNamespace(out=Path(out), quiet=True, skip_broken=skip_broken)
    return measure_cells(method_cells(refs, methods, settings, Path(out), **keywords), options)
