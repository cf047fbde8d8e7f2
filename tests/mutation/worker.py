"""Runs the tests against one mutant: a private copy of the checkout, and a forked process for each mutant."""

import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from tests.mutation.coverage_map import PACKAGE, ROOT, TESTS

COPIED = (PACKAGE, *"tests examples docs pyproject.toml constraints.txt README.md mkdocs.yml".split())
OPTIONS = "-x -q -n 0 -p no:cacheprovider -W ignore::pytest.PytestAssertRewriteWarning".split()
OPTIONS += ["-m", TESTS]
#: A mutant may take this many times the CPU time that its tests take without it, and this much more.
SLOWER, MORE_S = 4.0, 30.0
SURVIVED, KILLED, TIMED_OUT = "survived", "killed", "timed out"
#: What pytest's exit status means: all passed, some failed, a test file or a conftest could not be imported.
ENDED = {0: SURVIVED, 1: KILLED, 2: KILLED, 4: KILLED}


@dataclass(frozen=True)
class Outcome:
    """How the tests ended, and the end of what pytest printed."""

    status: str
    seconds: float
    log: str = ""


class Checkout:
    """A copy of the checkout that mutants are written to, next to the data that the tests may use."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "checkout"
        for name in COPIED:
            source, target = ROOT / name, self.root / name
            if source.is_dir():
                shutil.copytree(source, target)
            elif source.exists():
                shutil.copy2(source, target)
        shared = ROOT.parent / "shared"
        if shared.exists():
            (folder / "shared").symlink_to(shared)
        # What every test imports is imported once, before the first fork.
        import_module("tests.golden.parts")
        import_module("tests.tiny")

    def run(self, file: str, code: str, tests: Sequence[str], seconds: float) -> Outcome:
        """Run tests on a mutated file until one fails; ``seconds`` is their time without the mutation."""
        path, start = self.root / file, time.perf_counter()
        original, times = path.read_bytes(), path.stat()
        try:
            path.write_text(code, encoding="utf-8")
            # Bytecode is recognised by the source's size and its time in whole seconds.
            os.utime(path, (times.st_atime, times.st_mtime - 1000))
            status = self._fork(tests, SLOWER * seconds + MORE_S)
        finally:
            path.write_bytes(original)
            os.utime(path, (times.st_atime, times.st_mtime))
        log = (self.root / "log.txt").read_text(encoding="utf-8", errors="replace")
        return Outcome(status, time.perf_counter() - start, log[-1500:])

    def _fork(self, tests: Sequence[str], limit_s: float) -> str:
        child = os.fork()
        if not child:
            status = 3
            try:
                os.setpgid(0, 0)
                resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s), int(limit_s) + 5))
                status = _run_pytest(self.root, tests)
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
        return _wait(child, limit_s)


_checkout: Checkout | None = None


def prepare(folder: str) -> None:
    """Give this process of the pool a checkout of its own."""
    global _checkout
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    _checkout = Checkout(Path(tempfile.mkdtemp(dir=folder)))


def run_tests(file: str, code: str, tests: Sequence[str], seconds: float) -> Outcome:
    """Run tests on a mutated file in this process's checkout."""
    assert _checkout is not None
    return _checkout.run(file, code, tests, seconds)


class _Only:
    """pytest plugin: runs the chosen tests only, in the chosen order."""

    def __init__(self, tests: Sequence[str]) -> None:
        self.order = {name: at for at, name in enumerate(tests)}

    def pytest_collection_modifyitems(self, items):
        items[:] = sorted(
            (item for item in items if item.nodeid in self.order), key=lambda item: self.order[item.nodeid]
        )


def _run_pytest(root: Path, tests: Sequence[str]) -> int:
    import pytest

    with (root / "log.txt").open("w") as log:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
    for name in [name for name in sys.modules if name.split(".")[0] in (PACKAGE, "tests", "examples")]:
        del sys.modules[name]
    sys.path[:] = [str(root), *(path for path in sys.path if Path(path or ".").resolve() != ROOT)]
    sys.dont_write_bytecode = True
    os.environ |= {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    os.chdir(root)
    files = list(dict.fromkeys(name.split("::")[0] for name in tests))
    return int(pytest.main([*OPTIONS, *files], plugins=[_Only(tests)]))


def _wait(child: int, limit_s: float) -> str:
    """The outcome of a forked run; what waits for ever is ended at twice the CPU limit."""
    deadline = time.monotonic() + 2 * limit_s
    while time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            code = os.waitstatus_to_exitcode(status)
            if code in (-signal.SIGXCPU, -signal.SIGKILL):
                return TIMED_OUT
            return KILLED if code < 0 else ENDED.get(code, "error")
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return TIMED_OUT
