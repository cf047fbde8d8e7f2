"""The ``geodiff`` command: ``app`` has the options, and one file a command what it does."""
