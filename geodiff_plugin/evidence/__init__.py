"""Act 1, before any network runs: what the user gave, and what the views alone say (S3.3, S4.2, S5.1)."""
