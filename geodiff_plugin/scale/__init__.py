"""Finds the metric scale of a relative map: parametrisation, search, fit to points (paper S4.1, S7.3).

Belongs here: the spaces of priors and their affine maps, the search over near and far, and the fit to known
points.
Layer 3: imports ``matching`` and below; imported by ``evidence``, ``algorithm`` and ``result``.
"""
