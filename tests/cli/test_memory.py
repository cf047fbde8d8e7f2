"""Images of 12 and of 48 megapixels: what they need, and one sentence where they do not fit the memory."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

resource = pytest.importorskip("resource")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="other systems limit no address space"),
]
GIB = 1 << 30
#: A pair of 48 megapixels needed 10.3 GB.
MAX_BYTES = 12 * GIB


def write_pair(folder: Path, width: int, height: int) -> list[str]:
    """A painted wall, seen by two cameras side by side; the words of the command."""
    rng, shift = np.random.default_rng(0), width // 100
    paint = rng.integers(0, 255, (height // 16, width // 16 + 1, 3), dtype=np.uint8)
    wall = cv2.resize(paint, (width + shift, height), interpolation=cv2.INTER_CUBIC)
    for name, start in (("l.jpg", 0), ("r.jpg", shift)):
        Image.fromarray(wall[:, start : start + width]).save(folder / name, quality=90)
    views = [str(folder / "l.jpg"), str(folder / "r.jpg")]
    cameras = ["--fx", str(width), "--baseline", "0.1", "--steps", "1", "--device", "cpu"]
    return [
        sys.executable,
        "-m",
        "geodiff_plugin",
        "depth",
        *views,
        *cameras,
        "--out",
        str(folder / "out"),
        "-q",
    ]


@pytest.mark.parametrize("gib", [3, 4])
def test_twelve_megapixels_that_do_not_fit_are_one_sentence(gib, tmp_path):
    command = write_pair(tmp_path, 4000, 3000)

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (gib * GIB, gib * GIB))

    done = subprocess.run(command, preexec_fn=limit, capture_output=True, text=True)  # noqa: PLW1509
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    (said,) = (line for line in done.stderr.splitlines() if line.startswith("geodiff:"))
    assert "of 4000x3000 pixels (12.0 megapixels) does not fit in memory. Downscale the images" in said
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_forty_eight_megapixels_need_a_bounded_memory(tmp_path):
    command = write_pair(tmp_path, 8000, 6000)
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        said = process.stderr.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, said
    assert used.ru_maxrss * 1024 < MAX_BYTES
    depth = np.load(tmp_path / "out/depth.npy", mmap_mode="r")
    assert depth.shape == (6000, 8000) and np.isfinite(depth[::100, ::100]).all()
