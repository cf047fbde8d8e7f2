"""Implements phase 3, for one image at its own size: ensemble, edges, match fit, planes, confidence.

``finish`` makes an ``ImageResult``; ``output`` stacks the results of all images into ``MetricDepthOutput``.
Layer 7: imports ``algorithm``, ``evidence``, ``trust`` and below; imported by ``runtime`` and ``jobs``.
"""
