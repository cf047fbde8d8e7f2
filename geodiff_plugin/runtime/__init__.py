"""A guided call of a live pipeline, from its arguments to ``MetricDepthOutput``; nothing stays behind on it.

Data flow: pipeline + ``GeometryGuidance`` -> hooks on scheduler and network -> guided steps -> output.
Paper: Algorithm 1, Figure 3 (fig:framework).
"""
