"""What the subcommands of ``geodiff`` do, one file a command; ``cli.py`` has their options."""
