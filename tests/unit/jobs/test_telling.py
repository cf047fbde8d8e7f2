"""Lines for the user: control characters are written out, and warnings of this package are told once."""

import sys
import types
import warnings

import pytest

from geodiff_plugin import _checks
from geodiff_plugin.jobs.telling import collected_warnings, say, silent
from geodiff_plugin.messages import Message


@pytest.mark.parametrize("bar", [True, False])
def test_no_name_commands_the_terminal(capsys, monkeypatch, bar):
    if not bar:
        monkeypatch.delitem(sys.modules, "tqdm", raising=False)
    else:
        import tqdm  # noqa: F401
    say("a\x1b[31mb\tc\nd\x7f\x00\x9fé")
    assert capsys.readouterr() == ("", "a\\x1b[31mb\tc\nd\\x7f\\x00\\x9fé\n")
    silent("nothing")
    assert capsys.readouterr() == ("", "")


def test_a_warning_of_this_package_is_a_line_once_and_those_of_others_are_shown_as_usual():
    told, before = [], warnings.showwarning
    message = Message("camera.filled-in", "cy is assumed.")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with collected_warnings(told.append):
            for _ in range(2):
                _checks.warn(message, stacklevel=0)
                warnings.warn("of a test", stacklevel=1)
            _checks.warn(Message("camera.filled-in", "cx is assumed."), stacklevel=0)
    assert told == ["warning: cy is assumed.", "warning: cx is assumed."]
    assert [str(each.message) for each in caught] == ["of a test"] * 2
    assert warnings.showwarning is before


def test_views_of_videos_are_opened_once_and_closed(monkeypatch):
    from pathlib import Path

    from geodiff_plugin.jobs import views
    from geodiff_plugin.jobs.options import DepthOptions
    from geodiff_plugin.jobs.pairs import PairRef

    opened = []

    class Reader:
        def __init__(self, *given):
            opened.append(given)
            self.name = str(given[0])

        def __enter__(self):
            return self

        def __exit__(self, *_):
            opened.append(f"{self.name} closed")

        def read(self, frame):
            return f"{self.name} {frame}" if "side" not in self.name else types.SimpleNamespace(frame=frame)

    monkeypatch.setattr(views.recordings, "VideoReader", Reader)
    monkeypatch.setattr(views.recordings, "BagReader", Reader)
    monkeypatch.setattr(views.recordings, "both_halves", lambda image, name: (image.frame, name))
    given = DepthOptions(left=Path("l.mp4"), topic_left="/l", topic_right="/r", tolerance=0.25)
    made = views.Views(given)
    assert made.of(PairRef("a", Path("a.png"), Path("b.png"))) is None and opened == []
    pair = PairRef("3", Path("l.mp4"), Path("r.mp4"), frame=3)
    assert made.of(pair) == made.of(pair) == ("l.mp4 3", "r.mp4 3")
    assert sorted(opened) == [(Path("l.mp4"),), (Path("r.mp4"),)]
    assert made.of(PairRef("5", Path("side.mp4"), None, frame=5)) == (5, "LEFT")
    made.of(PairRef("0", Path("side.mcap"), None, frame=0))
    assert opened[-1] == (Path("side.mcap"), ("/l", "/r"), 0.25)
    made.close()
    assert {"l.mp4 closed", "r.mp4 closed", "side.mp4 closed", "side.mcap closed"} <= set(map(str, opened))
