"""Checks and refines given poses by sparse matches, estimates unknown ones, and solves captures.

Belongs here: features and tracks, refinement of a pair or of several views, estimation without poses, and the
reconstruction of a capture. ``trust`` decides whether a pose can be trusted.
Layer 3: imports ``matching`` and below; imported by ``trust``, ``evidence``, ``capture`` and ``jobs``.
"""
