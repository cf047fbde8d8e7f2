"""Metric depth from a diffusion prior and a second view."""
