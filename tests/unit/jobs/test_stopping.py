"""A run that is stopped, at whatever moment, leaves nothing half done behind."""

import itertools
import signal
import sys
from contextlib import suppress

import pytest

from geodiff_plugin._internal.signals import defer_signals
from geodiff_plugin.formats.out import REPORT, OutFolder, locked_folder
from geodiff_plugin.jobs.stopping import ending_on_sigterm

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGTERM to be caught")
#: Modules of the functions that call the system.
OF_THE_SYSTEM = {"posix", "_io", "fcntl"}


@pytest.fixture(autouse=True)
def heeds_ctrl_c():
    """What a shell starts in the background ignores SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def send_after(number: int, signum: int):
    """A profile function that sends this process a signal after the system call of that number."""
    count = itertools.count()

    def at_event(_, event, function):
        returned = event == "c_return" and function.__module__ in OF_THE_SYSTEM
        if returned and next(count) == number:
            signal.raise_signal(signum)

    return at_event


def is_stopped(folder, number: int, signum: int) -> bool:
    """Write a folder below one that a run works in; whether the signal came before that was done."""

    def fill(files):
        for name in ("depth.npy", REPORT):
            (files / name).write_text("{}")

    folder.mkdir()
    try:
        with ending_on_sigterm():
            sys.setprofile(send_after(number, signum))
            with locked_folder(folder), OutFolder(folder / "frame") as frame:
                frame.write(fill)
    except KeyboardInterrupt:
        return True
    finally:
        sys.setprofile(None)
    return False


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT])
def test_a_stop_after_any_system_call_leaves_a_folder_whole_or_not_there(signum, tmp_path):
    handler, whole = signal.getsignal(signum), {"frame", "frame/depth.npy", f"frame/{REPORT}"}
    for number in itertools.count():
        folder = tmp_path / str(number)
        stopped = is_stopped(folder, number, signum)
        left = {str(path.relative_to(folder)) for path in folder.rglob("*")}
        assert left in (set(), whole), number
        if not stopped:
            break
    assert number > 20 and left == whole
    assert signal.getsignal(signum) == handler


def test_a_stop_in_a_block_that_is_to_be_whole_waits_for_its_end():
    done = []
    with pytest.raises(KeyboardInterrupt), ending_on_sigterm(), defer_signals():
        with suppress(ValueError), defer_signals():
            signal.raise_signal(signal.SIGTERM)
            done.append("inner")
        done.append("outer")
    assert done == ["inner", "outer"]
