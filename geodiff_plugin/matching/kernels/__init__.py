"""Triton kernels for matching. Cost volumes are stored with planes innermost."""
