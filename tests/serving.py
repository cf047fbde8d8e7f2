"""A program that serves a page, for the length of a test, and files for a visitor of it."""

import os
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

from tests.tiny import plane_pair

STARTS_S = 600


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def write_plane(folder: Path, baseline_m: float = 0.12) -> tuple[Path, Path, Path, np.ndarray]:
    """Images of a tilted plane 12 cm apart, a calibration that is correct or not, and the true depth."""
    pair = plane_pair(size=(96, 128), focal=120.0, baseline=0.12)
    left, right, calibration = (folder / name for name in ("left.png", "right.png", "K.txt"))
    Image.fromarray(pair.left).save(left)
    Image.fromarray(pair.right).save(right)
    numbers = " ".join(f"{value:g}" for value in pair.K.ravel())
    calibration.write_text(f"{numbers}\n{baseline_m}\n")
    return left, right, calibration, pair.depth_m


@contextmanager
def served(
    command: Sequence[str],
    port: int,
    folder: Path,
    environment: Mapping[str, str] | None = None,
    cwd: Path | None = None,
) -> Iterator[str]:
    """The address of a server of gradio once it answers; its log and temporary files lie in ``folder``."""
    own = {"GRADIO_TEMP_DIR": str(folder / "gradio"), "TMPDIR": str(folder), **(environment or {})}
    path = folder / "log.txt"
    with path.open("w") as log:
        process = subprocess.Popen(
            command, cwd=cwd, env=os.environ | own, stdout=log, stderr=subprocess.STDOUT
        )
        try:
            url, end = f"http://127.0.0.1:{port}/", time.monotonic() + STARTS_S
            while True:
                assert process.poll() is None and time.monotonic() < end, path.read_text()
                try:
                    urllib.request.urlopen(url, timeout=5).close()
                    break
                except OSError:
                    time.sleep(0.3)
            yield url
        finally:
            process.kill()  # it keeps nothing that a kinder end would save
            process.wait()
