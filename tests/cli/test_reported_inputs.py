"""Small inputs made from public bug reports, each with the commands of a user and their ground truth."""

import json
import shlex
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from tests.cli.conftest import call

INPUTS = Path(__file__).resolve().parents[3] / "shared" / "data" / "inputs5"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not INPUTS.is_dir(), reason="the inputs are not there"),
    pytest.mark.usefixtures("one_prior"),
]
#: Step in pixels between the samples of ground truth.
EVERY = 4
#: Maximum fraction of the samples outside of the image's content that have a depth.
MAX_OUTSIDE = 0.01


class Expected(NamedTuple):
    """What a command gives: an exit code and a text in its output, or a verdict and an error of its depth."""

    text: str = ""
    status: str = "trusted"
    abs_rel: float | None = None  # maximum mean relative error inside
    code: int = 0
    frames: int = 0  # of a capture, all with poses and as trusted as ``status``


def rejected(text: str) -> Expected:
    """A command that stops with a message."""
    return Expected(text, code=2)


#: For every line of the commands of each input.
CASES = {
    "black_borders": [Expected(abs_rel=0.039)],
    "capture_osd": [Expected("stays the same while the camera moves", frames=8)],
    "endoscope_mask": [Expected(abs_rel=0.051)],
    "exif_stale_focal_plane": [
        rejected("EXIF is outdated if an editor resized or cropped the image: pass --K or --fov"),
        Expected(abs_rel=0.079),
    ],
    "focal_in_mm": [
        rejected("If fx is in millimetres, multiply it by image width / sensor width"),
        Expected("field of view", status="not trusted"),
    ],
    "half_sbs": [Expected("half", abs_rel=0.052), Expected("half", abs_rel=0.052)],
    "matrix_text_forms": [
        rejected("If it is a projection P = K [I | t], its first three columns are K"),
        Expected(abs_rel=0.055),
        Expected(abs_rel=0.055),
        Expected(status="not trusted"),
    ],
    "repeated_tiles": [Expected(status="not trusted")],
    "ros_binning": [Expected(abs_rel=0.048)],
    "stereo_microscope": [
        rejected("If it is in millimetres, confirm it with --baseline 0.000482503"),
        Expected(status="not trusted", abs_rel=0.028),
        Expected(abs_rel=0.028),
    ],
    "vfr_video": [Expected(frames=12)],
}


def commands(case: str) -> list[str]:
    """The lines of a case's commands."""
    lines = (INPUTS / case / "cmd").read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def samples(case: str, out: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth and ground truth at samples, and whether each shows the scene."""
    ground_truth = np.load(INPUTS / case / "truth.npy").astype(float)
    height, width = ground_truth.shape
    depth = np.load(out / "depth.npy")[::EVERY, ::EVERY][:height, :width]
    mask = INPUTS / case / "inside.npy"
    return depth, ground_truth, np.load(mask) if mask.is_file() else np.ones(ground_truth.shape, bool)


def check_depth(case: str, out: Path, max_abs_rel: float) -> None:
    """The error of known depths inside is small, and nothing outside has a depth."""
    depth, ground_truth, inside = samples(case, out)
    known = inside & (depth > 0) & (ground_truth > 0)
    assert np.abs(depth[known] / ground_truth[known] - 1).mean() <= max_abs_rel
    assert (depth[inside] > 0).mean() > 0.95
    assert (depth[~inside] > 0).sum() <= MAX_OUTSIDE * (~inside).sum()


def check_capture(out: Path, expected: Expected) -> None:
    """Every frame of a capture has a pose and the expected verdict."""
    capture = json.loads((out / "capture.json").read_text())
    assert len(capture["frames"]) == expected.frames and not capture["failed"]
    assert all(frame["connected"] for frame in capture["poses"]["frames"].values())
    assert {frame["verdict"]["status"] for frame in capture["frames"]} == {expected.status}


@pytest.mark.parametrize(
    ("case", "number"), [(case, number) for case, lines in CASES.items() for number in range(len(lines))]
)
@pytest.mark.filterwarnings("ignore")
def test_a_reported_input_is_right_or_rejected_with_its_cause(case, number, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(INPUTS / case)
    out, expected = tmp_path / "out", CASES[case][number]
    assert len(commands(case)) == len(CASES[case])
    words = [str(out) if word == "OUT" else word for word in shlex.split(commands(case)[number])][1:]
    assert call(words) == expected.code
    shown = capsys.readouterr()
    assert expected.text in " ".join((shown.out + shown.err).split())
    if expected.frames:
        check_capture(out, expected)
    elif not expected.code:
        report = json.loads((out / "report.json").read_text())
        assert report["verdict"]["status"] == expected.status
        if expected.abs_rel is not None:
            check_depth(case, out, expected.abs_rel)
