"""Processes frames of a rig as they arrive: from cameras, videos, network streams or a Python iterable.

>>> for frame in live(pipe, 0, read_calibration("calib.txt"), side_by_side=True):
...     frame.output.prediction  # (1, H, W, 1), metres

What belongs here:
    - ``loop``: ``live``, which processes the newest frame whenever the network is free.
    - ``sources``: reads both views with OpenCV. Any iterable of ``StereoFrame`` is a source as well.
    - ``rig``: prepares guidance and evidence of a frame; periodically checks poses, images and borders.
    - ``newest``: passes values between threads.

Layer 9: imports ``runtime`` and below; imported by ``jobs`` and by the root of the package.

To add a source, write an iterable of ``StereoFrame``. It is read in a thread of its own and may block.
"""
