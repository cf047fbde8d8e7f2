"""What a user configures: ``guidance``, its hyperparameters (``config``) and published sets of them.

Data flow: right views, cameras, points, hyperparameters -> ``GeometryGuidance``.
Paper: S4.2, S5.1.
"""
