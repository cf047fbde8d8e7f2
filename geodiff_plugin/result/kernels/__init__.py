"""Triton kernels for the result."""
