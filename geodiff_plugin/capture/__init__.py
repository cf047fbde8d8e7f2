"""Captures: many frames of one moving camera, each with depth in metres, and one cloud of all."""
