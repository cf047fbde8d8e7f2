"""Images of README and the documentation: ``python -m tests.images --help``."""
