"""The log of a job: seconds of its stages and what they warned of, each sentence once."""

import pytest

from geodiff_plugin._internal.checks import warn
from geodiff_plugin.findings import Finding
from geodiff_plugin.jobs import records
from geodiff_plugin.jobs.records import JobLog
from geodiff_plugin.trust import KINDS

ONE = Finding("camera.assumed-intrinsics", "One.")
TWO = Finding(KINDS["pose.refined"], "Two.")


@pytest.mark.filterwarnings("ignore:One|Two")
def test_stages_are_timed_in_their_order_and_warnings_are_kept_once(monkeypatch):
    clock = iter([10.0, 12.5, 20.0, 20.25])
    monkeypatch.setattr(records.time, "perf_counter", lambda: next(clock))
    log = JobLog()
    with log.stage("first"):
        warn(ONE)
    with log.stage("second"):
        warn(TWO)
        warn(ONE)
    assert list(log.seconds.items()) == [("first", 2.5), ("second", 0.25)]
    assert log.findings == [ONE, TWO]
    log.add([TWO, Finding(KINDS["pose.refined"], "Three.")])
    assert [str(finding) for finding in log.findings] == ["One.", "Two.", "Three."]
    assert JobLog().seconds == {} and JobLog().findings is not JobLog().findings
