"""Benchmarks: each module prints one table, run as ``python -m tests.benchmarks.NAME``.

Data flow: this machine -> seconds.
"""
