"""A guided call of a live pipeline, from its arguments to ``MetricDepthOutput``; nothing stays behind on it."""
