"""Evaluation: data sets, metrics, methods side by side, resumable runs, tables and figures (paper S5)."""
