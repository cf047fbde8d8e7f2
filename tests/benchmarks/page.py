"""Peak memory of the web app's process while it runs one pair, and size of its archive, by image size.

python -m tests.benchmarks.page --megapixels 4,12,16

A bundled real pair is scaled to each size and run like a visitor's pair, in its own process. Photos with
sensor noise and lens distortion have the largest archive, so the images get noise, and the calibration states
a distortion.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

MIB = 1024
#: Standard deviation of the noise per pixel and channel, of 255, as in an indoor photo of a phone.
NOISE = 4.0
#: Coefficients of the lenses, so small that they change nothing visible.
DISTORTION = [1e-3, 0.0, 0.0, 0.0, 0.0]
#: The fields of a run that a visitor leaves alone.
RUN = {"prior": "bundled", "ensemble": 1, "seed": 0, "preset": "default"}


def write_pair(folder: Path, megapixels: float) -> tuple[str, str, str]:
    """Write a pair of this size and its calibration; return the paths of left and right image and of it."""
    import numpy as np
    from PIL import Image

    from geodiff_plugin import read_calibration
    from geodiff_plugin.bundled.demo_pair import REAL_PAIRS_FOLDER

    source, rng = REAL_PAIRS_FOLDER / "toy", np.random.default_rng(0)
    rig = read_calibration(source / "calib.txt")
    calibration = {"R": np.eye(3).tolist(), "T": (-rig.E[:3, 3]).tolist()}
    for number, (side, K) in enumerate((("left", rig.K_left), ("right", rig.K_right)), 1):
        image = Image.open(source / f"{side}.png").convert("RGB")
        factor = (megapixels * 1e6 / (image.width * image.height)) ** 0.5
        scaled = np.asarray(image.resize((round(factor * image.width), round(factor * image.height))))
        noise = rng.standard_normal(scaled.shape, np.float32) * NOISE
        noisy = np.rint(scaled + noise).clip(0, 255).astype(np.uint8)
        Image.fromarray(noisy).save(folder / f"{side}.png", compress_level=1)
        K = np.array(K)
        K[:2, :2] *= factor
        K[:2, 2] = factor * (K[:2, 2] + 0.5) - 0.5
        calibration |= {f"K{number}": K.tolist(), f"D{number}": DISTORTION}
    (folder / "calib.json").write_text(json.dumps(calibration))
    left, right, calib = (str(folder / name) for name in ("left.png", "right.png", "calib.json"))
    return left, right, calib


def archived(shown: Any, folder: Path) -> dict[str, float]:
    """Return the size in MB of the archive of a result's files, and of each file in it."""
    from geodiff_plugin.app.results import files_of
    from geodiff_plugin.app.sessions import Result

    archive = files_of(Result(replace(shown, folder=folder)))[0]
    with ZipFile(archive) as zipped:
        sizes = {entry.filename: entry.compress_size / 1e6 for entry in zipped.infolist()}
    return {archive.name: archive.stat().st_size / 1e6, **sizes}


def run_one(megapixels: float) -> dict[str, Any]:
    """Peak resident memory, MiB, of this process with the prior alone and after one run; sizes of its files.

    This changes the folder for temporary files.
    """
    import torch

    from geodiff_plugin.app import page
    from geodiff_plugin.app.job import CameraFields, Priors, request_of, run_job, write_job
    from geodiff_plugin.app.sessions import Result
    from geodiff_plugin.app.shown import clean_report, shown_of

    folder = Path(tempfile.mkdtemp())
    tempfile.tempdir = str(folder)
    left, right, calib = write_pair(folder, megapixels)
    priors = Priors(("bundled",), torch.device("cpu"))
    priors.get("bundled")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MIB
    request = request_of(left, right, CameraFields("file", (calib,)), **RUN)
    job = run_job(request, priors, threading.Event(), lambda fraction, stage: None)
    shown = shown_of(job, request.name)
    list(page.drawn(Result(shown)))
    written = clean_report(write_job(job))
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MIB
    measured = {"megapixels": shown.depth_m.size / 1e6, "prior_mib": before, "peak_mib": after}
    return measured | {"archive_mb": archived(shown, written)}


def main() -> None:
    """Print a line for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megapixels", default="4,12,16", help="sizes in megapixels, separated by commas")
    parser.add_argument("--one", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one is not None:
        print(json.dumps(run_one(args.one)))
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
        sizes = ", ".join(f"{name} {size:.1f}" for name, size in measured["archive_mb"].items())
        print(f"      MB: {sizes}", flush=True)


if __name__ == "__main__":
    main()
