"""Act 1 for one image, before any network runs: checks the input and prepares the evidence of the views.

Belongs here: ``inputs`` checks the input; ``prepare`` cleans and matches the views; ``pose_check`` checks and
refines their poses; ``plan`` defines what runs concurrently. The outcome is an ``Evidence`` (paper S3.3,
S4.2, S5.1).
Layer 6: imports ``trust``, ``pose``, ``scale``, ``matching`` and below; imported by the other acts and
``runtime``.
"""
