"""Kernels compile for cards that this machine need not have, and keep everything in registers."""

import os
import subprocess
import sys

import pytest

from geodiff_plugin._internal.kernels import has_triton


@pytest.mark.skipif(not has_triton(), reason="Triton is not installed")
def test_no_kernel_spills_registers():
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    command = [sys.executable, "-m", "tests.benchmarks.kernels"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "paths, 128 planes" in done.stdout
