"""Implements phase 1, for one image: checks inputs and prepares the evidence before the first guided step.

Belongs here: ``inputs`` checks the input; ``prepare`` cleans and matches the views; ``pose_check`` checks and
refines their poses; ``plan`` defines what runs concurrently. The outcome is an ``Evidence`` (paper S3.3,
S4.2, S5.1).
Layer 5: imports ``trust``, ``pose``, ``scale``, ``matching`` and below; imported by the other phases and
``runtime``.
"""
