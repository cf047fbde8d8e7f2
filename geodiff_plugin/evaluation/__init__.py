"""Evaluation: data sets, metrics, methods side by side, resumable runs, tables and figures.

Paper: S5 (experiments).
"""
