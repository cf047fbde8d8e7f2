"""Sampled mutation testing: which random faults do the tests notice?

    python -m tests.mutation --sample 300 --seed 7           # the whole package
    python -m tests.mutation --changed                       # the lines you changed since main
    python -m tests.mutation --only pose --sample 40         # one package
    python -m tests.mutation --seed 7 --retry                # survivors again, after writing tests

The mutants come from cosmic-ray's operators and a few of our own (``operators.py``). For each one, the
tests that execute the mutated line (``coverage_map.py``) run until one fails, in a forked process with a
private copy of the checkout (``worker.py``). Results are stored after each mutant in ``.mutation/``, so a
run can be stopped and resumed. A survivor has survived the tests that fit into ``--test-seconds``, the most
specific ones first.
"""
