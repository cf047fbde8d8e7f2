"""Tools of the maintainers: training of the bundled prior, benchmarks, memory of full-size priors.

Data flow: a checkout of the repository -> weights, tables of the documentation.
Paper: none.

A wheel does not contain this folder (docs/contributing.md says why); nothing outside of it imports it.
"""
