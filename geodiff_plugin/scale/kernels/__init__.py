"""Triton kernels for the scale."""
