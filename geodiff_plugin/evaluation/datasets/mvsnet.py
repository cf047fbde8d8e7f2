"""Posed views in the layout that multi-view stereo code uses for Tanks and Temples.

Hop: folder -> references -> ``StereoSample``.
Paper: S5.1, Table 2 (the arbitrary two-view setting).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.datasets._files import check_size, folders, read_rgb
from geodiff_plugin.evaluation.datasets.sample import Dataset, SampleRef, StereoSample, is_rectified
from geodiff_plugin.formats import read_calibration, read_pfm, read_text

__all__ = ["MVSNET", "find_mvsnet", "load_mvsnet", "ordered_pairs"]


def _view_files(group: Path, view: int) -> dict[str, Path]:
    """Image, camera and depth of one view; the image is .png, .jpg or .jpeg."""
    stem = f"{view:08d}"
    images = [group / "images" / f"{stem}{suffix}" for suffix in (".png", ".jpg", ".jpeg")]
    return {
        "image": next((path for path in images if path.is_file()), images[0]),
        "camera": group / "cams" / f"{stem}_cam.txt",
        "depth": group / "depths" / f"{stem}.pfm",
    }


def ordered_pairs(path: Path) -> list[tuple[int, int]]:
    """Every ordered pair (reference, source) of a ``pair.txt``, in the file's order.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not the format of MVSNet: a count, then per view its number and a line of ``n id score
            ...``.
    """
    lines = [line.split() for line in read_text(path, "list of view pairs").splitlines() if line.strip()]
    try:
        count = int(lines[0][0])
        pairs = []
        for i in range(count):
            reference, sources = int(lines[1 + 2 * i][0]), lines[2 + 2 * i]
            pairs += [(reference, int(source)) for source in sources[1 : 1 + 2 * int(sources[0]) : 2]]
    except (IndexError, ValueError):
        bad_value(
            str(path), "a pair.txt (count, then 'id' and 'n id score ...' lines per view)", "another format"
        )
    return pairs


def find_mvsnet(root: Path, pairs: str = "default", pixel_centre: float = 0.0) -> list[SampleRef]:
    """References to posed pairs below ``root``: folders with ``images``, ``cams`` and ``pair.txt``.

    Args:
        root: a group, or a folder of groups down to two levels.
        pairs: ``"default"``: the first two views of each group; ``"all"``: every ordered pair of
            ``pair.txt``.
        pixel_centre: coordinate of the top-left pixel's centre in the cameras' convention; 0.5 for COLMAP's.

    Returns:
        References in the order of the folders' names.

    Raises:
        ValueError: ``pairs`` is neither, or a ``pair.txt`` is not readable.
    """
    if pairs not in ("default", "all"):
        bad_value("pairs", "'default' or 'all'", repr(pairs))
    refs = []
    for group in folders(root, 2):
        if not ((group / "cams").is_dir() and (group / "images").is_dir() and (group / "pair.txt").is_file()):
            continue
        listed = ordered_pairs(group / "pair.txt")
        views = sorted({view for pair in listed for view in pair})
        chosen = listed if pairs == "all" else [(views[0], views[1])] if listed else []
        for i, j in chosen:
            name = group.name if pairs == "default" else f"{group.name}-{i}-{j}"
            others = tuple(view for view in views if view not in (i, j))
            files = {"group": group, "left": i, "right": j, "others": others, "pixel_centre": pixel_centre}
            refs.append(SampleRef("mvsnet", name, files))
    return refs


def load_mvsnet(ref: SampleRef) -> StereoSample:
    """Read one posed pair; the camera files' depth numbers are never used.

    Args:
        ref: ``files`` holds ``group`` (folder), ``left``, ``right`` (view numbers), ``others`` (further
            views) and ``pixel_centre``.

    Returns:
        The sample; ``valid`` is False everywhere where the group has no depths.

    Raises:
        FileNotFoundError: an image or a camera is missing.
        ValueError: a file is damaged, or the depth's size is not the image's.
    """
    group = ref.files["group"]
    first, second = (_view_files(group, ref.files[side]) for side in ("left", "right"))
    left, right = read_rgb(first["image"], "left image"), read_rgb(second["image"], "right image")
    half = np.zeros((3, 3))
    half[:2, 2] = ref.files["pixel_centre"]
    rig = read_calibration((first["camera"], second["camera"]))
    extra = []
    for view in ref.files["others"]:
        other = _view_files(group, view)
        pose = read_calibration((first["camera"], other["camera"]))
        extra.append((read_rgb(other["image"], "further image"), pose.K_right - half, pose.E))
    depth_m, truth = np.zeros(left.shape[:2], np.float32), "none"
    if first["depth"].is_file():
        raw = read_pfm(first["depth"], "true depth")
        check_size(first["depth"], raw.shape, left.shape)
        depth_m = np.where(np.isfinite(raw) & (raw > 0), raw, 0).astype(np.float32)
        truth = f"depths/{first['depth'].name}"
    return StereoSample(
        dataset=ref.dataset,
        name=ref.name,
        left=left,
        right=right,
        K_left=rig.K_left - half,
        K_right=rig.K_right - half,
        E=rig.E,
        depth_m=depth_m,
        valid=depth_m > 0,
        rectified=is_rectified(rig.K_left, rig.K_right, rig.E),
        notes={"truth": truth, "views": (ref.files["left"], ref.files["right"])},
        extra_views=tuple(extra),
    )


MVSNET = Dataset(
    name="mvsnet",
    find=find_mvsnet,
    load=load_mvsnet,
    cap_m=None,
    obtain="folders of images/, cams/ and pair.txt as MVSNet code circulates Tanks and Temples; "
    "for the numbers here also depths/*.pfm in metres.",
    options=("pairs", "pixel_centre"),
)
