"""Makes the result that the page opens with: ``python -m tests.browser.make_first_result``."""

from __future__ import annotations

import tempfile
import threading

import torch

from geodiff_plugin.app.form import EXAMPLES
from geodiff_plugin.app.job import CameraFields, Priors, options_of, run_job
from geodiff_plugin.app.page import FIRST_RESULT
from geodiff_plugin.app.shown import save, shown_of

#: Pixels of the first example between which the page has measured: the two ends of the toy's table.
MEASURED = [(290, 288), (400, 292)]

if __name__ == "__main__":
    example = EXAMPLES[0]
    right, calibration = example.folder / f"right.{example.ending}", example.folder / "calib.txt"
    options = options_of(str(example.left), str(right), CameraFields("file", (str(calibration),)))
    with tempfile.TemporaryDirectory() as folder:
        tempfile.tempdir = folder
        priors = Priors(("bundled",), torch.device("cpu"))
        result = run_job(options, priors, threading.Event(), lambda *_: None)
        save(FIRST_RESULT, shown_of(result), MEASURED)
    print(f"{FIRST_RESULT}: {FIRST_RESULT.stat().st_size / 1e3:.0f} kB")
