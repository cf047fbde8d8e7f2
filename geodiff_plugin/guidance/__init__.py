"""The user's side: ``GeometryGuidance``, its hyperparameters (``config``) and presets.

Data flow: right views, cameras, points, hyperparameters -> ``GeometryGuidance``.
Paper: S4.2, S5.1.
"""
