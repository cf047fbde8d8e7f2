"""Two videos of a rig: which frames are pairs, and what is reported about their offset."""

import re

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs.videos import pair_videos
from tests.unit.formats.test_synchronization import seen
from tests.videos import write_video

TIMES = np.arange(60) / 25


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    """A left video, and right ones that start together with it, later, and with less frames."""
    folder = tmp_path_factory.mktemp("videos")
    starts = {"left": 0.0, "right": 0.0, "late": 0.4}
    for name, start in starts.items():
        frames = [seen(3.0 + start + t, 0.0 if name == "left" else 4.0) for t in TIMES]
        write_video(folder / f"{name}.mp4", frames, TIMES)
    write_video(folder / "short.mp4", [seen(3.0 + t, 4.0) for t in TIMES[:50]], TIMES[:50])
    write_video(folder / "still.mp4", [seen(3.0)] * 50, TIMES[:50])
    return folder


def test_videos_that_start_together_are_paired_in_silence(videos):
    pairs, findings = pair_videos(videos / "left.mp4", videos / "right.mp4", None)
    assert pairs == [(n, n) for n in range(60)] and findings == ()


def test_an_estimated_offset_is_reported_as_an_assumption(videos):
    pairs, (finding,) = pair_videos(videos / "left.mp4", videos / "late.mp4", None)
    assert finding.code == "pairs.offset" and "LEFT has 60 frames and RIGHT 60, of which 50 are" in finding
    assert float(re.search(r"start (0.\d+) s after LEFT", finding)[1]) == pytest.approx(0.4, abs=0.02)
    assert pairs == [(n, n - 10) for n in range(10, 60)]
    backwards, (finding,) = pair_videos(videos / "late.mp4", videos / "left.mp4", None)
    assert "s before LEFT" in finding and backwards == [(n, n + 10) for n in range(50)]
    shorter, (finding,) = pair_videos(videos / "left.mp4", videos / "short.mp4", None)
    assert "start together with LEFT" in finding and shorter == [(n, n) for n in range(50)]


def test_a_given_offset_is_used_as_it_is(videos):
    for offset_s in (0.4, 0.41):
        pairs, findings = pair_videos(videos / "left.mp4", videos / "late.mp4", offset_s)
        assert pairs == [(n, n - 10) for n in range(10, 60)] and findings == ()
    with pytest.raises(
        InputError, match=r"--offset must be an offset at which .*; got 30, with videos of 2.36 s"
    ):
        pair_videos(videos / "left.mp4", videos / "late.mp4", 30.0)


def test_videos_of_unequal_length_without_motion_need_an_offset(videos):
    with pytest.raises(InputError, match="LEFT has 60 frames and RIGHT 50, and their brightness .*--offset"):
        pair_videos(videos / "left.mp4", videos / "still.mp4", None)
