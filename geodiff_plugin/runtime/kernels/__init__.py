"""Triton kernels for the networks."""
