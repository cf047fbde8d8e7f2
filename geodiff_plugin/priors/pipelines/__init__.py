"""Pipelines of ours for priors whose own code lives outside diffusers, one a file.

Data flow: component configs and weights -> ``DepthDiffusionPipeline`` called as ``MarigoldDepthPipeline`` is.
Paper: S4 (any diffusion-based depth model with iterative updates).
"""
