"""Captures: many frames of one moving camera, each with depth in metres, and one cloud of all."""

#: Right views of a frame, at most, where a call does not say.
NEIGHBOURS = 5
#: Known depths of the frames.
POINTS = ("tracks", "none", "model", "depth")
