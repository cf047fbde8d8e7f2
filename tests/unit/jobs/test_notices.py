"""Lines for the user: control characters are escaped, and warnings of this package are shown once."""

import sys
import warnings

import pytest

from geodiff_plugin._internal import checks as _checks
from geodiff_plugin.findings import Finding
from geodiff_plugin.jobs.notices import collected_warnings, say, silent


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
    reported, before = [], warnings.showwarning
    message = Finding("camera.assumed-intrinsics", "cy is assumed.")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with collected_warnings(reported.append):
            for _ in range(2):
                _checks.warn(message, stacklevel=0)
                warnings.warn("of a test", stacklevel=1)
            _checks.warn(Finding("camera.assumed-intrinsics", "cx is assumed."), stacklevel=0)
    assert reported == ["warning: cy is assumed.", "warning: cx is assumed."]
    assert [str(each.message) for each in caught] == ["of a test"] * 2
    assert warnings.showwarning is before
