"""A guided call of a live pipeline, from its arguments to ``MetricDepthOutput``; it leaves nothing behind."""
