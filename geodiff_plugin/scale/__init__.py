"""Metres of a relative map: the parametrisation (``space``) and how its numbers are found.

Data flow: relative map ``x`` + cost volume, matches or points -> depths of its nearest and farthest end
    -> metres.
Paper: Eq. 13 (eq:metric), Eq. 16, S7.3.
"""
