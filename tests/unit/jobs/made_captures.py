"""A capture of three frames, with poses that are made up."""

from pathlib import Path

import numpy as np

from geodiff_plugin.cameras import Camera
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.layouts import CaptureFrame
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.pose.multiview import SolvedCapture
from tests.unit.jobs.made_runs import pose

NOTE = Finding("capture.scale", "The scale is uncertain.")
NAMES = ["f0", "f1", "f2"]
GIVEN = np.stack([pose((n, -n, 2 * n), (0.3 * n, 0.1, -0.2 * n)) for n in range(3)])
MOVED = np.stack([E @ pose((0, 0, n), (0.0, 0.03 * n, 0.04 * n)) for n, E in enumerate(GIVEN)])


def solved(**changes) -> SolvedCapture:
    rng = np.random.default_rng(2)
    seen = tuple((rng.random((n, 2)), np.arange(n)) for n in (4, 0, 3))
    values = {
        "status": "solved",
        "E": MOVED,
        "E_given": GIVEN,
        "K": np.stack([np.diag([50.0 + n, 51.0, 1.0]) for n in range(3)]),
        "connected": np.array([True, False, True]),
        "points": rng.random((5, 3)),
        "seen": seen,
        "residual_px_given": 3.14159,
        "residual_px": 0.27183,
        "scale_trajectory": 1.12345,
        "scale_depth": 0.98765,
        "scale_rel_std": 0.04321,
        "findings": (NOTE, Finding("capture.kept", "The poses are kept.")),
    }
    return SolvedCapture(**values | changes)


def write_capture(folder: Path) -> Capture:
    """Three frames, solved in the unit of their poses."""
    frames = []
    for n, name in enumerate(NAMES):
        (folder / f"{name}.png").write_text(name)
        frames.append(
            CaptureFrame(name, folder / f"{name}.png", E=GIVEN[n], camera=Camera(np.eye(3), (50 + n, 36)))
        )
    return Capture(frames, "test", None, [Finding("capture.part", "One part.")])


def options(tmp_path, **more) -> CaptureOptions:
    return CaptureOptions(**{"path": tmp_path, "out": tmp_path / "out", "device": "cpu"} | more)


def again(capture: Capture) -> Capture:
    return Capture(capture.frames, capture.kind, capture.unit, capture.findings)
