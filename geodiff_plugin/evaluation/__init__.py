"""Measuring: data sets, metrics, methods side by side, resumable runs and tables.

Hop: folder of a data set -> samples -> every method's depth -> numbers -> table.
Paper: S5 (experiments).
"""
