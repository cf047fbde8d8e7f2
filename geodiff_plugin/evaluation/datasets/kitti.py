"""What KITTI 2012 and 2015 share: 16-bit disparity PNGs and projection matrices.

Data flow: reference -> ``StereoSample``.
Paper: S5.1; protocol as in the sets' own development kits (disparity * 256, 0 = unknown).
"""

from __future__ import annotations

from pathlib import Path

from geodiff_plugin.evaluation.datasets._files import (
    check_calibrated_sizes,
    check_size,
    make_sample,
    read_rgb,
)
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample, disparity_to_depth
from geodiff_plugin.formats import read_calibration, read_disparity_kitti_png

__all__ = ["KITTI_CAP_M", "load_kitti"]

KITTI_CAP_M = 80.0
"""Truth beyond 80 m does not count, the range that monocular depth papers use on KITTI."""


def load_kitti(ref: SampleRef) -> StereoSample:
    """Read one KITTI pair.

    Args:
        ref: ``files`` holds ``left``, ``right``, ``disparity``, ``calibration`` (paths), ``cameras`` (two
            numbers of ``P0`` .. ``P3``) and optionally ``noc``, the disparity of the pixels that are seen
            twice.

    Returns:
        The sample; ``occluded`` where both kinds of truth exist, ``notes["truth"]`` says which was read.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, or its size is not the left image's.
    """
    files = ref.files
    left, right = read_rgb(files["left"], "left image"), read_rgb(files["right"], "right image")
    rig = read_calibration(files["calibration"], cameras=files["cameras"])
    check_calibrated_sizes((files["calibration"],) * 2, rig, left, right)
    disparity, valid = read_disparity_kitti_png(files["disparity"], "true disparity")
    check_size(files["disparity"], disparity.shape, left.shape)
    occluded = None
    if files.get("noc") is not None:
        _, seen_twice = read_disparity_kitti_png(files["noc"], "disparity of the pixels seen twice")
        check_size(files["noc"], seen_twice.shape, left.shape)
        occluded = valid & ~seen_twice
    depth_m = disparity_to_depth(disparity, rig.K_left, rig.K_right, rig.E)
    depth_m[~valid] = 0
    notes = {"truth": Path(files["disparity"]).parent.name, "disparity_step_px": 1 / 256}
    return make_sample(ref, (left, right), rig, depth_m, notes, occluded=occluded)
