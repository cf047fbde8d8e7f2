"""Triton kernels for the checks."""
