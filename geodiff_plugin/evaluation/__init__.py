"""Evaluation: data sets, metrics, methods side by side, resumable runs, tables and figures.

Data flow: folder of a data set -> samples -> every method's depth -> numbers -> table.
Paper: S5 (experiments).
"""
