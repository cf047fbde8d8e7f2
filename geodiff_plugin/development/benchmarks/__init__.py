"""Benchmarks: each module prints one table, run as ``python -m geodiff_plugin.development.benchmarks.NAME``.

Hop: this machine -> seconds.
Paper: none.
"""
