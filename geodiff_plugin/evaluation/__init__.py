"""Evaluation: data sets, metrics, methods, resumable runs, tables and figures (paper S5).

To extend: a data set is a reader and a row of ``datasets``, a method a class and a row of ``baselines``
(docs/how-to/extending.md).
Layer 12: imports ``jobs``, ``capture`` and below; ``cli`` imports it.
"""
