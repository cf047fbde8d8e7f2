"""The ``geodiff eval`` commands: options, help, and tables on the terminal.

Paper: S5 (experiments).
"""
