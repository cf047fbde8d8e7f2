"""Peak memory of the web app's process while it runs one pair, by image size.

python -m tests.benchmarks.page --megapixels 4,16

A bundled real pair is scaled to each size and run like a visitor's pair, in its own process.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

MIB = 1024
#: The fields of a run that a visitor leaves alone.
RUN = {"prior": "bundled", "ensemble": 1, "seed": 0, "preset": "default"}


def _run_one(megapixels: float) -> dict[str, float]:
    """Peak resident memory, MiB, of this process: with the prior alone, and after one run."""
    import torch
    from PIL import Image

    from geodiff_plugin import read_calibration
    from geodiff_plugin.app import page
    from geodiff_plugin.app.job import CameraFields, Priors, request_of, run_job, write_job
    from geodiff_plugin.app.sessions import Result
    from geodiff_plugin.app.shown import clean_report, shown_of
    from geodiff_plugin.bundled.demo_pair import REAL_PAIRS_FOLDER

    folder, source = Path(tempfile.mkdtemp()), REAL_PAIRS_FOLDER / "toy"
    tempfile.tempdir = str(folder)
    images = {side: Image.open(source / f"{side}.png").convert("RGB") for side in ("left", "right")}
    width, height = images["left"].size
    factor = (megapixels * 1e6 / (width * height)) ** 0.5
    for side, image in images.items():
        image.resize((round(factor * width), round(factor * height))).save(folder / f"{side}.png")
    rig = read_calibration(source / "calib.txt")
    (fx, _, cx), (_, fy, cy), _ = (row.tolist() for row in rig.K_left)
    lens = {"fx": factor * fx, "fy": factor * fy}
    lens |= {name: factor * (c + 0.5) - 0.5 for name, c in (("cx", cx), ("cy", cy))}
    priors = Priors(("bundled",), torch.device("cpu"))
    priors.get("bundled")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MIB
    left, right = (str(folder / f"{side}.png") for side in images)
    cameras = CameraFields("numbers", lens=lens, baseline=float(rig.E[0, 3]))
    request = request_of(left, right, cameras, **RUN)
    job = run_job(request, priors, threading.Event(), lambda fraction, stage: None)
    shown = shown_of(job, request.name)
    list(page.drawn(Result(shown)))
    clean_report(write_job(job))
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MIB
    return {"megapixels": shown.depth_m.size / 1e6, "prior_mib": before, "peak_mib": after}


def main() -> None:
    """Print a line for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megapixels", default="4,16", help="sizes in megapixels, separated by commas")
    parser.add_argument("--one", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one is not None:
        print(json.dumps(_run_one(args.one)))
        return
    for size in args.megapixels.split(","):
        command = [sys.executable, "-m", "tests.benchmarks.page", "--one", size]
        answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        measured = json.loads(answer.splitlines()[-1])
        print(
            f"{measured['megapixels']:5.1f} megapixels: {measured['peak_mib']:.0f} MiB, "
            f"{measured['prior_mib']:.0f} MiB before the run",
            flush=True,
        )


if __name__ == "__main__":
    main()
