"""Converters of published checkpoints, one kind a file; ``convert.CONVERTERS`` names them."""
