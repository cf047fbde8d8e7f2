"""pytest plugin: which lines of the package each test executes, and how long the test takes.

Loaded by ``coverage_map.py`` with ``-p tests.mutation.record`` and ``GEODIFF_MUTATION_RECORD=<folder>``.
"""

import json
import os
import warnings
from pathlib import Path

import coverage
import pytest

CONFIG = """
[run]
source_pkgs = geodiff_plugin
data_file = {folder}/.coverage
parallel = true
context = ${{PYTEST_CURRENT_TEST-}}
"""


class Recorder:
    """Records the tests that run in this process, and in the processes that they start."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.seconds, self.passed = folder, {}, set()
        config = folder / "processes.ini"
        config.write_text(CONFIG.format(folder=folder), encoding="utf-8")
        self.coverage = coverage.Coverage(
            data_file=str(folder / f".coverage.test-{os.getpid()}"),
            source_pkgs=["geodiff_plugin"],
            messages=False,
        )
        self.coverage.start()
        # A process that a test starts finds the test's name in PYTEST_CURRENT_TEST.
        os.environ["COVERAGE_PROCESS_START"] = str(config)

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item):
        self.coverage.switch_context(item.nodeid)
        yield
        self.coverage.switch_context("")

    def pytest_runtest_logreport(self, report):
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        if report.when == "call" and report.passed:
            self.passed.add(report.nodeid)

    def pytest_sessionfinish(self):
        # Not in pytest_unconfigure: pytest-xdist may end its workers before that is done.
        self.coverage.stop()
        with warnings.catch_warnings():
            # Modules that were imported before coverage started are reported, here as an error.
            warnings.simplefilter("ignore")
            self.coverage.save()
        seconds = {test: self.seconds[test] for test in self.passed}
        (self.folder / f"seconds-{os.getpid()}.json").write_text(json.dumps(seconds), encoding="utf-8")


def pytest_configure(config):
    distributes = getattr(config.option, "dist", "no") != "no" and not hasattr(config, "workerinput")
    if not distributes:
        config.pluginmanager.register(Recorder(Path(os.environ["GEODIFF_MUTATION_RECORD"])))
