"""Benchmarks: each module prints one table, run as ``python -m geodiff_plugin.development.benchmarks.NAME``.

Data flow: this machine -> seconds.
Paper: none.
"""
