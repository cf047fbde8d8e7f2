"""Small inputs in public formats, each with the command of a user, compared with their ground truth."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

INPUTS = Path(__file__).resolve().parents[3] / "shared" / "data" / "inputs"
TRUTH = INPUTS / "_truth"
#: The frame's best neighbour is the one without a pose, so its depth is no longer trusted.
UNSURE = ("10o_one_null_pose",)
#: Centimetres that nothing names.
DOUBTED_UNIT = "p13_opencv_cm"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not TRUTH.is_dir(), reason="the inputs are not there"),
    pytest.mark.usefixtures("one_prior"),
]
CASES = sorted(path.name for path in INPUTS.glob("*") if path.name[0] != "_") if TRUTH.is_dir() else []
#: Commands of the inputs that work as they are, next to which the others were made.
TWINS = {
    "00_base_tj": "capture .",
    "00_base_colmap": "capture . --metres-per-unit 1",
    "b_base_rgb8": "depth drive.mcap --left-topic /left/image_rect --right-topic /right/image_rect "
    "--out o.mcap",
    "p00_base": "depth left.jpg right.jpg CAMERAS",
}
#: The frame that gets depth, by its number; the poses are those of all.
FRAME, TRUTH_OF_FRAME = 1, "frame_0104.png"
#: Mean relative errors: by two views with the small prior, and by known depths of half the pixels.
BY_VIEWS, BY_DEPTHS = 0.2, 0.05


#: Options that the recorded commands call by an earlier name.
RENAMED = {"--left": "--left-topic", "--right": "--right-topic"}


def typed(case: str) -> list[str]:
    """The words of a case's command, behind ``geodiff``."""
    readme = INPUTS / case / "README"
    text = TWINS.get(case) or re.search(r"command \(in this folder\): geodiff (.*)", readme.read_text())[1]
    if "p14" in text or "CAMERAS" in text:
        cameras = typed("p14_mpo")[2:]
        text = re.sub(r"\(cameras as p14\)|CAMERAS", shlex.join(cameras), text)
    return [RENAMED.get(word, word) for word in shlex.split(text)]


def mean_error(depth: np.ndarray, truth_file: str) -> float:
    """Mean relative error on the grid of ground truth, where that is known."""
    ground_truth = np.asarray(Image.open(TRUTH / truth_file)).astype(float) / 1000
    at = [
        ((np.arange(n) + 0.5) * m / n).astype(int)
        for n, m in zip(ground_truth.shape, depth.shape, strict=True)
    ]
    there = ground_truth > 0
    return float(np.abs(depth[np.ix_(*at)][there] / ground_truth[there] - 1).mean())


def depth_of_bag(path: Path) -> np.ndarray:
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        images = [c for c in reader.connections if c.topic == "/depth/image"]
        connection, _, raw = next(reader.messages(images))
        message = reader.deserialize(raw, connection.msgtype)
    return message.data.view("<u2").reshape(message.height, message.width) / 1000


@pytest.mark.parametrize("case", CASES)
def test_a_public_input_is_correct_or_rejected_with_a_clear_error(case, geodiff, tmp_path, monkeypatch):
    if case.startswith("b_"):
        pytest.importorskip("rosbags")
    monkeypatch.chdir(INPUTS / case)
    words, out = typed(case), tmp_path / ("o.mcap" if case.startswith("b_") else "out")
    words = words[: words.index("--out")] if "--out" in words else words
    if words[0] == "capture":
        pytest.importorskip("pycolmap")
        words += ["--frames", f"{FRAME}:{FRAME}", "--processes", "1"]
    words += [] if case in TWINS else ["--steps", "1"]
    answer = geodiff(*words, "--out", out, "-q")
    if case == "d_negative_npy":
        assert answer.code == 2 and "right minus left" in answer.err and "-disparity" in answer.err
        return
    assert answer.code == 0, answer.err
    if words[0] == "capture":
        report = json.loads((out / "capture.json").read_text())
        (frame,) = report["frames"]
        depth, verdict, ground_truth = (
            np.load(out / frame["frame"] / "depth.npy"),
            frame["verdict"],
            TRUTH_OF_FRAME,
        )
    elif case.startswith("b_"):
        depth, verdict, ground_truth = depth_of_bag(out), None, "pair.png"
    else:
        verdict = json.loads((out / "report.json").read_text())["verdict"]
        depth, ground_truth = np.load(out / "depth.npy"), "pair.png"
    error = mean_error(depth, ground_truth)
    if case == DOUBTED_UNIT:
        assert verdict["status"] != "trusted" and error > 10
        return
    assert error < (BY_DEPTHS if "depth" in words[1:] else BY_VIEWS), error
    assert verdict is None or verdict["status"] == "trusted" or case in UNSURE, verdict
