"""Provides helpers for the whole package: errors, lazy imports, threads, statistics.

This package holds code that several packages need and no library offers. Nothing here is public.
Layer 0: imports at most ``findings``, ``cameras`` and ``types``; everything above imports it.
"""
