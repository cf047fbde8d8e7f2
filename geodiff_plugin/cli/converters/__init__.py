"""Converters of published checkpoints, one kind a file.

A kind has two functions: ``recognises`` says by its keys whether an unpickled checkpoint is of it; ``write``
takes the checkpoint, an empty folder to fill, and what ``--with`` names (or ``None``), and raises an
``InputError`` that says what is wrong. A new kind is a new file and an entry of ``convert.CONVERTERS``.
"""
