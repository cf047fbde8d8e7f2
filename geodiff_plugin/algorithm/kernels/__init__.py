"""Triton kernels for the algorithm."""
