"""Act 3 for one image at its own size: ensemble, edges, match fit, planar regularization, confidence.

``finish`` makes an ``ImageResult``; ``output`` stacks the results of all images into ``MetricDepthOutput``.
Layer 8: imports ``algorithm``, ``evidence``, ``trust`` and below; imported by ``runtime`` and ``jobs``.
"""
