"""Metres of a relative map: the parametrisation (``space``), its search and its fit (S4.1, S7.3)."""
