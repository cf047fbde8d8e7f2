"""Makes the result that the page opens with: ``python -m tests.browser.make_first_result``."""

from __future__ import annotations

import tempfile
import threading

import torch

from geodiff_plugin.app.job import EXAMPLES, CameraFields, Priors, request_of, run_job
from geodiff_plugin.app.page import FIRST_RESULT
from geodiff_plugin.app.shown import save, shown_of
from tests.images.rooms import room_named

#: Pixels of the first example between which the app has measured: the same as in the README's animation.
MEASURED = list(room_named("toy").clicks)

if __name__ == "__main__":
    example = EXAMPLES[0]
    calibration = example.folder / "calib.txt"
    cameras = CameraFields("file", (str(calibration),))
    request = request_of(str(example.left), str(example.right), cameras)
    with tempfile.TemporaryDirectory() as folder:
        tempfile.tempdir = folder
        priors = Priors(("bundled",), torch.device("cpu"))
        job = run_job(request, priors, threading.Event(), lambda *_: None)
        save(FIRST_RESULT, shown_of(job, request.name), MEASURED)
    print(f"{FIRST_RESULT}: {FIRST_RESULT.stat().st_size / 1e3:.0f} kB")
