"""Pictures of README and the documentation: ``python -m tests.pictures --help``."""
