"""Processes captures: many frames of one moving camera, each with metric depth, and one fused cloud.

Belongs here: the frames of a capture and their neighbours, agreement between their depth maps, and fusion.
Readers of captures are in ``formats``, solved poses in ``pose``.
Layer 9: imports ``runtime``, ``pose`` and below; ``jobs`` and ``evaluation`` import it.
"""

#: Default maximum number of right views of a frame.
NEIGHBOURS = 5
#: Sources of known depths of the frames.
POINTS = ("tracks", "none", "model", "depth")
