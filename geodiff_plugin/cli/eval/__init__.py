"""The ``geodiff eval`` commands: options, help, and tables on the terminal.

Data flow: argv -> a function of ``geodiff_plugin.evaluation`` -> its page, printed.
Paper: S5 (experiments).
"""
