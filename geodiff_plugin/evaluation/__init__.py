"""Evaluates methods: datasets, metrics, resumable runs, tables and figures (paper S5).

To extend: a dataset is a reader and a row of ``datasets``, a method a class and a row of ``baselines``
(docs/how-to/extending.md).
Layer 11: imports ``jobs``, ``capture`` and below; ``cli`` imports it.
"""
