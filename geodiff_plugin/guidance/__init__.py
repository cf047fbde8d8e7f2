"""The user's side: ``GeometryGuidance`` and what it is given (S3.3, S4.2, S5.1)."""
