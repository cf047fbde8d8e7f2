"""Pipelines of ours for priors whose own code lives outside diffusers, one a file.

Paper: S4 (any diffusion-based depth model with iterative updates).
"""
