"""What data sets of posed views share: camera files, lists of view pairs, the loader.

Data flow: scene folder, two views -> ``StereoSample``.
Paper: S5.1, Table 2 (the arbitrary two-view setting).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value, check_choice
from geodiff_plugin.evaluation.datasets._files import check_size, make_sample, read_rgb
from geodiff_plugin.evaluation.datasets.sample import SampleRef, StereoSample
from geodiff_plugin.formats import read_calibration, read_text

__all__ = ["PAIRS", "check_pairs", "is_posed_group", "load_posed", "pair_files", "sources_of"]

PAIRS = ("default", "all")
#: Further views of the reference that a sample brings along, the best ones first.
MOST_OTHERS = 4


def check_pairs(pairs: str) -> str:
    """``"default"`` or ``"all"``, returned as it came; ``ValueError`` otherwise."""
    return check_choice(pairs, "pairs", PAIRS)


def is_posed_group(folder: Path) -> bool:
    """Whether a folder has ``images``, ``cams`` and ``pair.txt``."""
    return (folder / "cams").is_dir() and (folder / "images").is_dir() and (folder / "pair.txt").is_file()


def sources_of(path: Path) -> dict[int, list[int]]:
    """For every reference view of a ``pair.txt`` its source views, best first, in the file's order.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not the format of MVSNet: a count, then per view its number and a line of ``n id score
            ...``.
    """
    lines = [line.split() for line in read_text(path, "list of view pairs").splitlines() if line.strip()]
    try:
        sources = {}
        for i in range(int(lines[0][0])):
            reference, row = int(lines[1 + 2 * i][0]), lines[2 + 2 * i]
            sources[reference] = [int(source) for source in row[1 : 1 + 2 * int(row[0]) : 2]]
    except (IndexError, ValueError):
        bad_value(
            str(path), "a pair.txt (count, then 'id' and 'n id score ...' lines per view)", "another format"
        )
    return sources


def pair_files(
    group: Path, left: int, right: int, others: list[int], pixel_centre: float, truth: Path
) -> dict[str, Path | int | float | tuple[int, ...]]:
    """``files`` of a posed reference; of ``others``, further views, the first four are read with it."""
    further = tuple([view for view in others if view not in (left, right)][:MOST_OTHERS])
    files = {"group": group, "left": left, "right": right, "others": further, "pixel_centre": pixel_centre}
    # The loader needs no more; the key of a result is made of what these files hold.
    read = {f"{kind} {v}": p for v in (left, right, *further) for kind, p in _view_files(group, v).items()}
    return files | read | {"truth": truth}


def _view_files(group: Path, view: int) -> dict[str, Path]:
    """Image and camera of one view; the image is .png, .jpg or .jpeg."""
    stem = f"{view:08d}"
    images = [group / "images" / f"{stem}{suffix}" for suffix in (".png", ".jpg", ".jpeg")]
    return {
        "image": next((path for path in images if path.is_file()), images[0]),
        "camera": group / "cams" / f"{stem}_cam.txt",
    }


def load_posed(ref: SampleRef, read_truth: Callable[[Path], np.ndarray]) -> StereoSample:
    """Read one posed pair; the camera files' depth numbers are never used.

    Args:
        ref: ``files`` as ``pair_files`` gives them.
        read_truth: its reader, ``(H, W)`` metres.

    Returns:
        The sample; ``valid`` is False everywhere where there is no truth.

    Raises:
        FileNotFoundError: an image or a camera is missing.
        ValueError: a file is damaged, or the depth's size is not the image's.
    """
    files: Mapping[str, Any] = ref.files
    first, second = (_view_files(files["group"], files[side]) for side in ("left", "right"))
    images = read_rgb(first["image"], "left image"), read_rgb(second["image"], "right image")
    half = np.zeros((3, 3))
    half[:2, 2] = files["pixel_centre"]
    rig = read_calibration((first["camera"], second["camera"]))
    extra = []
    for view in files["others"]:
        other = _view_files(files["group"], view)
        pose = read_calibration((first["camera"], other["camera"]))
        extra.append((read_rgb(other["image"], "further image"), pose.K_right - half, pose.E))
    truth = files["truth"]
    depth_m, named = np.zeros(images[0].shape[:2], np.float32), f"no {truth}"
    if truth.is_file():
        depth_m, named = read_truth(truth), f"{truth.parent.name}/{truth.name}"
        check_size(truth, depth_m.shape, images[0].shape)
    notes = {"truth": named, "views": (files["left"], files["right"])}
    shifted = replace(rig, K_left=rig.K_left - half, K_right=rig.K_right - half)
    return make_sample(ref, images, shifted, depth_m, notes, extra_views=tuple(extra))
