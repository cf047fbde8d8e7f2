"""Benchmarks: each module prints one table, run as ``python -m tests.benchmarks.NAME``.

Data flow: this machine -> seconds. The data set ``synthetic:N`` is registered for all of them.
"""

import tests.scenes.dataset  # noqa: F401  registers it
