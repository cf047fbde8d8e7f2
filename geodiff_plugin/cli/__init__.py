"""Implements the ``geodiff`` command line, which parses options, runs a job and prints its result.

``app`` builds the commands from the declarations of options (``commands``). One file per command prints its
output. To add a command, write a record of options, a job, and a row in ``app``.
Layer 12: imports ``jobs``, ``evaluation`` and below; only ``__main__`` imports it.
"""
