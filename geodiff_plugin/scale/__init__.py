"""Relative maps in metres: parametrisation (``space``), search and fit of the scale (S4.1, S7.3)."""
